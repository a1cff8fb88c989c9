"""The cube's experiments as the diagnosis predicts them: its controller, excitation and limits around a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import degrees, radians

from upright.diagnosis.prediction.closed_loop import Controller, Experiment, Limit
from upright.estimators.data.segments import SUPPORT_MARGIN
from upright.models.control_design.lqi import LqiGains
from upright.models.model import Model
from upright.vehicles.cube.controller import WheelController, design
from upright.vehicles.cube.file import CubeFile
from upright.vehicles.experiment.excitation import Excitation, ExcitationError, make_excitation
from upright.vehicles.experiment.phases import DURATIONS, Phase
from upright.vehicles.sections import ExperimentSection

NEEDS = frozenset({"tilt", "tilt_rate", "wheel_rate"})
"""Outputs of a model that the controller needs."""
GIVES = frozenset({"torque"})
"""Inputs of a model that the loop provides."""
HARDEST_TO_SEPARATE = ("coulomb_friction@wheel", "viscous_friction@wheel")
"""The effects that a record too poor for a diagnosis distinguishes least: friction of the bearings."""


def assumed(model: Model) -> Model:
    """`model` with the delay of its torque at one standard deviation of the model's, unless it was identified."""
    late = {name for each in model.inputs if each.name in GIVES for name in each.delays}
    return model.change({name: model.parameter(name).std for name in late if model.parameter(name).value == 0.0})


def predictor(vehicle: CubeFile) -> Callable[[str], Experiment]:
    """A function that predicts the experiment of a name. It raises ExcitationError if its signal is impossible."""
    gains = design(vehicle).gains
    return lambda name: _experiment(name, vehicle.experiments[name], vehicle, gains)


def _experiment(name: str, section: ExperimentSection, vehicle: CubeFile, gains: LqiGains) -> Experiment:
    excitation = make_excitation(section, float(vehicle.control.rate))
    limits = vehicle.limits
    turn = degrees(1.0)
    upright, floor = radians(limits.upright_deg), vehicle.support - SUPPORT_MARGIN
    leaning = "of limits.upright_deg" if upright < floor else "at which the supports carry"

    def shorter(duration: float) -> Experiment | None:
        if duration >= section.duration:
            return None
        try:
            return _experiment(name, section.model_copy(update={"duration": duration}), vehicle, gains)
        except ExcitationError:
            return None

    return Experiment(
        name=name,
        parameters=section.model_dump(exclude_none=True, exclude={"title"}),
        duration=excitation.duration,
        period=vehicle.period,
        controller=lambda model: _loop(vehicle, gains, excitation),
        limits=(
            Limit("tilt", min(upright, floor), "deg", leaning, turn),
            Limit("tilt_rate", radians(limits.tilt_rate_deg), "deg/s", "of limits.tilt_rate_deg", turn),
            Limit("wheel_rate", limits.wheel_rate_budget, "rad/s", "of limits.wheel_rate_budget"),
            Limit("torque", limits.torque, "N m", "of limits.torque"),
        ),
        settling=DURATIONS[Phase.SETTLE],
        shorter=shorter,
    )


def _loop(vehicle: CubeFile, gains: LqiGains, excitation: Excitation) -> Controller:
    """The cube's controller with the excitation in it."""
    controller, period = WheelController(gains, vehicle.limits.torque), vehicle.period

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        held = seen["tilt"], seen["tilt_rate"], seen["wheel_rate"]
        return {"torque": controller.step(*held, period, excitation.value(time))}

    return step
