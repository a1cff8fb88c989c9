"""The MONOCAB's experiments as the diagnosis predicts them: its controller, excitation and limits around a model."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import degrees, expm1, radians

from diagnosis.prediction.closed_loop import Controller, Experiment, Limit
from estimators.data.segments import SUPPORT_MARGIN
from vehicles.excitation import Excitation, ExcitationError, make_excitation
from vehicles.monocab.control.controller import RollController, design
from vehicles.monocab.control.roll_design import RollDesign
from vehicles.monocab.file import FULL, REDUCED, MonocabFile
from vehicles.sections import ExperimentSection

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
    """A function that predicts the experiment of a name. It raises ExcitationError if its signal is impossible, or if
    the trim mass takes part, whose motion no model predicts."""
    gains = design(vehicle)

    def predicted(name: str) -> Experiment:
        if vehicle.experiments[name].controller == FULL:
            raise ExcitationError(
                f"experiments.{name}", "its trim mass moves, which is not predicted", remedy=f"use {REDUCED}."
            )
        return _experiment(name, vehicle.experiments[name], vehicle, gains)

    return predicted


def _experiment(name: str, section: ExperimentSection, vehicle: MonocabFile, gains: RollDesign) -> Experiment:
    excitation = make_excitation(section, float(vehicle.control.rate))
    limits = vehicle.limits
    upright = min(vehicle.support - SUPPORT_MARGIN, radians(limits.roll_deg))
    turn = degrees(1.0)

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
        controller=partial(_loop, vehicle, gains, excitation),
        limits=(
            Limit("roll", upright, "deg", "at which the supports carry", turn),
            Limit("roll_rate", radians(limits.roll_rate_deg), "deg/s", "of limits.roll_rate_deg", turn),
            Limit("precession", radians(limits.precession_budget_deg), "deg", "of limits.precession_budget_deg", turn),
            Limit("precession_rate_setpoint", limits.precession_rate, "rad/s", "of limits.precession_rate"),
            Limit("setpoint_slope", limits.precession_acceleration, "rad/s^2", "of limits.precession_acceleration"),
        ),
        shorter=shorter,
    )


def _loop(vehicle: MonocabFile, gains: RollDesign, excitation: Excitation) -> Controller:
    """The vehicle's controller with the excitation in it, and the gimbals, for models whose input is their motion."""
    controller = RollController.from_design(gains, vehicle)
    on_reference = excitation.on_reference
    period = vehicle.period
    follows = -expm1(-period / gains.parameters.speed_loop_lag)
    rate = precession = before = 0.0

    def step(time: float, seen: Mapping[str, float]) -> Mapping[str, float]:
        nonlocal rate, precession, before
        rate = seen.get("precession_rate", rate)
        precession = seen.get("precession", precession)
        value = excitation.value(time)
        setpoint = controller.step(
            seen["roll"],
            seen["roll_rate"],
            rate,
            precession,
            value if on_reference else 0.0,
            period,
            0.0 if on_reference else value,
        )
        after = rate + follows * (setpoint - rate)
        precession += 0.5 * period * (rate + after)
        rate = after
        slope, before = (setpoint - before) / period, setpoint
        return {
            "precession_rate_setpoint": setpoint,
            "precession_rate": rate,
            "precession": precession,
            "trim_position": 0.0,
            "trim_rate": 0.0,
            "trim_rate_setpoint": 0.0,
            "setpoint_slope": slope,
        }

    return step
