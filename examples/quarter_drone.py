"""A quarter drone: an arm lifted by a propeller, in closed loop; two records are fitted, two others predicted.

    python examples/quarter_drone.py [FOLDER]

FOLDER holds quarter_drone/*.csv: Tempo_s (s), Saida_y (deg, 0 hangs down), Controle_u (% throttle), 100 Hz. The
model is quarter_drone.toml. Degrees are converted to radians. A throttle below zero, at which the propeller stands
still, is set to zero.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from upright.estimators.contract import Estimate
from upright.estimators.fit.problem import problem
from upright.estimators.identify.validation import Validation, validate
from upright.estimators.methods import prediction_error
from upright.estimators.stopwatch import stopwatch
from upright.models.file.model_file import load_model
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording

CHANNELS = ChannelTable((Channel("throttle", "1", "of the propeller"), Channel("angle", "rad", "of the arm")))
FITTED = ("sinal2_degraus", "sinal4_multiseno")
HELD_OUT = ("sinal3_swept_sine", "sinal1_semi_estatica")
START_UP = 5.0
"""s until the filter of the measured angle has settled."""


def load(folder: Path, name: str) -> Recording:
    """One record without the start-up."""
    data = np.genfromtxt(folder / "quarter_drone" / f"{name}_malha_fechada.csv", delimiter=",", names=True)
    data = data[data["Tempo_s"] >= START_UP]
    throttle, angle = np.maximum(data["Controle_u"], 0.0) / 100.0, np.radians(data["Saida_y"])
    time = np.round(data["Tempo_s"] * 1e9).astype(np.int64)
    return Recording(CHANNELS, time, {"throttle": throttle, "angle": angle}, source=name)


def identify(folder: Path) -> tuple[Estimate, dict[str, Validation]]:
    """The fit, and its validation on each record."""
    began = stopwatch()
    model = load_model(Path(__file__).with_suffix(".toml"))
    fitted = prediction_error.fit(problem(model, [load(folder, name) for name in FITTED]))
    estimate = prediction_error.result(fitted, began)
    return estimate, {name: validate(fitted, [load(folder, name)], settle=0.5) for name in (*FITTED, *HELD_OUT)}


if __name__ == "__main__":
    estimate, validations = identify(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data"))
    print(estimate)
    for name, each in validations.items():
        print(f"{name}{' (held out)' if name in HELD_OUT else ''}\n{each}")
