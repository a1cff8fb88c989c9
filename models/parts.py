"""The parts of a model: parameters, states, inputs and outputs, and the places of forces, commands and readings:
joints, actuators and sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from upright.telemetry.errors import UprightError


class ModelError(UprightError):
    """A model, an effect or one of their expressions is invalid. `where` names the part."""

    def __init__(self, where: str, message: str, *, remedy: str) -> None:
        super().__init__(f"{where}: {message}.", remedy=remedy)
        self.where = where


class Hold(StrEnum):
    """What an input does between its samples."""

    ZERO_ORDER = "zero_order"
    """A command: each value acts until the next one arrives."""
    CUBIC = "cubic"
    """A measurement: a smooth curve through the values (models.compiler.curves)."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number in the equations. `value` is the start of its estimation (CAD), `std` the standard deviation of
    `value` (0: exact).

    `estimated` is False if the parameter is estimated only on request. A value outside `lower` and `upper` is
    physically impossible. `scale` is a typical magnitude, for a parameter with the value 0.
    """

    name: str
    unit: str
    value: float
    std: float = 0.0
    lower: float = -math.inf
    upper: float = math.inf
    estimated: bool = True
    scale: float = 0.0
    meaning: str = ""

    @property
    def typical(self) -> float:
        """A positive magnitude by which changes of the parameter are scaled."""
        return self.std or self.scale or abs(self.value) or 1.0


@dataclass(frozen=True, slots=True)
class State:
    """A state and its time derivative.

    `initial` is its value at the first sample of a record: an expression of the measured outputs of that sample and the
    parameters. `initial_std`: standard deviation of that value, 0 if it is exact. `process_noise`: standard deviation
    of the white noise on the derivative, unit/sqrt(s): the start of its estimation or, with `noise_known`, the known
    value; 0 for none. `noise_of` names an output whose sensor noise this state integrates, as a filter integrates its
    sensor: one trapezoid per sample. `error_of` names an output that a filter computes, and of whose error this state
    is a part; if a record shows that no filter computed it, the state decays within a second, and no motion drives it.
    `noise_spread`: standard deviation of the natural logarithm of the noise about `process_noise`, before a record is
    seen. `correlation_time` names the parameter (s) with which the state decays if it is a random disturbance
    (models.random.disturbance): its initial distribution is then the stationary one, not that of `initial_std`.
    `frequency` names the parameter (Hz) about which it then oscillates, and `driven_by` the state whose noise drives
    it, if that is not its own.
    """

    name: str
    unit: str
    derivative: str
    initial: str = "0"
    initial_std: float = 0.0
    process_noise: float = 0.0
    noise_known: bool = False
    noise_of: str = ""
    error_of: str = ""
    noise_spread: float = 1.0
    correlation_time: str = ""
    frequency: str = ""
    driven_by: str = ""
    meaning: str = ""


@dataclass(frozen=True, slots=True)
class Input:
    """A channel that drives the model. `age`: the channel with the age of its samples, s, relative to the recorded
    instant.

    `delays` name the parameters (s) by which it is delayed, `lag` that of a first-order lag (s) which it passes. With
    `ramp_of` it is not a channel itself, but the shortfall of a limiter that follows channel `ramp_of` by no more than
    `ramp` unit/s, as a mean over each sampling interval. `usual`: its value if a recording has no such channel; None if
    the channel is required.
    """

    name: str
    unit: str
    hold: Hold = Hold.CUBIC
    age: str = ""
    delays: tuple[str, ...] = ()
    lag: str = ""
    ramp_of: str = ""
    ramp: float = 0.0
    usual: float | None = None
    meaning: str = ""

    @property
    def channel(self) -> str:
        """The channel of a recording that it is read from."""
        return self.ramp_of or self.name


@dataclass(frozen=True, slots=True)
class Output:
    """A measured channel and the model's expression for it. `noise`: standard deviation of a sample: the start of its
    estimation or, with `noise_known`, the known value. `age` as for an input. If it is `counted`, as by an encoder, its
    error is constant from count to count, for many samples: the scatter does not show the magnitude of the error, which
    is `noise`."""

    name: str
    unit: str
    expression: str
    noise: float
    age: str = ""
    noise_known: bool = False
    meaning: str = ""
    counted: bool = False


@dataclass(frozen=True, slots=True)
class NarrowBand:
    """Prior knowledge of a random force about `frequency` (Hz): the start of its estimation.

    `damping_ratio` 0: between the largest and the smallest value that a record can show; `std` (RMS, in the joint's
    unit of force) 0: from the joint's scale.
    """

    frequency: float
    damping_ratio: float = 0.0
    std: float = 0.0


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Prior knowledge of the first-order random force at a joint (models.random.disturbance).

    `std` (RMS, in the joint's unit of force) and `correlation_time` (s) are the start of their estimation or, if
    `known`, the known values; 0: from the joint's scales. The correlation time is estimated between `shortest` and
    `longest` (s), by default from two sampling intervals to a tenth of the record. `narrow_band`: an additional
    force.
    """

    std: float = 0.0
    correlation_time: float = 0.0
    known: bool = False
    shortest: float = 0.0
    longest: float = math.inf
    narrow_band: NarrowBand | None = None


@dataclass(frozen=True, slots=True)
class Joint:
    """A degree of freedom where forces or torques enter: inertia * rate' = load + effects + disturbance.

    The equations use `NAME_force` for the right-hand side. Scales are typical magnitudes, from which effects, which are
    independent of the machine, take their start values and bounds; `smooth_rate` is the rate below which a sign() is
    approximated by a slope. `disturbance`: the random force that acts on every real machine; None for none.
    """

    name: str
    coordinate: str
    rate: str
    inertia: str
    load: str
    force_unit: str
    coordinate_unit: str
    force_scale: float
    coordinate_scale: float
    rate_scale: float
    smooth_rate: float
    disturbance: Disturbance | None = Disturbance()


@dataclass(frozen=True, slots=True)
class Actuator:
    """Where a command becomes motion or force. `command` is an input's name; `rate` and `angle` are expressions for the
    motion of the part that it moves, "" if the model does not know it; `gain` is the force at `joint` per unit of rate;
    `inertia` is that of the actuator itself, a part of the joint's. `also`: further inputs that are commands of the
    same kind, e.g. of two wheels: an effect acts equally on all of them. `lag`: the parameter by which the motion lags
    behind the command; a further lag is hardly visible in addition. If it is not `commanded`, `command` is a motion and
    not a command, so that no effect on a command acts there.
    """

    name: str
    command: str
    joint: str
    rate: str = ""
    angle: str = ""
    gain: str = ""
    inertia: str = ""
    rate_unit: str = "rad/s"
    angle_unit: str = "rad"
    command_scale: float = 1.0
    angle_scale: float = 1.0
    commanded: bool = True
    also: tuple[str, ...] = ()
    lag: str = ""

    @property
    def commands(self) -> tuple[str, ...]:
        """All inputs that an effect on it acts on."""
        return (self.command, *self.also)

    @property
    def moved(self) -> dict[str, str]:
        """The expressions that the model knows for it, by the names that effects use."""
        known = {
            "actuator_rate": self.rate,
            "actuator_angle": self.angle,
            "actuator_inertia": self.inertia,
            "gain": self.gain,
        }
        return {name: text for name, text in known.items() if text}


@dataclass(frozen=True, slots=True)
class Filter:
    """A filter that computes an angle from its rate, and corrects errors of the rate slowly, by an accelerometer.

        off = angle - level - lever error / smoothing
        angle' = error - bias - proportional off,  bias' = integral off
        level' = error - bias - (level + lever error / smoothing) / smoothing

    are the errors of angle, bias and the direction from the accelerometer. This direction passes a low-pass filter with
    the time constant `smoothing` s, which turns with the rate. `proportional` 1/s and `integral` 1/s^2 are the filter's
    gains, `integral` 0 if it does not learn a bias; `lever` s^2 is the sensor's height above the axis over g: its
    acceleration there is computed from the rate. `integral` may be an expression of the model's inputs: a filter that
    is still learning the bias corrects it faster.
    """

    proportional: float
    integral: float | str = 0.0
    smoothing: float = 1.0
    lever: float = 0.0


@dataclass(frozen=True, slots=True)
class Sensor:
    """Outputs of one device: `angle` (or position) and `rate` are output names, "" if it does not measure it.

    `filter` computes the angle from the rate; None if both are measured independently. `actuator` is the actuator that
    carries the sensor, which then shows the motion of that actuator, in the unit of its joint's coordinate, even if an
    effect lets actuator and joint move apart; "" if the sensor shows what the outputs state.
    """

    name: str
    angle: str = ""
    rate: str = ""
    actuator: str = ""
    angle_unit: str = "rad"
    rate_unit: str = "rad/s"
    angle_scale: float = 1.0
    rate_scale: float = 1.0
    filter: Filter | None = None


class Place(StrEnum):
    """Where an effect acts."""

    JOINT = "joint"
    ACTUATOR = "actuator"
    SENSOR = "sensor"
