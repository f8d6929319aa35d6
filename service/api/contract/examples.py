"""Examples of the OpenAPI document: a request for each operation, and values of its parameters.

They build on each other: `simulate_dataset` and `derive_dataset` store the recordings that the
others name; that of another logger is the reader's. Identifiers of jobs and runs stand for those of
the reader.
"""

from collections.abc import Mapping
from typing import Any

DATASET, PART = "heating", "heating, begin"
OTHER_LOGGER = "room"
DATASET_ID = "ds_01kb3v8x4j7q2r9s5t6w0y1z29"
JOB = "job_01kb3v8x4m7q2r9s5t6w0y1z2a"
RUN = "run_01kb3v8x4n7q2r9s5t6w0y1z2b"
OTHER_RUN = "run_01kb3v8x4p7q2r9s5t6w0y1z2c"

PARAMETERS: Mapping[str, tuple[str, str]] = {
    "dataset_id": ("identifier of a dataset", DATASET_ID),
    "job_id": ("identifier of a job", JOB),
    "run_id": ("identifier of a run", RUN),
}
"""Description and example of the parameters that many paths have."""
_OWN_MODEL = "name of your own model, or `name@version`"
NAMES: Mapping[str, tuple[str, str]] = {
    "read_model": ("name of a model, `name@version`, or its identifier", "fopdt"),
    "edit_model": (_OWN_MODEL, "heater"),
    "delete_model": (_OWN_MODEL, "heater"),
    "read_reference": ("name of a reference", DATASET),
    "edit_reference": ("name of a reference", DATASET),
    "delete_reference": ("name of a reference", DATASET),
    "accept_reference": ("name of the reference", DATASET),
    "draw_run_figure": ("name of the figure", "response"),
}
"""The same of the parameter `name`, by operation."""

_MODEL: Mapping[str, Any] = {
    "name": "heater",
    "form": "differential",
    "inputs": {"u": "V"},
    "states": {"x": "K"},
    "parameters": {
        "K": {"lower": 0, "upper": 10, "unit": "K/V"},
        "T": {"lower": 0.1, "upper": 10, "unit": "s"},
        "L": {"lower": 0, "upper": 2, "unit": "s"},
    },
    "equations": {"x": "(K*u(t - L) - x)/T"},
    "outputs": {"y": "x"},
    "initial": {"x": 0},
}
_MODEL_TEXT = """\
name: heater
form: differential
inputs: {u: V}
states: {x: K}
parameters:
  K: {lower: 0, upper: 10, unit: K/V}
  T: {lower: 0.1, upper: 10, unit: s}
  L: {lower: 0, upper: 2, unit: s}
equations: {x: (K*u(t - L) - x)/T}
outputs: {y: x}
initial: {x: 0}
"""
_TRUE_VALUES = {"K": 2, "T": 1, "L": 0.5, "y0": 0}
_RECORD = {
    "parameters": _TRUE_VALUES,
    "inputs": {"u": {"kind": "binary", "period": 2}},
    "samples": 200,
    "sample_time": 0.1,
}
_DOCUMENT = {"application/json": _MODEL, "application/yaml": _MODEL_TEXT}
_JOB = {
    "name": "step test",
    "model": "fopdt",
    "datasets": [DATASET],
    "parameters": {"L": {"upper": 2}},
    "validation": {"fraction": 0.3},
}
_EDIT = {"note": "the valve was replaced before", "tags": ["spring", "valve 2"]}
EDITED_KINDS = ("dataset", "model", "job", "run", "reference")

BODIES: Mapping[str, Mapping[str, Any]] = {
    "add_dataset": {
        "text/csv": "t [s],u [V],y [K]\n0,0,0\n0.1,1,0\n0.2,1,0.1\n0.3,1,0.3\n0.4,0,0.4\n"
    },
    "simulate_dataset": {
        "application/json": {
            "name": DATASET,
            "model": "fopdt",
            **_RECORD,
            "noise": {"sigma": 0.05, "seed": 1},
        }
    },
    "join_datasets": {
        "application/json": {"name": "heating and room", "datasets": [DATASET, OTHER_LOGGER]}
    },
    "derive_dataset": {
        "application/json": {
            "name": PART,
            "steps": [{"trim": {"start": 0, "stop": 10}}],
        }
    },
    "add_model": _DOCUMENT,
    "check_model": _DOCUMENT,
    "submit_job": {"application/json": _JOB},
    "submit_noise_sweep": {
        "application/json": {
            "model": "fopdt",
            "truth": _RECORD,
            "sigma": [0, 0.1],
            "replicates": 3,
            "methods": ["simple", "improved"],
        }
    },
    "submit_reidentification": {
        "application/json": {
            "model": "fopdt",
            "label": "length_m",
            "batch": [{"x": 5, "datasets": [DATASET]}, {"x": 10, "datasets": [PART]}],
            "trend_parameters": ["L"],
            "predict": [7.5],
        }
    },
    "accept_reference": {
        "application/json": {"run": RUN, "by": "A. Engineer", "note": "in spring"}
    },
    "compare_runs": {"application/json": {"runs": [RUN, OTHER_RUN]}},
    "simulate_run": {
        "application/json": {
            "control": {
                "input": "u",
                "output": "y",
                "gain": 0.5,
                "reference": {"kind": "step", "amplitude": 1},
            },
            "samples": 400,
            "sample_time": 0.05,
        }
    },
    **{f"edit_{kind}": {"application/json": _EDIT} for kind in EDITED_KINDS},
    "validate_run": {"application/json": {"dataset": DATASET_ID}},
    "profile_run": {"application/json": {"parameters": ["L"], "points": 5}},
}
"""Body of each operation that has one, by media type."""
