"""The EMPS benchmark: mass and friction of a real positioning axis from its position and motor voltage.

    python examples/emps.py [FOLDER]

FOLDER holds emps/emps.csv. Data: Janot, Gautier and Brunot, Data set and reference models of EMPS (2019); columns time
(s), position (m) and motor_voltage (V), 1 kHz, in closed loop. The voltage is held from sample to sample.
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
from upright.models.library.axis import axis
from upright.models.model import Model
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording

FORCE_PER_VOLT = 35.15065
PUBLISHED = {
    "inertia": 95.11,
    "viscous_friction.coefficient": 203.5,
    "coulomb_friction.torque": 20.39,
    "static_torque.torque": 3.16,  # published as a force that the motor has to overcome: -3.16 N
}
CHANNELS = ChannelTable((Channel("position", "m", "of the carriage"), Channel("force", "N", "of the motor on it")))


def load(folder: Path) -> Recording:
    data = np.genfromtxt(folder / "emps" / "emps.csv", delimiter=",", names=True)
    values = {"position": data["position"], "force": FORCE_PER_VOLT * data["motor_voltage"]}
    return Recording(CHANNELS, np.round(data["time"] * 1e9).astype(np.int64), values, source="emps.csv")


def model() -> Model:
    """Mass, viscous friction, Coulomb friction, smoothed over 1 mm/s, and a constant force.

    No random force acts on a test bench: the errors of the equations are modelled as white process noise. A correlated
    random force would have a higher likelihood, since real friction does not change its sign within 1 mm/s, but it
    would be confounded with dry friction while the carriage slides.
    """
    bare = axis(
        name="emps",
        inertia=100.0,
        position_noise=2e-6,
        process_noise=0.1,
        force_scale=50.0,
        position_scale=0.05,
        rate_scale=0.125,
        smooth_rate=1e-3,
        disturbance=None,
    )
    return bare.add("viscous_friction").add("coulomb_friction").add("static_torque")


def identify(folder: Path) -> tuple[list[Estimate], dict[str, Validation]]:
    """The estimates of three methods, and how well each predicts and simulates the record from its first sample on."""
    began, recording = stopwatch(), load(folder)
    fitted = prediction_error.fit(problem(model(), [recording]))
    found = [
        prediction_error.result(fitted, began),
        estimators.least_squares(model(), [recording], bandwidth=2.0 * np.pi * 60.0),
        estimators.output_error(model(), [recording]),
    ]
    candidates = {each.method: each.values for each in found} | {"published": PUBLISHED}
    return found, {name: validate(fitted, [recording], values=values) for name, values in candidates.items()}


if __name__ == "__main__":
    found, validations = identify(Path(sys.argv[1] if len(sys.argv) > 1 else "../shared/data"))
    for estimate in found:
        print(f"{estimate}\n")
    for name, each in validations.items():
        print(f"{name}\n{each}, error {1e3 * each.error['position']:.2f} mm")
