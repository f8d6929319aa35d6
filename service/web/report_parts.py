"""What every report carries inside: the sheet of the pages."""

from functools import cache

from markupsafe import Markup

from service.web import assets


@cache
def style() -> Markup:
    """The sheet of pages and reports."""
    return Markup((assets.STATIC / "lagid.css").read_text(encoding="utf-8"))
