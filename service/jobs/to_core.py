"""The one way from a job body to the core: search, fit and options of a run.

The command line, the dispatcher and the views of a stored run go it. It is apart from the wire
types, and loads no compiler.
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, NamedTuple

from service.core.bodies.derived_bodies import read_settings
from sysid.core.settings import FitSettings, GeneticAlgorithm
from sysid.data.noise import Noise
from sysid.identification.options import RunOptions


class RunSettings(NamedTuple):
    """What a body says of a run, besides its model and its recordings."""

    algorithm: GeneticAlgorithm
    fit: FitSettings
    options: RunOptions


def read_run_settings(body: Mapping[str, Any], *, in_sweep: bool) -> RunSettings:
    """Read what a body in its normal form says of a run.

    By default the orders of a process are compared in a run alone, not `in_sweep`.

    Raises
    ------
    InvalidSettings
        With the pointer of the field that cannot be used.
    """
    compared = body["compare_orders"]
    return RunSettings(
        read_algorithm(body),
        read_fit(body),
        RunOptions(
            seed=body["seed"],
            validation_fraction=(body["validation"] or {}).get("fraction"),
            noise=read_noise(body),
            posterior=body["posterior"],
            compare_orders=not in_sweep if compared is None else compared,
        ),
    )


def read_algorithm(body: Mapping[str, Any]) -> GeneticAlgorithm:
    """Read the settings of the search."""
    return read_settings(GeneticAlgorithm, body["algorithm"], "/algorithm")


def read_fit(body: Mapping[str, Any]) -> FitSettings:
    """Read the settings of the fit, which are fields of the body itself."""
    names = [field.name for field in fields(FitSettings) if field.name in body]
    return read_settings(FitSettings, {name: body[name] for name in names})


def read_noise(body: Mapping[str, Any]) -> Noise:
    """Read the noise that is added before fitting."""
    return read_settings(Noise, body["noise"], "/noise")
