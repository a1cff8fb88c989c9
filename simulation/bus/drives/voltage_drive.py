"""A DC motor controller whose master sets the voltage: mode -1, of upright_motor.eds.

2400h is the mean voltage at the motor in mV, from the next SYNC on; 2401h is the voltage that the bridge outputs for it
at the nominal supply. Without power the bridge is open. A stop under power applies 0 V to the motor, which shorts it,
until it stands still.
"""

from __future__ import annotations

from upright.simulation.bus.drives.free_drive import FreeDrive
from upright.simulation.bus.objects import TARGET_VOLTAGE, VOLTAGE_DEMAND
from upright.simulation.config import DriveNode

VOLTAGE = -1


class VoltageDrive(FreeDrive):
    """A motor controller that applies a voltage to its axis."""

    modes = (VOLTAGE,)
    TARGET, DEMAND = TARGET_VOLTAGE, VOLTAGE_DEMAND

    @staticmethod
    def _unit_of(config: DriveNode) -> float:
        return config.direction * 1e-3

    def _braking(self) -> float:
        return 0.0
