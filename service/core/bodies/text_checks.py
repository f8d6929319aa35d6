"""Check texts of a request: characters that no database can store, and very long numbers."""

import re

LONE_SURROGATE = "a text contains half of a surrogate pair, which is not valid Unicode"
NUL_CHARACTER = "a text contains the character NUL (U+0000); remove it"

MANY = 10**18
"""More than any count or position; both databases can compare with it."""

_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069]")


def find_text_fault(text: str) -> str | None:
    """Return why a database cannot store this text; None if both databases can."""
    if "\x00" in text:
        return NUL_CHARACTER
    try:
        text.encode()
    except UnicodeEncodeError:
        return LONE_SURROGATE
    return None


def find_json_fault(text: str) -> str | None:
    """Return why a database cannot store a text of this JSON document; None if both can."""
    # json.dumps escapes NUL as \u0000; an escaped backslash before u0000 is an ordinary text.
    if "\\u0000" in text and "\\u0000" in text.replace("\\\\", ""):
        return NUL_CHARACTER
    return find_text_fault(text)


def escape_controls(text: str, but: str = "") -> str:
    r"""Write control characters of a text as ``\u001b``, as JSON does.

    A terminal would obey them, and a reader of a log would see lines that nobody wrote. This also
    holds for separators of lines, and for marks that turn the direction of a text.

    Parameters
    ----------
    but : str
        Characters that stay.

    Examples
    --------
    >>> escape_controls("tube\x1b[2J")
    'tube\\u001b[2J'
    """
    if text.isascii() and text.isprintable():
        return text
    return _CONTROL.sub(lambda found: _escape_control(found[0], but), text)


def _escape_control(character: str, but: str) -> str:
    return character if character in but else f"\\u{ord(character):04x}"


def parse_digits(digits: str) -> int:
    """Return the number of a text of decimal digits, at most `MANY`.

    Python refuses to convert more than 4,300 digits, and databases take 64 bits.
    """
    short = digits.lstrip("0") or "0"
    return int(short) if len(short) < len(str(MANY)) else MANY
