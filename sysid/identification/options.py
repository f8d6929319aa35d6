"""What a run does besides its fit and its search. A light module: wire types read it."""

from __future__ import annotations  # as in `request`, whose fields begin with these

from collections.abc import Mapping
from dataclasses import dataclass

from sysid.core.settings import Seed, Share, check_settings
from sysid.data.noise import Noise


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOptions:
    """Options of a run, besides the settings of its fit and its search.

    Attributes
    ----------
    seed : int
        Seed of the search; the same seed gives the same result, bit for bit.
    validation_fraction : float or None
        Last part of each record that is compared, but not fitted.
    noise : Noise or None
        Noise that is added before fitting.
    warm : mapping of str to float, or None
        Values that a part of the population starts from.
    posterior : bool
        Sample the posterior distribution of the free parameters.
    compare_orders : bool
        Fit a process with dead time with one order more and one less, too.
    """

    seed: Seed = 1
    validation_fraction: Share | None = None
    noise: Noise | None = None
    warm: Mapping[str, float] | None = None
    posterior: bool = False
    compare_orders: bool = True

    def __post_init__(self) -> None:
        check_settings(self, "")
