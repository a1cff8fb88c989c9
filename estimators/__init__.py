"""Estimators: from control cycles and recordings to roll angle and parameters. They do no I/O, and no estimate depends
on a clock.

For scripts and notebooks, the batch methods are available here by name, each `method(model, recordings, ...) ->
Estimate`:

    from telemetry.storage import load
    import estimators

    recording = load("sweep.arrow")
    estimators.prediction_error("monocab_roll", [recording])

They are imported on first use, since the control process needs none of them.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

METHODS = {
    "output_error": "estimators.methods.output_error",
    "output_error_simplex": "estimators.methods.output_error",
    "prediction_error": "estimators.methods.prediction_error",
    "least_squares": "estimators.methods.least_squares",
    "instrumental_variables": "estimators.methods.instrumental_variables",
    "frequency_output_error": "estimators.methods.frequency_output_error",
    "frequency_equation_error": "estimators.methods.frequency_equation_error",
    "drive_lag": "estimators.methods.drive_lag",
}
"""Batch methods: name to the module that defines it."""


def __getattr__(name: str) -> Any:
    if name in METHODS:
        return getattr(import_module(METHODS[name]), name)
    raise AttributeError(f"module 'estimators' has no attribute {name!r}")
