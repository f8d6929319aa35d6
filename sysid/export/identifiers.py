"""Names of a model as identifiers of a program, and its texts as harmless comments."""

import re
import unicodedata
from collections.abc import Iterable

_GREEK = {
    "α": "alpha",
    "β": "beta",
    "γ": "gamma",
    "δ": "delta",
    "ε": "epsilon",
    "ζ": "zeta",
    "η": "eta",
    "θ": "theta",
    "ι": "iota",
    "κ": "kappa",
    "λ": "lambda",
    "μ": "mu",
    "ν": "nu",
    "ξ": "xi",
    "ο": "omicron",
    "π": "pi",
    "ρ": "rho",
    "σ": "sigma",
    "ς": "sigma",
    "τ": "tau",
    "υ": "upsilon",
    "φ": "phi",
    "χ": "chi",
    "ψ": "psi",
    "ω": "omega",
}


class Identifiers:
    """Makes a unique identifier for every name: ASCII letters, digits and ``_``."""

    def __init__(self, taken: Iterable[str]) -> None:
        self._taken = set(taken)

    def make_identifier(self, name: str) -> str:
        """Make an unused identifier similar to the name."""
        stem = _to_ascii(name)
        identifier, number = stem, 1
        while identifier in self._taken:
            number += 1
            identifier = f"{stem}_{number}"
        self._taken.add(identifier)
        return identifier


def _to_ascii(name: str) -> str:
    spelled = "".join(
        _GREEK.get(c, _GREEK.get(c.lower(), c).capitalize() if c.lower() in _GREEK else c)
        for c in unicodedata.normalize("NFKC", name)
    )
    plain = unicodedata.normalize("NFKD", spelled).encode("ascii", "ignore").decode()
    stem = re.sub(r"[^A-Za-z0-9]+", "_", plain).strip("_")[:60]
    return stem if stem and not stem[0].isdigit() else f"p_{stem}".rstrip("_")


def to_one_line(text: str) -> str:
    """Put a text on one line, without invisible characters or changes of writing direction."""
    visible = "".join(c if c.isprintable() else " " for c in text)
    return " ".join(visible.split())


def escape_docstring(text: str) -> str:
    """Escape a line of a docstring in three quotes, so that its text cannot end it."""
    return to_one_line(text).replace("\\", "\\\\").replace('"""', '\\"\\"\\"')


def escape_c_comment(text: str) -> str:
    """Escape a line inside ``/* … */``: it opens or closes no comment and has no trigraph."""
    return to_one_line(text).replace("*/", "* /").replace("/*", "/ *").replace("??", "? ?")
