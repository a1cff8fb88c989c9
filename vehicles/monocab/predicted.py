"""The MONOCAB's experiments as the diagnosis predicts them: its controller, excitation and limits around a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import degrees, radians

from upright.diagnosis.prediction.actuator_motion import ActuatorMotion, motion_of
from upright.diagnosis.prediction.closed_loop import Controller, Experiment, Limit
from upright.estimators.data.segments import SUPPORT_MARGIN
from upright.estimators.speed_loop_steps import SpeedLoopSteps
from upright.models.control_design.lqi import ControlDesignError
from upright.models.control_design.robustness import CheckedDesign
from upright.models.gravity import GRAVITY
from upright.models.model import Model
from upright.vehicles.experiment.excitation import Excitation, ExcitationError, make_excitation
from upright.vehicles.monocab.control.controller import RollController, design
from upright.vehicles.monocab.control.full import FullController, FullState, full_if_used
from upright.vehicles.monocab.control.linear_model import MonocabParameters
from upright.vehicles.monocab.control.roll_design import RollDesign
from upright.vehicles.monocab.control.speed_loop import speed_loops
from upright.vehicles.monocab.file import FULL, MonocabFile
from upright.vehicles.monocab.gimbals import COMMAND
from upright.vehicles.monocab.handling import entering
from upright.vehicles.sections import ExperimentSection

NEEDS = frozenset({"roll", "roll_rate"})
"""Outputs of a model that the controller needs."""
GIVES = frozenset(
    {
        "precession_rate_setpoint",
        "precession_rate",
        "precession",
        "trim_position",
        "trim_rate",
        "trim_rate_setpoint",
    }
)
"""Inputs of a model that the loop provides."""


def predictor(vehicle: MonocabFile) -> Callable[[str], Experiment]:
    """A function that predicts the experiment of a name. It raises ExcitationError if its signal is impossible."""
    reduced = design(vehicle)
    full = full_if_used(vehicle)
    return lambda name: _experiment(name, vehicle.experiments[name], vehicle, reduced, full)


def _experiment(
    name: str,
    section: ExperimentSection,
    vehicle: MonocabFile,
    reduced: RollDesign,
    full: CheckedDesign | ControlDesignError | None,
) -> Experiment:
    excitation = make_excitation(section, float(vehicle.control.rate))
    limits = vehicle.limits
    upright = min(vehicle.support - SUPPORT_MARGIN, radians(limits.roll_deg))
    turn = degrees(1.0)

    def shorter(duration: float) -> Experiment | None:
        if duration >= section.duration:
            return None
        try:
            return _experiment(name, section.model_copy(update={"duration": duration}), vehicle, reduced, full)
        except ExcitationError:
            return None

    controller = partial(_loop, vehicle, reduced, excitation)
    if isinstance(full, ControlDesignError) and section.controller == FULL:
        what = f"there is no {FULL} one ({full})"
        raise ExcitationError("controller", what, remedy="change its weights or the control rate.")
    if isinstance(full, CheckedDesign) and section.controller == FULL:
        controller = partial(_full_loop, vehicle, full, excitation)
    return Experiment(
        name=name,
        parameters=section.model_dump(exclude_none=True, exclude={"title"}),
        duration=excitation.duration,
        period=vehicle.period,
        controller=controller,
        limits=(
            Limit("roll", upright, "deg", "at which the supports carry", turn),
            Limit("roll_rate", radians(limits.roll_rate_deg), "deg/s", "of limits.roll_rate_deg", turn),
            Limit("precession", radians(limits.precession_budget_deg), "deg", "of limits.precession_budget_deg", turn),
            Limit("precession_rate_setpoint", limits.precession_rate, "rad/s", "of limits.precession_rate"),
            Limit("setpoint_slope", limits.precession_acceleration, "rad/s^2", "of limits.precession_acceleration"),
            Limit("trim_position", limits.trim_position, "m", "of limits.trim_position"),
        ),
        shorter=shorter,
    )


def _gimbals(
    model: Model, excitation: Excitation, period: float, follow: Callable[[float], float]
) -> Callable[[float, Mapping[str, float]], float]:
    """The precession rate at the next sample, from the setpoint and what is seen: by the model of the actuators that
    belongs to `model`, or else by how they `follow` a setpoint."""
    actuators = motion_of(model, COMMAND)
    if actuators is None:
        return lambda setpoint, seen: follow(setpoint)
    motion = ActuatorMotion(actuators, period, round(excitation.duration / period) + 1, 0.0)
    return lambda setpoint, seen: motion.step(setpoint, seen)["precession_rate"]


def _full_loop(vehicle: MonocabFile, design: CheckedDesign, excitation: Excitation, model: Model) -> Controller:
    """The full controller with the excitation in it, and gimbals and trim mass, for models whose input is their motion.

    Their drives follow as the controller computes it. The trim mass also yields to its weight as the vehicle leans, and
    to its inertia as the vehicle rolls about the rail below it, as far as a speed loop by the symmetric optimum does
    whose motor and screw weigh nothing.
    """
    controller = FullController.from_design(design, vehicle)
    controller.take_over(FullState(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0)
    _, speed_loop = speed_loops(design.gains)

    def follow(setpoint: float) -> float:
        speed_loop.step(setpoint)
        return speed_loop.rate

    period, parameters = vehicle.period, MonocabParameters.from_values(vehicle.parameters.values)
    lag, height = parameters.trim_lag, parameters.trim_height
    trim = SpeedLoopSteps(lag, 0.0, 0.5 * lag**2, period, 0.0)
    gimbals = _gimbals(model, excitation, period, follow)
    trim_position = precession = precession_rate = trim_rate = roll_rate = 0.0

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal trim_position, precession, precession_rate, trim_rate, roll_rate
        value, before = excitation.value(time), controller.setpoint
        reference, output, of_trim = entering(excitation.at, value)
        precession = seen.get("precession", precession)
        rate = seen.get("precession_rate", precession_rate)
        state = FullState(seen["roll"] - reference, seen["roll_rate"], trim_position, trim_rate, precession, rate)
        controller.step(state, period, output)
        trim_before, rate_before = trim_rate, precession_rate
        pushed = GRAVITY * seen["roll"] - height * (seen["roll_rate"] - roll_rate) / period
        roll_rate = seen["roll_rate"]
        trim_rate = trim.step(controller.trim_setpoint + of_trim, -pushed)
        precession_rate = gimbals(controller.setpoint, seen)
        trim_position += 0.5 * period * (trim_before + trim_rate)
        precession += 0.5 * period * (rate_before + precession_rate)
        return {
            "precession_rate_setpoint": controller.setpoint,
            "precession_rate": precession_rate,
            "precession": precession,
            "trim_position": trim_position,
            "trim_rate": trim_rate,
            "trim_rate_setpoint": controller.trim_setpoint + of_trim,
            "setpoint_slope": (controller.setpoint - before) / period,
        }

    return step


def _loop(vehicle: MonocabFile, gains: RollDesign, excitation: Excitation, model: Model) -> Controller:
    """The vehicle's controller with the excitation in it, and the gimbals, for models whose input is their motion."""
    controller = RollController.from_design(gains, vehicle)
    period = vehicle.period
    lags = gains.parameters.speed_loop_lag, gains.parameters.trim_lag
    speed_loop, trim = (SpeedLoopSteps(lag, 0.0, 0.0, period, 0.0) for lag in lags)
    rate = precession = before = trim_rate = trim_position = 0.0
    gimbals = _gimbals(model, excitation, period, lambda setpoint: speed_loop.step(setpoint, 0.0))

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal rate, precession, before, trim_rate, trim_position
        rate = seen.get("precession_rate", rate)
        precession = seen.get("precession", precession)
        reference, output, of_trim = entering(excitation.at, excitation.value(time))
        setpoint = controller.step(seen["roll"], seen["roll_rate"], rate, precession, reference, period, output)
        after = gimbals(setpoint, seen)
        precession += 0.5 * period * (rate + after)
        rate = after
        trim_after = trim.step(of_trim, 0.0)
        trim_position += 0.5 * period * (trim_rate + trim_after)
        trim_rate = trim_after
        slope, before = (setpoint - before) / period, setpoint
        return {
            "precession_rate_setpoint": setpoint,
            "precession_rate": rate,
            "precession": precession,
            "trim_position": trim_position,
            "trim_rate": trim_rate,
            "trim_rate_setpoint": of_trim,
            "setpoint_slope": slope,
        }

    return step
