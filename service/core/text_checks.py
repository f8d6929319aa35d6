"""Check texts of a request: characters that no database can store, and very long numbers."""

import re

LONE_SURROGATE = "a text contains half of a surrogate pair, which is not valid Unicode"
NUL_CHARACTER = "a text contains the character NUL (U+0000); remove it"

MANY = 10**18
"""More than any count or position; both databases can compare with it."""

_SURROGATE = re.compile("[\ud800-\udfff]")


def find_text_fault(text: str) -> str | None:
    """Return why a database cannot store this text; None if both databases can."""
    if "\x00" in text:
        return NUL_CHARACTER
    return LONE_SURROGATE if not text.isascii() and _SURROGATE.search(text) else None


def find_json_fault(text: str) -> str | None:
    """Return why a database cannot store a text of this JSON document; None if both can."""
    # json.dumps escapes NUL as \u0000; an escaped backslash before u0000 is an ordinary text.
    if "\\u0000" in text and "\\u0000" in text.replace("\\\\", ""):
        return NUL_CHARACTER
    return find_text_fault(text)


def parse_digits(digits: str) -> int:
    """Return the number of a text of decimal digits, at most `MANY`.

    Python refuses to convert more than 4,300 digits, and databases take 64 bits.
    """
    short = digits.lstrip("0") or "0"
    return int(short) if len(short) < len(str(MANY)) else MANY
