"""Templates with their context: the one environment of pages and reports."""

from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from service.web import assets, formats


@cache
def environment() -> Environment:
    """The templates. Every text of a user is escaped, and a name that is not given is an error."""
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent / "templates"),
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    made.filters.update(formats.FILTERS)
    made.globals.update(
        static=lambda name: f"/static/{name}", plotly=f"/static/{assets.plotly_name()}"
    )
    return made


def render(template: str, **context: Any) -> str:
    """A template with its context, as of now."""
    return environment().get_template(template).render(now=datetime.now(UTC), **context)
