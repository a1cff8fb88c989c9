"""The balancing robot's experiments as the diagnosis predicts them: its controller, excitation and limits around a
model.

The drives' values are 4 ms old at the sample in which the controller uses them. Only the slow outer loop uses them, so
a prediction takes them as those of the sample itself.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from math import degrees, radians

from upright.diagnosis.prediction.closed_loop import Controller, Experiment, Limit
from upright.estimators.data.segments import SUPPORT_MARGIN
from upright.models.model import Model
from upright.vehicles.experiment.excitation import Excitation, ExcitationError, make_excitation
from upright.vehicles.experiment.phases import DURATIONS, Phase
from upright.vehicles.sections import ExperimentSection
from upright.vehicles.twsbr.controller import TiltController
from upright.vehicles.twsbr.file import TwsbrFile

NEEDS = frozenset({"tilt", "tilt_rate", "left_wheel_angle", "right_wheel_angle", "left_wheel_rate", "right_wheel_rate"})
"""Outputs of a model that the controller needs."""
GIVES = frozenset({"left_voltage", "right_voltage"})
"""Inputs of a model that the loop provides."""
HARDEST_TO_SEPARATE = ("coulomb_friction@wheels", "viscous_friction@wheels")
"""The effects that a record too poor for a diagnosis distinguishes least: friction of the gears."""


def assumed(model: Model) -> Model:
    """`model` with the delays of its voltages at one standard deviation of the model's, unless they were identified.

    They never reach the motors at the instant of their sample, and the controller's gains are as large as 200 Hz allow:
    without the millisecond of the bus its loop oscillates from sample to sample.
    """
    late = {name for each in model.inputs if each.name in GIVES for name in each.delays}
    return model.change({name: model.parameter(name).std for name in late if model.parameter(name).value == 0.0})


def predictor(vehicle: TwsbrFile) -> Callable[[str], Experiment]:
    """A function that predicts the experiment of a name. It raises ExcitationError if its signal is impossible."""
    return lambda name: _experiment(name, vehicle.experiments[name], vehicle)


def _experiment(name: str, section: ExperimentSection, vehicle: TwsbrFile) -> Experiment:
    excitation = make_excitation(section, float(vehicle.control.rate))
    limits = vehicle.limits
    turn = degrees(1.0)
    upright, floor = radians(limits.upright_deg), vehicle.support - SUPPORT_MARGIN
    leaning = "of limits.upright_deg" if upright < floor else "at which the bumpers carry"

    def shorter(duration: float) -> Experiment | None:
        if duration >= section.duration:
            return None
        try:
            return _experiment(name, section.model_copy(update={"duration": duration}), vehicle)
        except ExcitationError:
            return None

    return Experiment(
        name=name,
        parameters=section.model_dump(exclude_none=True, exclude={"title"}),
        duration=excitation.duration,
        period=vehicle.period,
        controller=lambda model: _loop(vehicle, excitation),
        limits=(
            Limit("tilt", min(upright, floor), "deg", leaning, turn),
            Limit("tilt_rate", radians(limits.tilt_rate_deg), "deg/s", "of limits.tilt_rate_deg", turn),
            Limit("left_wheel_rate", limits.wheel_rate, "rad/s", "of limits.wheel_rate"),
            Limit("right_wheel_rate", limits.wheel_rate, "rad/s", "of limits.wheel_rate"),
            Limit("voltage", limits.voltage, "V", "of limits.voltage"),
            Limit("travel", limits.travel_budget, "m", "of limits.travel_budget"),
        ),
        settling=DURATIONS[Phase.SETTLE],
        shorter=shorter,
    )


def _loop(vehicle: TwsbrFile, excitation: Excitation) -> Controller:
    """The robot's controller with the excitation in it; both motors get the same voltage."""
    controller = TiltController.of(vehicle)
    on_reference, period = excitation.on_reference, vehicle.period
    radius = vehicle.parameters.wheel_radius.value

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        value = excitation.value(time)
        tilt, tilt_rate = seen["tilt"], seen["tilt_rate"]
        travel = radius * 0.5 * (seen["left_wheel_angle"] + seen["right_wheel_angle"])
        speed = radius * (0.5 * (seen["left_wheel_rate"] + seen["right_wheel_rate"]) + tilt_rate)
        voltage = controller.step(
            tilt,
            tilt_rate,
            travel + radius * tilt,
            speed,
            value if on_reference else 0.0,
            period,
            0.0 if on_reference else value,
        )
        return {"left_voltage": voltage, "right_voltage": voltage, "voltage": voltage, "travel": travel}

    return step
