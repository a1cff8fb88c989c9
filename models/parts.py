"""What a model is made of: parameters, states, inputs and outputs, and the places where forces, commands and readings
are: joints, actuators, sensors."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

from telemetry.errors import UprightError


class ModelError(UprightError):
    """A model, an effect or one of their expressions is not what it should be. `where` names the part."""

    def __init__(self, where: str, message: str, *, remedy: str) -> None:
        super().__init__(f"{where}: {message}.", remedy=remedy)
        self.where = where


class Hold(StrEnum):
    """What an input does between its samples."""

    ZERO_ORDER = "zero_order"
    """A command: each value acts until the next one comes."""
    CUBIC = "cubic"
    """A measurement: a smooth curve through the values (models.compiler.curves)."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number in the equations. `value` is where estimation starts (CAD), `std` how far off it may be (0: exact).

    `estimated` is False for what a record is not asked for unless told so. A value outside `lower` and `upper` is
    physically impossible. `scale` is a typical size, for what has the value 0.
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
        """A positive size to measure changes of the parameter by."""
        return self.std or self.scale or abs(self.value) or 1.0


@dataclass(frozen=True, slots=True)
class State:
    """A state and its time derivative.

    `initial` is its value at the first row of a record: an expression in the measured outputs of that row and the
    parameters. `initial_std`: how far off that may be, 0 for exactly known. `process_noise`: standard deviation of the
    white noise on the derivative, unit/sqrt(s), where its estimation starts, or, with `noise_known`, what it is; 0 for
    none. `noise_of` names an output whose sensor noise is integrated in this state: what a filter makes of its sensor,
    a trapezoid a row. `error_of` names one that a filter makes, of whose error this state is a part: where a record
    shows that no filter made it, the state fades within a second, and nothing that moves makes it. `noise_spread`:
    standard deviation of the natural logarithm of the noise about `process_noise`, before a record is seen.
    `correlation_time` names the parameter (s) with which the state fades where it is a random disturbance
    (models.random.disturbance): it then begins as it is in the long run, not within `initial_std`. `frequency` names
    the one (Hz) about which it then swings, and `driven_by` the state whose noise drives it, where that is not its own.
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
    """A channel that drives the model. `age`: the channel that says how much older, s, its samples are than the row.

    `delays` name the parameters (s) by which it acts later, `lag` the one (s) of a first-order lag it goes through.
    With `ramp_of` it is no channel itself, but what a limiter that follows channel `ramp_of` by no more than `ramp`
    unit/s is short of it, as a mean over each row. `usual`: its value where a recording has no such channel; None where
    it must have it.
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
        """What is read from a recording for it."""
        return self.ramp_of or self.name


@dataclass(frozen=True, slots=True)
class Output:
    """A measured channel and what the model says it shows. `noise`: standard deviation of a sample, where its
    estimation starts, or, with `noise_known`, what it is. `age` as for an input. What is `counted`, as by an encoder,
    has the same error from count to count, for many rows: no scatter tells its size, which is `noise`."""

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
    """What is known before of a random force about `frequency` (Hz): where its estimation starts.

    `damping_ratio` 0: between the largest and the least that a record may show; `std` (RMS, in the joint's unit of
    force) 0: by the joint's scale.
    """

    frequency: float
    damping_ratio: float = 0.0
    std: float = 0.0


@dataclass(frozen=True, slots=True)
class Disturbance:
    """What is known before of the random force at a joint, first order (models.random.disturbance).

    `std` (RMS, in the joint's unit of force) and `correlation_time` (s) are where their estimation starts, or, where it
    is `known`, what they are; 0: by the joint's scales. The correlation time is sought between `shortest` and `longest`
    (s), by default from two rows to a tenth of the record. `narrow_band`: what acts beside it.
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

    The equations use `NAME_force` for the right side. Scales are typical sizes, with which effects that know nothing
    of the machine choose starts and bounds; `smooth_rate` is the rate below which a sign() is drawn as a slope.
    `disturbance`: the random force that every real machine has; None for none.
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
    """Where a command becomes motion or force. `command` is an input's name; `rate` and `angle` are expressions of what
    it moves, "" where it moves nothing that is known; `gain` is the force at `joint` a unit of rate gives; `inertia` is
    that of the actuator itself, which is a part of the joint's.
    `also`: further inputs that are commands of its kind, as of two wheels: an effect acts on all of them alike. `lag`:
    the parameter by which what it moves lags behind the command, beside which a further lag hardly shows.
    Where it is not `commanded`, `command` is motion that nothing passes on, so that no effect of an input acts there.
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
        """What the model knows of it, by the name that effects use."""
        known = {
            "actuator_rate": self.rate,
            "actuator_angle": self.angle,
            "actuator_inertia": self.inertia,
            "gain": self.gain,
        }
        return {name: text for name, text in known.items() if text}


@dataclass(frozen=True, slots=True)
class Filter:
    """What makes an angle from its rate, and how it answers to an error of the rate: slowly, by an accelerometer.

        off = angle - level - lever error / smoothing
        angle' = error - bias - proportional off,  bias' = integral off
        level' = error - bias - (level + lever error / smoothing) / smoothing

    are the errors of angle, bias and of the direction from the accelerometer, which goes through a low pass of
    `smoothing` s that turns with the rate. `proportional` 1/s and `integral` 1/s^2 are the filter's gains, 0 where it
    learns no bias; `lever` s^2, the sensor's height over the axis by g: its acceleration there is taken from the rate.
    `integral` may be an expression of the model's inputs: a filter that is still learning the bias corrects it faster.
    """

    proportional: float
    integral: float | str = 0.0
    smoothing: float = 1.0
    lever: float = 0.0


@dataclass(frozen=True, slots=True)
class Sensor:
    """Outputs of one device: `angle` (or position) and `rate` are output names, "" where it does not measure it.

    `filter` is what makes the angle from the rate, None where they are measured apart. `actuator` is the one that it
    sits on: it shows that one's motion, in the unit of the coordinate of its joint, also where an effect lets the two
    move apart. "" where it shows what the outputs say.
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
