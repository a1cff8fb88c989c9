"""The EMPS benchmark: a real positioning axis, its mass and friction from position and motor voltage alone.

    python examples/emps.py emps.csv

Data: Janot, Gautier and Brunot, Data set and reference models of EMPS (2019); columns time (s), position (m) and
motor_voltage (V). Published reference: 95.11 kg, 203.5 N s/m, 20.39 N, -3.16 N.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from estimators.axis_balance import AxisBalance
from estimators.contract import Estimate
from telemetry.channels import Channel, ChannelTable
from telemetry.samples import Frame

FORCE_PER_VOLT = 35.15065
CHANNELS = ChannelTable(
    (
        Channel("position", "m", "of the carriage, from the encoder"),
        Channel("force", "N", "of the motor on the carriage"),
    )
)


def identify(path: Path) -> Estimate:
    """Run the record through the recursive estimator, sample by sample."""
    data = np.genfromtxt(path, delimiter=",", names=True)
    estimator = AxisBalance(CHANNELS)
    for time, position, voltage in zip(data["time"], data["position"], data["motor_voltage"], strict=True):
        estimator.update(Frame(round(time * 1e9), (position, FORCE_PER_VOLT * voltage)))
    return estimator.result()


if __name__ == "__main__":
    for name, parameter in identify(Path(sys.argv[1])).parameters.items():
        print(f"{name:20} {parameter.value:9.3f} +- {parameter.std:.3f} {parameter.unit}")
