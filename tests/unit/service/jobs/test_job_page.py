"""docs/job.md and docs/derive.md: every field and every step is there, and their examples hold."""

import json
import re
from typing import Any, get_args

import numpy as np
import pytest
import yaml

from service.datasets.dataset_schemas import DeriveIn
from service.jobs.job_schemas import JobIn
from sysid.core.settings import SEARCH_METHODS, TopologyName
from sysid.data.derivations import STEPS, derive_recording
from sysid.data.noise import NOISE_KINDS
from sysid.data.records import HOLDS, Channel, Recording, Segment
from tests.documents.job import FIELDS, PAGE, write_page
from tests.support.checkout import ROOT

PAGES = [(ROOT / "docs" / name).read_text(encoding="utf-8") for name in ("job.md", "derive.md")]
EXAMPLES = [
    yaml.safe_load(text)
    for page in PAGES
    for text in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
]
JOBS = [one for one in EXAMPLES if "model" in one]
STEP_LISTS = [one for one in EXAMPLES if "steps" in one]


def list_rows(page: str) -> dict[str, list[str]]:
    """Cells of every row of a page's tables by the name in the first."""
    return {
        cells[1].strip().strip("`"): [cell.strip() for cell in cells[2:-1]]
        for line in page.splitlines()
        if (cells := line.split("|"))[0] == "" and len(cells) > 3 and "`" in cells[1]
    }


ROWS, STEP_ROWS = map(list_rows, PAGES)


def test_the_table_of_the_search_is_that_of_its_settings() -> None:
    assert PAGE.read_text(encoding="utf-8") == write_page(), "`make docs` writes it anew"


def test_every_field_of_a_job_is_told_with_its_default() -> None:
    assert set(ROWS) == set(FIELDS)
    assert [path for path, (kind, _, meaning) in ROWS.items() if not (kind and meaning)] == []
    wanted = {path: describe_default(path) for path in FIELDS}
    told = {path: default for path, (_, default, _) in ROWS.items()}
    assert {path: told[path] for path, default in wanted.items() if default} == {
        path: default for path, default in wanted.items() if default
    }


def describe_default(path: str) -> str:
    """What the page has to say of a default; the page explains some in its own words."""
    field = FIELDS[path]
    is_object = isinstance(field.get("default"), dict) and "$ref" in field
    if path in ("name", "model") or is_object:
        return ""
    return f"`{json.dumps(field['default'])}`" if "default" in field else "needed"


def choices(field: Any) -> set[str]:
    """Names that a field, its entries or its values take, where these are listed."""
    if not isinstance(field, dict):
        return set()
    inner = [field.get("items"), field.get("additionalProperties"), *field.get("anyOf", [])]
    return set(field.get("enum", ())).union(*(choices(one) for one in inner))


CHOICES = {path: choices(field) for path, field in FIELDS.items() if choices(field)}


def test_every_name_that_a_field_of_a_job_takes_is_told_and_no_other() -> None:
    assert {path: list_named(path) for path in CHOICES} == CHOICES


def list_named(path: str) -> set[str]:
    """Names that the row of a field tells, or the row that it refers to."""
    kind = ROWS[path][0]
    if kind.startswith("as "):
        kind = ROWS[kind.removeprefix("as ").strip("`")][0]
    return set(re.findall(r"`([^`]+)`", kind))


def test_the_fields_that_take_names_are_found() -> None:
    assert set(get_args(TopologyName)) == CHOICES["algorithm.migration.topology"]
    assert set(SEARCH_METHODS) == CHOICES["algorithm.method"] == CHOICES["algorithm.islands.method"]
    assert set(HOLDS) == CHOICES["hold"]


@pytest.mark.parametrize(("step", "names"), [("hold", HOLDS), ("noise", NOISE_KINDS)])
def test_every_name_that_a_step_takes_is_told(step: str, names: tuple[str, ...]) -> None:
    told = " ".join(STEP_ROWS[step])
    assert [name for name in names if not re.search(rf"(?<![\w-]){name}(?![\w-])", told)] == []


def test_every_step_of_a_derivation_is_told_and_no_other() -> None:
    assert set(STEP_ROWS) == set(STEPS)


@pytest.mark.parametrize("body", JOBS, ids=lambda one: str(one["model"]))
def test_the_examples_of_jobs_are_valid(body: dict[str, Any]) -> None:
    assert JobIn.model_validate(body).model == body["model"]


def test_the_example_of_steps_takes_every_step() -> None:
    [body] = STEP_LISTS
    steps = DeriveIn.model_validate(body).steps
    assert {name for step in steps for name in step} == set(STEPS)
    own = np.arange(0.0, 4.0, 0.01)
    times = np.concatenate([10.0 * i + own for i in range(4)])
    segments = tuple(
        Segment(10.0 * i, 10.0 * i + 3.99, 0.0, {"direction": "up", "repeat": float(i)})
        for i in range(4)
    )
    values = 100.0 + np.sin(times)
    made = Recording((Channel("P1", times, values, "kPa"), Channel("P2", times, values)), segments)
    found = derive_recording(made, steps)
    assert [(one.name, one.unit) for one in found.channels] == [("u", "Pa"), ("y", "Pa")]
    assert len(JOBS) >= 3
