"""Estimators: from control cycles and recordings to roll angle and parameters. They do no I/O, and no estimate depends
on a clock.

For scripts and notebooks, the batch methods are available here by name, each `method(model, recordings, ...) ->
Estimate`:

    from upright.telemetry.storage import load
    from upright import estimators

    recording = load("sweep.arrow")
    estimators.prediction_error("monocab_roll", [recording])

They are imported on first use, since the control process needs none of them.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

METHODS = {
    "output_error": "upright.estimators.methods.output_error",
    "output_error_simplex": "upright.estimators.methods.output_error",
    "prediction_error": "upright.estimators.methods.prediction_error",
    "least_squares": "upright.estimators.methods.least_squares",
    "instrumental_variables": "upright.estimators.methods.instrumental_variables",
    "frequency_output_error": "upright.estimators.methods.frequency_output_error",
    "frequency_equation_error": "upright.estimators.methods.frequency_equation_error",
    "drive_lag": "upright.estimators.methods.drive_lag",
}
"""Batch methods: name to the module that defines it."""


def __getattr__(name: str) -> Any:
    if name in METHODS:
        return getattr(import_module(METHODS[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
