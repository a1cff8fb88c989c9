"""The virtual vehicle of a vehicle file: its configuration, and running it on the buses of the command line.

The simulation knows no vehicle files and no bus addresses; this is where it gets both.
"""

from __future__ import annotations

from drivers.cia402.config import find_eds
from service.vehicle_file import VehicleFile
from simulation.config import DriveNode, ImuNode, SimulationConfig
from simulation.hidden import parse_hidden


def configuration(vehicle: VehicleFile, hide: list[str], seed: int) -> SimulationConfig:
    """The virtual vehicle that speaks as this vehicle file says. Its physics are its own, not the file's CAD values.

    Raises UnknownEffectError for a `hide` that names no hidden effect.
    """
    imu = vehicle.imu
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
            eds=find_eds("upright_servo.eds", drive=drive.name),
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
    )
    return SimulationConfig(drives=drives, imu=node, rate=vehicle.control.rate, seed=seed, hidden=parse_hidden(hide))
