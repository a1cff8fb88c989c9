"""The fault table: every fault, by where it is."""

from __future__ import annotations

from faults.fault import Fault
from faults.scenarios import bus, daemon, drives, imu, plant, second_master

FAULTS: tuple[Fault, ...] = (
    *imu.FAULTS,
    *drives.FAULTS,
    *bus.FAULTS,
    *second_master.FAULTS,
    *daemon.FAULTS,
    *plant.FAULTS,
)
