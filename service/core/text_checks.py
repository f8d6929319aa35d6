"""What texts a database keeps: told in sentences, so that texts can be looked at without one."""

import re

LONE_SURROGATE = "a text holds half of a surrogate pair; it is not valid Unicode"
NUL_CHARACTER = "a text holds the character NUL (U+0000); remove it"

_SURROGATE = re.compile("[\ud800-\udfff]")


def find_text_fault(text: str) -> str | None:
    """Why no database can keep this text; None if both can."""
    if "\x00" in text:
        return NUL_CHARACTER
    return LONE_SURROGATE if not text.isascii() and _SURROGATE.search(text) else None


def find_json_fault(text: str) -> str | None:
    """Why no database can keep a text in this JSON document; None if both can keep all."""
    # json.dumps escapes NUL as \u0000; an escaped backslash before u0000 is an ordinary text.
    if "\\u0000" in text and "\\u0000" in text.replace("\\\\", ""):
        return NUL_CHARACTER
    return find_text_fault(text)
