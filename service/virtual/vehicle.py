"""The virtual vehicle of a vehicle file: its configuration, and its run on the buses of the command line.

The simulation is independent of vehicle files and bus addresses. This module connects it with both, and selects the
physics by the kind of vehicle.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace

from upright.drivers.bus.address import connect
from upright.drivers.cia402.config import find_eds
from upright.simulation import runner
from upright.simulation.config import DriveNode, ImuNode, SimulationConfig, SpeedNode
from upright.simulation.faults import Fault
from upright.simulation.physics.disturbance import Disturbance
from upright.simulation.physics.load import Action
from upright.simulation.registry import parse_disturbance, parse_hidden, parse_narrow_band
from upright.simulation.runner import RunStatistics
from upright.vehicles import registry
from upright.vehicles.sections import VehicleFile


def usual_disturbance(vehicle: VehicleFile) -> Disturbance:
    """The default random disturbance of a virtual vehicle that a user starts: level 1. Programs and tests define their
    own."""
    return registry.of(vehicle.vehicle.kind).twin().truth.registry.disturbance


def requested_disturbance(vehicle: VehicleFile, hide: list[str]) -> Disturbance | None:
    """The random disturbance of a virtual vehicle that a user starts with `hide`. Raises UnknownEffectError."""
    hidden = registry.of(vehicle.vehicle.kind).twin().truth.registry
    return parse_disturbance(hide, hidden, usual_disturbance(vehicle))[1]


def configuration(
    vehicle: VehicleFile, hide: list[str], seed: int, *, disturbance: Disturbance | None = None
) -> SimulationConfig:
    """The virtual vehicle with the communication of this vehicle file. Its physics do not depend on the file's CAD
    values.

    It has the random `disturbance` unless `hide` defines one.
    Raises UnknownEffectError if `hide` names an unknown effect.
    """
    imu, twin = vehicle.imu, registry.of(vehicle.vehicle.kind).twin()
    drives = [
        DriveNode(
            name=drive.name,
            role=drive.role,
            node=drive.node,
            direction=drive.direction,
            axis_per_turn=drive.axis_per_turn,
            increments_per_turn=drive.increments_per_turn,
            velocity_unit_rpm=drive.velocity_unit_rpm,
            rated_torque=drive.rated_torque,
            eds=find_eds(twin.eds, drive=drive.name),
            mode=drive.mode,
            vendor_id=drive.vendor_id,
            product_code=drive.product_code,
            rpdo=drive.rpdo,
            tpdo=drive.tpdo,
        )
        for drive in vehicle.drive
    ]
    node = ImuNode(
        protocol=imu.protocol,
        base_id=imu.base_id,
        precision=imu.precision,
        slots=imu.slots,
        axes=imu.axes,
        acceleration_sign=imu.acceleration_sign,
        angular_rate_unit=imu.angular_rate_unit,
        position=imu.position,
        latency=imu.latency,
    )
    effects, disturbance = parse_disturbance(hide, twin.truth.registry, disturbance)
    effects, narrow_band = parse_narrow_band(effects, twin.truth.registry)
    hidden, onsets = parse_hidden(effects, twin.truth.registry)
    return SimulationConfig(
        drives=drives,
        imu=node,
        speeds=[SpeedNode(each.can_id, each.start_byte, each.layout, each.unit) for each in vehicle.observed],
        plant=twin.truth,
        rate=vehicle.control.rate,
        seed=seed,
        hidden=hidden,
        onsets=onsets,
        disturbance=disturbance,
        narrow_band=narrow_band,
    )


def before_commissioning(vehicle: VehicleFile) -> Callable[[SimulationConfig], SimulationConfig]:
    """What a virtual vehicle is like before it is commissioned: its flywheels stand if an experiment spins them up."""
    spun_up = any(each.spin is not None and each.spin.up for each in vehicle.experiments.values())
    return lambda configuration: replace(configuration, flywheels_stand=spun_up)


def run(
    config: SimulationConfig,
    drives: str,
    imu: str,
    *,
    stop: threading.Event,
    lock_step: bool = False,
    faults: Sequence[Fault] = (),
    load: Callable[[], Action | None] = runner.nothing,
) -> RunStatistics:
    """Run a virtual vehicle on the buses at the addresses `drives` and `imu` (IFACE:CHANNEL) until `stop` is set.
    `load()` is asked every cycle what is on the vehicle.

    Raises:
        BusError: an address is wrong, or its interface is not there.
    """
    with ExitStack() as open_buses:
        bus = open_buses.enter_context(connect(drives, None, None))
        imu_bus = open_buses.enter_context(connect(imu, None, None)) if imu != drives else None
        return runner.run(config, bus, imu_bus=imu_bus, lock_step=lock_step, stop=stop, faults=faults, load=load)
