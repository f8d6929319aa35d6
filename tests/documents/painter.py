"""Figures of Plotly as files, drawn by the browser."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import unquote

CHROMIUM = Path("/usr/bin/chromium")
_WIDTH, _HEIGHT = 900, 500
_TO_SVG = """([figure, width, height]) => Plotly.toImage(figure, {format: "svg", width, height})"""


@contextmanager
def open_painter() -> Iterator[Callable[[Path, Any], None]]:
    """Open a browser that writes a figure as a file: SVG, or PNG by the ending of its name."""
    from playwright.sync_api import sync_playwright
    from plotly.offline import get_plotlyjs

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM)
        page = browser.new_page()
        page.set_content(f"<script>{get_plotlyjs()}</script>")

        def draw(path: Path, figure: Any) -> None:
            size = figure.layout.width or _WIDTH, figure.layout.height or _HEIGHT
            path.parent.mkdir(exist_ok=True)
            if path.suffix == ".svg":
                address = page.evaluate(_TO_SVG, [json.loads(figure.to_json()), *size])
                path.write_text(unquote(address.partition(",")[2]), encoding="utf-8")
            else:
                _take_picture(browser, path, figure, *size)

        yield draw
        browser.close()


def _take_picture(browser: Any, path: Path, figure: Any, width: int, height: int) -> None:
    page = browser.new_page(viewport={"width": width, "height": height})
    page.set_content(figure.to_html(include_plotlyjs=True, config={"staticPlot": True}))
    page.wait_for_selector(".plot-container .main-svg")
    page.add_style_tag(content="body { margin: 0 }")  # it would cut the last pixels off
    page.screenshot(path=path)
    page.close()
