"""From the section of a drive in a vehicle file to its driver's configuration."""

from __future__ import annotations

from pathlib import Path

from upright.drivers.cia402.config import DriveConfig, find_eds
from upright.vehicles.sections import DriveSection, VehicleFile


def drive_config(vehicle: VehicleFile, drive: DriveSection) -> DriveConfig:
    """The driver's configuration of one drive."""
    return DriveConfig(
        name=drive.name,
        role=drive.role,
        follows=vehicle.ROLES[drive.role].follows,
        node=drive.node,
        direction=drive.direction,
        axis_per_turn=drive.axis_per_turn,
        mode=drive.mode,
        increments_per_turn=drive.increments_per_turn,
        velocity_unit_rpm=drive.velocity_unit_rpm,
        rated_torque=drive.rated_torque,
        setpoint_resolution=drive.setpoint_resolution,
        eds=str(find_eds(drive.eds, drive=drive.name, folder=Path(vehicle.path).parent)),
        vendor_id=drive.vendor_id,
        product_code=drive.product_code,
        stop_reaction=drive.stop_reaction,
        sdo_timeout=drive.sdo_timeout,
        mode_timeout=drive.mode_timeout,
        rpdo=tuple(tuple(pdo) for pdo in drive.rpdo),
        tpdo=tuple(tuple(pdo) for pdo in drive.tpdo),
        target_velocity_fine_index=drive.target_velocity_fine_index,
    )
