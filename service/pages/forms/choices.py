"""Choices of the form of a new identification: names of the core with their texts."""

from collections.abc import Mapping, Sequence

from sysid.core.settings import (
    INITIAL_SETTINGS,
    LOSS_KINDS,
    NOISE_MODELS,
    PREDICTION_KINDS,
    SEARCH_METHODS,
    FitSettings,
    GeneticAlgorithm,
    Loss,
)
from sysid.data.holds import HOLDS, MEANS

NAMES: Mapping[str, Sequence[str]] = {
    "method": SEARCH_METHODS,
    "loss": LOSS_KINDS,
    "noise_model": NOISE_MODELS,
    "prediction": PREDICTION_KINDS,
    "hold": HOLDS,
    "output_hold": MEANS,
    "initial": INITIAL_SETTINGS,
}
"""Names to choose from, by the field of the form."""

DEFAULTS: Mapping[str, str] = {
    "method": GeneticAlgorithm().method,
    "loss": Loss().kind,
    "noise_model": Loss().noise_model,
    "prediction": FitSettings().prediction,
    "hold": "",
    "output_hold": "",
    "initial": "",
}
"""Preselected names; no hold and no start, since the recording and the model have one."""

TEXTS: Mapping[str, str] = {
    "improved": "improved (islands, sequence search)",
    "improved-paper": "improved, as in the paper",
    "simple": "simple genetic algorithm",
    "soft-l1": "soft-l1 (outliers)",
    "auto": "selected by the data (auto)",
    "ar1": "first-order coloured (ar1)",
    "simulation": "simulation (free run)",
    "one-step": "one step ahead",
    "rest": "at rest (rest)",
    "free": "estimated (free)",
    "measured": "first measured values (measured)",
    "zero": "held (zero)",
    "first": "straight line (first)",
    "mean": "mean up to its time (mean)",
    "mean-after": "mean from its time on (mean-after)",
}
"""Texts of names; a name without a text is shown itself."""


_LABELS: Mapping[str, str] = {"noise_model": "noise", "kind": "loss", "initial": "start"}
"""Labels of fields that are not called like the setting."""


def list_choices() -> dict[str, list[tuple[str, str]]]:
    """List values and texts of every field with choices."""
    return {
        field: [(name, TEXTS.get(name, name)) for name in names] for field, names in NAMES.items()
    }


def write_choice(place: Sequence[str], entries: Mapping[str, str]) -> str:
    """Write a setting of a note as the form has it: the field's label and the chosen text.

    That of a parameter is one of the model as text.

    >>> write_choice(["hold"], {"u": "zero"})
    '“u between samples: held (zero)”'
    >>> write_choice(["parameters", "r"], {"physical": "upper"})
    '“physical: upper” of r in the model as text'
    """
    field, *parts = place or [""]
    labels = {
        name: f"{name} between samples" if field == "hold" else _LABELS.get(name, name)
        for name in entries
    }
    chosen = " and ".join(
        f"“{labels[name]}: {TEXTS.get(value, value)}”" for name, value in entries.items()
    )
    return f"{chosen} of {parts[0]} in the model as text" if parts else chosen
