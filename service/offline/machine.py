"""Whose recordings are these: the vehicle's of the file, or those of a machine of which there is nothing but a model?

A pendulum on a bench has a model file and no vehicle file. What a vehicle file says (the angle of its supports, CAD
values, controller, experiments) is not its own, and must not be taken for it.
"""

from __future__ import annotations

from estimators.contract import EstimationError
from models.model import Model
from vehicles.registry import nominal_model
from vehicles.sections import VehicleFile


def is_of(model: Model, vehicle: VehicleFile) -> bool:
    """Whether `model` is one of this vehicle: whether it balances the coordinate that the vehicle's own model does."""
    try:
        own = nominal_model(vehicle.vehicle.kind)
    except EstimationError:
        return False
    return [joint.coordinate for joint in model.joints[:1]] == [joint.coordinate for joint in own.joints[:1]]


def support_of(model: Model, vehicle: VehicleFile) -> float | None:
    """rad, the angle at which the supports carry; None for a machine that is not the vehicle."""
    return vehicle.support if is_of(model, vehicle) else None


def name_of(model: Model, vehicle: VehicleFile) -> str:
    """What a report is on: the vehicle's id, or the model's name."""
    return vehicle.vehicle.id if is_of(model, vehicle) else model.name
