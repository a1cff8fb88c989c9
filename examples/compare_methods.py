"""The paper's comparison of methods (figure 3), with a virtual vehicle whose true parameters are known.

    python examples/compare_methods.py [PICTURE]

The recordings are steps from rest for the time domain, and sweeps of the roll reference for the frequency domain, with
a static torque of 120 N m, which a transfer function cannot describe. The paper states neither the noise of its gyro on
the frame nor the bandwidth of its state-variable filter; both determine the bias of least squares, see
docs/explanation/methods.md. Takes two minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from math import tau
from pathlib import Path
from typing import Any

from upright.diagnosis.report.figures.methods import save_methods
from upright.estimators.identify.run import identify, with_values
from upright.service.pages.identify import print_methods
from upright.service.virtual.run import record
from upright.simulation.config import SimulationConfig
from upright.simulation.monocab.truth import PlantTruth
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model, of

VEHICLE = load("monocab")
PLANT = PlantTruth()
TRUTH = {"inertia": PLANT.inertia, "gravity_stiffness": PLANT.gravity_stiffness}
NOISE = 1e-4  # rad/s/sqrt(Hz), of the gyro: three times its data sheet, for a frame with running flywheels
BANDWIDTH = tau * 20.0  # rad/s, of the state-variable filter: twice the highest frequency of the paper's sweep


def noisy(vehicle: SimulationConfig) -> SimulationConfig:
    return replace(vehicle, imu=replace(vehicle.imu, angular_rate_density=NOISE))


def runs(steps: int = 4, sweeps: int = 3, seconds: float = 60.0) -> list[Recording]:
    """Recordings of so many steps from rest, and of so many sweeps `seconds` long."""
    wanted = [("step", None)] * steps + [("sweep", seconds)] * sweeps
    return [
        record(VEHICLE, name, hide=["static_torque=1"], seed=seed, duration=duration, configure=noisy)
        for seed, (name, duration) in enumerate(wanted, start=1)
    ]


def compare(recordings: Sequence[Recording], methods: Sequence[str] = ()) -> dict[str, Any]:
    """The document of `upright identify --json` for these recordings."""
    parameters, support = VEHICLE.parameters, VEHICLE.support
    model = with_values(nominal_model("monocab"), parameters.values, parameters.deviations)
    own = of("monocab").identification()
    known = {"deviations": parameters.deviations, "bandwidth": BANDWIDTH, "model": model, "own": own}
    return identify(recordings, parameters.values, support, methods, **known)


if __name__ == "__main__":
    document = compare(runs())
    print_methods(document, TRUTH)
    save_methods(document, Path(sys.argv[1] if len(sys.argv) > 1 else "methods.png"), truth=TRUTH)
