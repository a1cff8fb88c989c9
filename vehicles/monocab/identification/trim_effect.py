"""The weight of the trim mass against the angular momentum of the flywheels.

While the vehicle balances, the trim mass moves. Its mass is fitted together with everything that the roll motion
depends on, friction of both kinds included, since friction takes part in holding the weight. `effect` is the fitted
mass over that of the vehicle file: 1 if it weighs on the vehicle what the file says. It is 0 if the mass sticks while
its motor turns, negative if it runs the wrong way, and otherwise tells that angular momentum, gear ratio, lead or mass
are wrong, since only the ratio of weight and angular momentum shows in the motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import hypot, inf

from upright.estimators.methods.prediction_error import prediction_error
from upright.models.model import Model
from upright.telemetry.recording import Recording
from upright.vehicles.commissioning import Number
from upright.vehicles.monocab.file import MonocabFile
from upright.vehicles.monocab.model import MONOCAB_ROLL

MASS = "trim_mass"


def trim_effect(vehicle: MonocabFile, recordings: Sequence[Recording]) -> dict[str, Number]:
    """`trim_effect` with its standard deviation, in which those of the angular momentum and of the mass are. In one of
    `recordings` at least the trim mass has to move. Raises EstimationError."""
    values, deviations = vehicle.parameters.values, vehicle.parameters.deviations
    found = prediction_error(_model(values[MASS]), list(recordings), support=vehicle.support).parameters[MASS]
    if found.value is None or found.std is None:
        return {"trim_effect": Number(value=None)}
    effect = found.value / values[MASS]
    return {"trim_effect": Number(value=effect, std=hypot(found.std, abs(effect) * deviations[MASS]) / values[MASS])}


def _model(mass: float) -> Model:
    """The roll motion with friction, and a trim mass of which nothing is known, not even its sign."""
    free = tuple(replace(each, lower=-inf) if each.name == MASS else each for each in MONOCAB_ROLL.base_parameters)
    model = replace(MONOCAB_ROLL, base_parameters=free)
    for effect in ("static_torque", "coulomb_friction", "viscous_friction"):
        model = model.add(effect)
    estimated = [each.name for each in model.parameters if each.estimated]
    return model.change({}, deviations={MASS: mass}, estimated=[*estimated, MASS])
