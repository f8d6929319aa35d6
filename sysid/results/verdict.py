"""The verdict of a result, in a module that loads no numerics: the client's types name it."""

from dataclasses import dataclass
from typing import Literal

Trust = Literal["trustworthy", "limited", "not trustworthy"]


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the estimates of a result can be relied on.

    Attributes
    ----------
    trust : {"trustworthy", "limited", "not trustworthy"}
        Limited: the estimates hold but for those that the text names, or under its condition.
    text : str
        The verdict in words, such as “trustworthy but for L: L changes at about 98 s”.
    """

    trust: Trust
    text: str
