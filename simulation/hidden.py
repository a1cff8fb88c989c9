"""The registry of hidden effects: what a virtual vehicle may contain that the nominal model lacks.

Names are the canonical effect names. Each kind of vehicle has a registry of its own; the one here is the MONOCAB's. The
size at level 1 is physically plausible for it: a few percent of the 1000 N m that gravity exerts at the supports, or a
few milliseconds. Formulas are in `roll_effects`, `friction`, `input_effects`, `gimbal` and `imu_node`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from typing import TypeVar

from simulation.disturbance import Disturbance
from simulation.narrow_band import NarrowBand
from telemetry.errors import UprightError


class UnknownEffectError(UprightError):
    """No hidden effect has this name, or it cannot have this level. `name` is what was asked for."""

    def __init__(self, name: str, message: str, *, remedy: str) -> None:
        super().__init__(message, remedy=remedy)
        self.name = name


@dataclass(frozen=True, slots=True)
class HiddenEffect:
    """One effect: `size` in `unit` at level 1. `signed`: a negative level makes sense; `most`: largest size."""

    name: str
    unit: str
    size: float
    meaning: str
    signed: bool = False
    most: float = math.inf


HIDDEN: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        HiddenEffect(
            "static_torque", "N m", 120.0, "constant roll torque: the centre of gravity is off the middle", signed=True
        ),
        HiddenEffect("viscous_friction", "N m s/rad", 400.0, "roll torque against the roll rate"),
        HiddenEffect("coulomb_friction", "N m", 60.0, "dry friction of the safety catch (LuGre bristles)"),
        HiddenEffect("stribeck_friction", "N m", 80.0, "breakaway torque, half of it lost when sliding (LuGre)"),
        HiddenEffect("asymmetric_friction", "N m", 60.0, "dry friction right side down, a third of it the other way"),
        HiddenEffect("load_dependent_friction", "1", 0.2, "dry friction as a share of the gyroscopic torque"),
        HiddenEffect("quadratic_drag", "N m s^2/rad^2", 5000.0, "roll torque against the rate squared"),
        HiddenEffect("cubic_stiffness", "N m/rad^3", 1.0e6, "restoring torque of a progressive suspension"),
        HiddenEffect("end_stop", "N m/rad", 5.0e4, "rubber buffers that touch at +-0.5 deg"),
        HiddenEffect("hysteresis", "N m", 60.0, "hysteretic torque of flange and cables (Bouc-Wen, yields in 2 mrad)"),
        HiddenEffect(
            "position_cogging", "N m", 40.0, "torque that repeats every 5 mrad of roll: a worn rail head", signed=True
        ),
        HiddenEffect(
            "periodic_disturbance", "N m", 40.0, "sinusoidal roll torque at 1.3 Hz: machinery on board", signed=True
        ),
        HiddenEffect(
            "torque_step",
            "N m",
            550.0,
            "a person sits down 10 s after the drives started, a ramp of 0.3 s",
            signed=True,
        ),
        HiddenEffect(
            "torque_drift", "N m", 150.0, "roll torque that creeps up with a time constant of 45 s", signed=True
        ),
        HiddenEffect(
            "flexible_mode", "1", 0.12, "share of the inertia that is sprung at 7 Hz: the cabin on the frame", most=0.9
        ),
        HiddenEffect("gimbal_angle_coupling", "1", 1.0, "gyroscopic torque falls with the cosine of precession"),
        HiddenEffect(
            "gimbal_imbalance", "N m", 80.0, "roll torque with the sine of precession: eccentric gimbals", signed=True
        ),
        HiddenEffect("backlash", "rad", 5.0e-3, "play between gimbal motor and gimbal, as an angle of the gimbal"),
        HiddenEffect("input_deadband", "rad/s", 6.0e-3, "precession rate setpoints smaller than this do nothing"),
        HiddenEffect("input_delay", "s", 0.012, "the setpoint acts this much later"),
        HiddenEffect("actuator_lag", "s", 0.03, "a further first-order lag ahead of the speed loop"),
        HiddenEffect(
            "input_asymmetry", "1", 0.08, "setpoints up act this much stronger, setpoints down weaker", signed=True
        ),
        HiddenEffect("input_gain", "1", -0.08, "relative error of the setpoint's gain", signed=True),
        HiddenEffect("gyro_bias", "rad/s", 8.7e-3, "further bias of the roll gyro (0.5 deg/s)", signed=True),
        HiddenEffect("sensor_offset", "rad", 8.7e-3, "the IMU is mounted rolled by this much (0.5 deg)", signed=True),
        HiddenEffect("sensor_lag", "s", 0.02, "low pass inside the IMU"),
        HiddenEffect("sensor_delay", "s", 0.012, "the IMU reports the past"),
        HiddenEffect("sensor_scale", "1", 0.03, "relative error of the gyro's scale", signed=True),
    )
}
"""Every hidden effect by its canonical name."""

UNLISTED: dict[str, HiddenEffect] = {
    effect.name: effect
    for effect in (
        HiddenEffect("test_cubic_drag", "N m s^3/rad^3", 1.5e5, "roll torque against the rate cubed", signed=True),
        HiddenEffect(
            "test_one_sided_damping", "N m s/rad^2", 5.0e4, "damping that grows with the roll angle", signed=True
        ),
        HiddenEffect(
            "test_varying_stiffness", "N m/rad", 3.0e3, "stiffness that swings with time, at 0.7 Hz", signed=True
        ),
        HiddenEffect(
            "test_patchy_damping", "N m s/rad", 6.0e2, "damping that changes sign every 5 mrad of roll", signed=True
        ),
    )
}
"""What no catalogue has, to test whether a diagnosis says that it does not know: `test_` begins their names."""

LATE = frozenset(
    {
        "static_torque",
        "viscous_friction",
        "coulomb_friction",
        "stribeck_friction",
        "asymmetric_friction",
        "load_dependent_friction",
        "quadratic_drag",
        "cubic_stiffness",
        "end_stop",
        "hysteresis",
        "position_cogging",
        "periodic_disturbance",
        "torque_step",
        *UNLISTED,
    }
)
"""Effects that can set in during a run: torques on the roll axis."""


DISTURBANCE = "disturbance"
"""What the random torque is called beside the effects, and"""
NARROW_BAND = "narrow_band"
"""the one of a narrow band."""
UNITS = {DISTURBANCE: "s", NARROW_BAND: "Hz"}
"""Of their second number; the first is an RMS."""
Random = TypeVar("Random", Disturbance, NarrowBand)


@dataclass(frozen=True, slots=True)
class Registry:
    """The effects that a kind of vehicle can hide: those that a catalogue has, those that none has, the late ones."""

    listed: Mapping[str, HiddenEffect]
    unlisted: Mapping[str, HiddenEffect]
    late: frozenset[str]
    """Names of those that can set in during a run."""
    disturbance: Disturbance
    """The random torque at level 1, and"""
    narrow_band: NarrowBand
    """that of a narrow band."""

    def find(self, name: str) -> HiddenEffect:
        """The effect `name`. Raises UnknownEffectError."""
        effect = self.listed.get(name) or self.unlisted.get(name)
        if effect is None:
            there = ", ".join((*self.listed, DISTURBANCE, NARROW_BAND))
            raise UnknownEffectError(name, f"there is no hidden effect {name!r}.", remedy=f"Use one of: {there}.")
        return effect


MONOCAB = Registry(
    HIDDEN,
    UNLISTED,
    LATE,
    Disturbance(rms=8.0, correlation_time=0.3),
    NarrowBand(rms=4.0, frequency=2.0, damping=0.05),
)
"""The MONOCAB's. Its disturbance is what the alignment of a worn rail does to it at walking pace, 3 % of the gravity
torque at 1 deg; the calculation, and what wind does, are in docs/explanation/disturbance.md."""


def parse_disturbance(
    arguments: Iterable[str], registry: Registry = MONOCAB, default: Disturbance | None = None
) -> tuple[list[str], Disturbance | None]:
    """The `arguments` that are not about the disturbance, for `parse_hidden`; and the disturbance that is asked for.

    `disturbance` is level 1, `disturbance=LEVEL` a multiple of its RMS, `disturbance=RMS,CORRELATION_TIME` is in N m
    and s; each may end in `@SECONDS`. None with `disturbance=0`; `default` where nothing is said of it. The last one
    counts. Raises UnknownEffectError.
    """
    return _parsed(arguments, DISTURBANCE, registry.disturbance, default)


def parse_narrow_band(arguments: Iterable[str], registry: Registry = MONOCAB) -> tuple[list[str], NarrowBand | None]:
    """The same of the random torque of a narrow band, `narrow_band=RMS,FREQUENCY,DAMPING` in N m and Hz."""
    return _parsed(arguments, NARROW_BAND, registry.narrow_band, None)


def _parsed(
    arguments: Iterable[str], name: str, usual: Random, default: Random | None
) -> tuple[list[str], Random | None]:
    others: list[str] = []
    found = default
    for argument in arguments:
        if argument.partition("@")[0].partition("=")[0] == name:
            found = _random(argument, name, usual)
        else:
            others.append(argument)
    return others, found


def _random(argument: str, name: str, usual: Random) -> Random | None:
    """`name`, `name=LEVEL` or `name=NUMBER,...` with the numbers of `usual`, the RMS first; None where that is 0."""
    text, late, second = argument.partition("@")
    _, separator, value = text.partition("=")
    numbered = [each.name for each in fields(usual)][:-1]
    try:
        numbers = [float(word) for word in value.split(",")] if separator else [1.0]
        onset = float(second) if late else None
        if len(numbers) == 1:
            return replace(usual, rms=usual.rms * numbers[0], onset=onset) if numbers[0] != 0.0 else None
        given = dict(zip(numbered, numbers, strict=True))
        return replace(usual, **given, onset=onset) if numbers[0] != 0.0 else None
    except ValueError as error:
        why = str(error) if str(error).startswith("the ") else f"{argument!r} is no {name.replace('_', ' ')}"
        example = ",".join(f"{getattr(usual, each):g}" for each in numbered)
        asked = ",".join(numbered).upper()
        raise UnknownEffectError(
            name,
            f"{why}.",
            remedy=f"Give {name}=LEVEL, or {name}={asked} in N m and {UNITS[name]}, all above 0, as in "
            f"{name}={example}, with @SECONDS for when it sets in; {name}=0 switches it off.",
        ) from None


def parse_hidden(
    arguments: Iterable[str], registry: Registry = MONOCAB
) -> tuple[dict[str, float | None], dict[str, float]]:
    """`["coulomb_friction", "torque_step=2@30"]` as `hidden` and `onsets` of a SimulationConfig.

    Raises UnknownEffectError.
    """
    hidden: dict[str, float | None] = {}
    onsets: dict[str, float] = {}
    for argument in arguments:
        text, late, second = argument.partition("@")
        name, separator, level = text.partition("=")
        hidden[name] = _number(name, "level", level) if separator else None
        if late:
            onsets[name] = _number(name, "time", second)
    sizes_of(hidden, registry)
    check_onsets(onsets, registry)
    return hidden, onsets


def check_onsets(onsets: Mapping[str, float], registry: Registry = MONOCAB) -> None:
    """Raises UnknownEffectError for an effect that cannot set in during a run, or not then."""
    for name, second in onsets.items():
        if name not in registry.late:
            raise UnknownEffectError(
                name,
                f"{name} is there from the beginning.",
                remedy=f"These can set in later: {', '.join(sorted(registry.late))}.",
            )
        if not (math.isfinite(second) and second >= 0.0):
            raise UnknownEffectError(
                name,
                f"{name} cannot set in at {second:g} s.",
                remedy="Give seconds after the drives started, 0 or more.",
            )


def _number(name: str, what: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise UnknownEffectError(
            name, f"the {what} of {name} is {text!r}.", remedy=f"Give numbers, as in {name}=2 or {name}=2@30."
        ) from None


def sizes_of(hidden: Mapping[str, float | None], registry: Registry = MONOCAB) -> dict[str, float]:
    """The size of each named effect in its own unit; those at level 0 are left out. Raises UnknownEffectError."""
    sizes = {}
    for name, given in hidden.items():
        effect, level = registry.find(name), 1.0 if given is None else given
        size = effect.size * level
        least = -math.inf if effect.signed else 0.0
        if not (math.isfinite(level) and least <= size <= effect.most):
            raise UnknownEffectError(
                name,
                f"{name} cannot have the level {level:g}.",
                remedy=f"Use a level from {least / effect.size:g} to {effect.most / effect.size:g}; "
                f"1 is {effect.size:g} {effect.unit}.",
            )
        if level != 0.0:
            sizes[name] = size
    return sizes
