"""Convert the sections of a checked vehicle file to the configurations of drivers and estimators, in one place.

Drivers, estimators, models and the simulation are independent of vehicle files; each has a configuration of its own.
"""

from __future__ import annotations

import json
import math
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from upright.drivers.cia402.drive import Drive
from upright.drivers.imu.imu import Imu
from upright.drivers.imu.layout import ImuConfig
from upright.drivers.observed_speed import ObservedSpeed
from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.roll_filter import RollFilter, RollFilterConfig
from upright.telemetry.channels import ChannelTable
from upright.vehicles import registry
from upright.vehicles.drives import drive_config
from upright.vehicles.sections import VehicleFile


@cache
def version() -> str:
    """Version of this software."""
    return metadata.version("upright")


def channels(vehicle: VehicleFile) -> ChannelTable:
    """The channel table of a vehicle."""
    return registry.recorded(vehicle)


def imu_config(vehicle: VehicleFile) -> ImuConfig:
    """The driver's configuration of the IMU."""
    imu = vehicle.imu
    return ImuConfig(
        protocol=imu.protocol,
        base_id=imu.base_id,
        precision=imu.precision,
        slots=tuple(imu.slots),
        rate=float(vehicle.control.rate),
        axes=imu.axes,
        acceleration_sign=imu.acceleration_sign,
        angular_rate_unit=imu.angular_rate_unit,
        acceleration_range=imu.acceleration_range,
        angular_rate_range=math.radians(imu.angular_rate_range_deg),
        latency=imu.latency,
        angular_rate_change=math.inf
        if imu.angular_rate_change_deg is None
        else math.radians(imu.angular_rate_change_deg),
    )


def vehicle_io(vehicle: VehicleFile) -> VehicleIo:
    """The IMU, the drives and the observed speeds of a vehicle, without measurements yet."""
    return VehicleIo(
        Imu(imu_config(vehicle)),
        [Drive(drive_config(vehicle, drive)) for drive in vehicle.drive],
        [ObservedSpeed(each) for each in vehicle.observed],
    )


def roll_filter(vehicle: VehicleFile) -> RollFilter:
    """The roll Kalman filter of a vehicle, not yet started."""
    section = vehicle.imu.filter
    return RollFilter(
        RollFilterConfig(
            rate=float(vehicle.control.rate),
            acceleration_std=section.acceleration_std,
            angular_rate_density=section.angular_rate_density,
            bias_random_walk=section.bias_random_walk,
            position=vehicle.imu.position,
        )
    )


def observer_hello(
    vehicle: VehicleFile, data: Path, raw_log_buses: list[str], metrics_port: int = 0, foxglove_port: int = 0
) -> dict[str, Any]:
    """The data about the vehicle that the observer process needs. A port is 0 if nothing is served there."""
    return {
        "vehicle": vehicle.vehicle.id,
        "kind": vehicle.vehicle.kind,
        "channels": list(channels(vehicle).names),
        "version": version(),
        "configuration_hash": vehicle.configuration_hash,
        "rate": vehicle.control.rate,
        "support": vehicle.support,
        "parameters": {name: getattr(vehicle.parameters, name).model_dump() for name in vehicle.parameters.values},
        "mqtt": vehicle.mqtt.model_dump(),
        "data": str(data),
        "raw_log_buses": raw_log_buses,
        "metrics_port": metrics_port,
        "foxglove_port": foxglove_port,
    }


def recording_metadata(vehicle: VehicleFile, experiment: str) -> dict[str, str]:
    """The metadata of a recording, sufficient to read, replay and compare it without further information."""
    return {
        "vehicle": vehicle.vehicle.id,
        "kind": vehicle.vehicle.kind,
        "experiment": experiment,
        "experiment_definition": vehicle.experiments[experiment].model_dump_json(exclude_none=True),
        "parameters": json.dumps(vehicle.parameters.values),
        "configuration_hash": vehicle.configuration_hash,
        "vehicle_file": Path(vehicle.path).name,
        "version": version(),
        "rate": str(vehicle.control.rate),
        "support": repr(vehicle.support),
    }


def bus_load(vehicle: VehicleFile) -> dict[str, float]:
    """Load of each bus in operation, in percent of the bit rate, with worst-case bit stuffing."""
    rate, bits = vehicle.control.rate, dict.fromkeys((vehicle.bus.drives, vehicle.bus.imu), 0.0)
    bits[vehicle.bus.imu] += rate * len(imu_config(vehicle).can_ids) * _frame_bits(8)
    bits[vehicle.bus.drives] += rate * _frame_bits(0) + _frame_bits(1) / vehicle.control.heartbeat_period
    for section in vehicle.drive:
        config = drive_config(vehicle, section)
        for codec in (*config.rpdo_codecs.values(), *config.tpdo_codecs.values()):
            bits[vehicle.bus.drives] += rate * _frame_bits(codec.size)
    return {bus: 100.0 * load / vehicle.bus.bitrate for bus, load in bits.items()}


def _frame_bits(length: int) -> int:
    """Bits of a classical CAN frame with an 11-bit id and `length` data bytes, with worst-case bit stuffing."""
    return 47 + 8 * length + (34 + 8 * length - 1) // 4
