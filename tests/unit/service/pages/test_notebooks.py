"""Pages of the documentation are notebooks: their code is in cells, the rest in text."""

import json
import re
from typing import Any

import pytest

from service.pages.documentation.guides import list_notebooks, make_notebook
from service.pages.documentation.notebooks import to_notebook

PAGE = """# A page

Read [this](../model.md#a) and [that](https://example.org/b).

```sh
pip install '.[notebook]'
```

```yaml
# tank.yaml
name: tank
```

```yaml
only: shown
```

```python
print(2)
```

```text
2
```

![A picture](pictures/a.png)

Then look.

```text
no output
```

```console
$ lagid serve --data-dir data &
$ lagid sweep noise --model tube \\
    --wait
sigma  runs
$ lagid jobs
```
"""


def read_cells(text: str) -> list[dict[str, Any]]:
    cells: list[dict[str, Any]] = json.loads(text)["cells"]
    return cells


def test_blocks_that_run_are_cells_and_the_rest_is_text() -> None:
    cells = read_cells(to_notebook(PAGE))
    texts = [cell["source"] for cell in cells if cell["cell_type"] == "markdown"]
    assert texts[0].startswith(
        "# A page\n\nRead *this* and [that](https://example.org/b).\n\n```sh"
    )
    assert texts[1:] == ["```yaml\nonly: shown\n```", "Then look.\n\n```text\nno output\n```"]
    assert [cell["source"] for cell in cells if cell["cell_type"] == "code"] == [
        "%%writefile tank.yaml\n# tank.yaml\nname: tank",
        "print(2)",
        "%%bash --bg\nlagid serve --data-dir data",
        "%%bash\nuntil lagid health web; do sleep 1; done 2> /dev/null",
        "%%bash --no-raise-error\nlagid sweep noise --model tube \\\n    --wait",
        "%%bash --no-raise-error\nlagid jobs",
    ]
    assert not any(cell.get("outputs") for cell in cells)
    assert len({cell["id"] for cell in cells}) == len(cells)


@pytest.mark.parametrize("path", list_notebooks())
def test_a_notebook_has_all_code_of_its_page(path: str) -> None:
    notebook = make_notebook(path)
    assert notebook is not None
    cells = read_cells(notebook)
    page = list_notebooks()[path].read_text(encoding="utf-8")
    sources = [cell["source"] for cell in cells if cell["cell_type"] == "code"]
    python = [source for source in sources if not source.startswith("%%")]
    assert python == [text.rstrip("\n") for text in re.findall(r"```python\n(.*?)```", page, re.S)]
    commands = [source for source in sources if source.startswith(("%%bash --no", "%%bash --bg"))]
    assert len(commands) == len(re.findall(r"^\$ ", page, re.M))
    texts = "".join(cell["source"] for cell in cells if cell["cell_type"] == "markdown")
    assert not re.search(r"\]\((?!https?://)", texts)


def test_all_tutorials_are_notebooks_and_no_other_page() -> None:
    paths = list_notebooks()
    assert sum(path.startswith("tutorials/") for path in paths) == 7
    assert make_notebook("model.ipynb") is None
    assert make_notebook("tutorials/pictures/first_time_lag.ipynb") is None
