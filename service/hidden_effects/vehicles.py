"""Vehicles whose parameters differ from their vehicle file within its uncertainty, so that the coverage of the
estimated +- can be checked.

The parameters that the record determines better than the file (inertia, gravity stiffness) are those of the virtual
vehicle, 14 % off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from upright.models.library import get
from upright.simulation.config import SimulationConfig
from upright.simulation.monocab.truth import PlantTruth
from upright.vehicles.file import VehicleFile, load

LATENCY = 0.006
"""Latency of the IMU in the vehicle file, s: it exceeds the maximum deviation, since a true latency is not negative."""
FARTHEST = 2.5
"""Maximum deviation, in standard deviations: larger ones are drawn again."""


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One vehicle: its true physics, and the true `latency` (s) of its IMU."""

    plant: PlantTruth
    latency: float

    @property
    def file(self) -> VehicleFile:
        """The known data: the shipped file, with the latency LATENCY of the IMU."""
        file = load("monocab")
        return file.model_copy(update={"imu": file.imu.model_copy(update={"latency": LATENCY})})

    def configured(self, configuration: SimulationConfig) -> SimulationConfig:
        """The configuration of the virtual vehicle with the true values."""
        return replace(configuration, plant=self.plant, imu=replace(configuration.imu, latency=self.latency))


def drawn(seed: int) -> Vehicle:
    """The vehicle of this seed: each parameter deviates from the file according to its standard deviation, the IMU's
    latency according to the model's uncertainty of the time offset between IMU and drives."""
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
        # The lag of a speed loop is four times its small time constant.
        gimbal_time_constant=0.25 * true("speed_loop_lag"),
    )
    return Vehicle(plant, off(LATENCY, get("monocab_roll").parameter("drive_offset").std))
