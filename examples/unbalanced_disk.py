"""An unbalanced disk on a DC motor: a pendulum model from a text file, fitted to one part of a record, validated on
another.

    python examples/unbalanced_disk.py [FOLDER]

FOLDER holds unbalanced_disk/training-val-test-data.npz: `u` V and `th` rad (0 hangs down), every 25 ms. The first 250 s
are fitted, the last 175 s are held out. The model is unbalanced_disk.toml.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from upright import estimators
from upright.estimators.contract import Estimate
from upright.estimators.fit.problem import problem
from upright.estimators.identify.validation import Validation, validate
from upright.estimators.methods import prediction_error
from upright.estimators.stopwatch import stopwatch
from upright.models.file.model_file import load_model
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording

CHANNELS = ChannelTable((Channel("voltage", "V", "of the motor"), Channel("angle", "rad", "of the disk")))


def load(folder: Path) -> tuple[Recording, Recording]:
    """The part that is fitted, and the part that is held out."""
    data = np.load(folder / "unbalanced_disk" / "training-val-test-data.npz")

    def part(rows: slice) -> Recording:
        time = np.arange(len(data["u"]), dtype=np.int64)[rows] * 25_000_000
        return Recording(CHANNELS, time, {"voltage": data["u"][rows], "angle": data["th"][rows]}, source="disk")

    return part(slice(0, 10_000)), part(slice(28_000, 35_000))


def identify(folder: Path) -> dict[str, tuple[Estimate, Validation]]:
    """Estimates by prediction error and, starting from these, by output error, each validated on the held-out part."""
    train, held_out = load(folder)
    began = stopwatch()
    model = load_model(Path(__file__).with_suffix(".toml"))
    fitted = prediction_error.fit(problem(model, [train]))
    predicted = prediction_error.result(fitted, began)
    simulated = estimators.output_error(model.change(predicted.values), [train])
    return {
        each.method: (each, validate(fitted, [held_out], values=each.values, settle=1.0))
        for each in (predicted, simulated)
    }


if __name__ == "__main__":
    for estimate, held_out in identify(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data")).values():
        print(f"{estimate}\nheld-out part:\n{held_out}\n")
