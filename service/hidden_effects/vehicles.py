"""Vehicles that differ from their vehicle file by what it says of itself: no two are alike, and what is told with a +-
holds in 95 % of them or does not.

What the record tells better than the file (inertia, gravity stiffness) is the virtual vehicle's own, 14 % off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from models.library import get
from simulation.config import SimulationConfig
from simulation.monocab.truth import PlantTruth
from vehicles.file import VehicleFile, load

LATENCY = 0.006
"""s of the IMU, as the vehicle file has it: more than the real one may be shorter by, for no IMU tells the future."""
FARTHEST = 2.5
"""Standard deviations: a vehicle that is further off is none of these."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One of them: its physics, and the `latency` (s) of its IMU, as they really are."""

    plant: PlantTruth
    latency: float

    @property
    def file(self) -> VehicleFile:
        """What is known of it: the shipped file, with an IMU that is LATENCY late."""
        file = load("monocab")
        return file.model_copy(update={"imu": file.imu.model_copy(update={"latency": LATENCY})})

    def configured(self, configuration: SimulationConfig) -> SimulationConfig:
        """The virtual vehicle as it really is."""
        return replace(configuration, plant=self.plant, imu=replace(configuration.imu, latency=self.latency))


def drawn(seed: int) -> Vehicle:
    """The vehicle of this seed: each number as far from the file's as its standard deviation says, the IMU's latency as
    far as the model says that its instants and the drives' are known."""
    random = np.random.default_rng(seed)
    known = load("monocab").parameters

    def off(value: float, deviation: float) -> float:
        while abs(offset := random.standard_normal()) > FARTHEST:
            pass
        return value + offset * deviation

    def true(name: str) -> float:
        return off(known.values[name], known.deviations[name])

    plant = PlantTruth(
        angular_momentum=true("angular_momentum"),
        trim_mass=true("trim_mass"),
        trim_height=true("trim_height"),
        gimbal_inertia=true("gimbal_inertia"),
        # A speed loop lags by four of its small time constants.
        gimbal_time_constant=0.25 * true("speed_loop_lag"),
    )
    return Vehicle(plant, off(LATENCY, get("monocab_roll").parameter("drive_offset").std))
