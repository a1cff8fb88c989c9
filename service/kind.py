"""What differs between kinds of vehicle, as the code that they share sees it: four small interfaces.

The vehicle file's `kind` chooses (`service.kinds`). Everything else in the daemon, from the bus to the recorder, is the
same code for every vehicle, and asks

    Kind        what do the drives' values mean, about which axis does it fall, what are its limits, what is recorded?
    Pilot       how is its controller designed?
    Handling    how does it get up, balance and get down in one experiment?
    Measurement what the drives reported last, in the words of that kind

`M` is the kind's own class of measurements; only its own code looks into it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from drivers.cia402.states import State
from estimators.roll_filter import RollState
from service.control.excitation import Excitation
from service.control.safety import Bound
from telemetry.channels import ChannelTable


class Measurement(Protocol):
    """What the drives reported last."""

    @property
    def timestamp_ns(self) -> int:
        """Of the oldest value in it; 0 while a drive has not answered yet."""
        ...


@dataclass(frozen=True, slots=True)
class Lean:
    """How far the vehicle leans, about the axis that it falls about: `angle` rad from upright, `rate` rad/s."""

    angle: float
    rate: float


@dataclass(frozen=True, slots=True)
class Command:
    """What the drives shall do in this cycle, and what led to it.

    `setpoint` is what the controller puts out (rad/s of precession, V at the motors); `reference` (rad) the angle that
    was aimed at; `excitation` the test signal's value, in the unit of what it was added to.
    """

    target: State
    setpoint: float
    reference: float = 0.0
    excitation: float = 0.0


IDLE = Command(State.SWITCH_ON_DISABLED, 0.0)
QUICK_STOP = Command(State.QUICK_STOP_ACTIVE, 0.0)
HOLD = Command(State.OPERATION_ENABLED, 0.0)

M = TypeVar("M", bound=Measurement)
M_in = TypeVar("M_in", bound=Measurement, contravariant=True)


class Handling(Protocol[M_in]):
    """One experiment's way of moving the vehicle. Each method is one control cycle of `dt` s, in one phase."""

    @property
    def risen(self) -> bool:
        """Whether the vehicle is up, so that `balance` may take over."""
        ...

    @property
    def failure(self) -> str:
        """Why it did not get up, in words; empty while it may still."""
        ...

    @property
    def lowered(self) -> bool:
        """Whether it is at rest again."""
        ...

    def centre(self, drives: M_in) -> Command | None:
        """At rest on a support: bring the actuators to the middle; None when they are there."""
        ...

    def rise(self, dt: float, lean: Lean, drives: M_in) -> Command:
        """Get up."""
        ...

    def balance(self, dt: float, lean: Lean, drives: M_in, excitation: float) -> Command:
        """Stay up, with the excitation at this moment."""
        ...

    def lower(self, dt: float, lean: Lean, drives: M_in) -> Command:
        """Get down."""
        ...


class Pilot(Protocol[M_in]):
    """The controller of a vehicle, designed once and checked; it makes the handling of each experiment."""

    def handling(self, excitation: Excitation) -> Handling[M_in]:
        """For one run of an experiment; nothing of an earlier run is left in it."""
        ...

    def findings(self) -> dict[str, Any]:
        """What is known of the controller, JSON-ready."""
        ...

    def words(self) -> list[str]:
        """The same for people, a line each."""
        ...


class Kind(Protocol[M]):
    """One kind of vehicle, made of a vehicle file and its drivers."""

    channels: ChannelTable
    angle: str
    """What the angle that it falls by is called."""
    bounds: tuple[Bound, ...]
    """What a safety verdict watches beyond IMU and drives, the worst first."""

    def lean(self, attitude: RollState) -> Lean:
        """Of what the roll filter says, the angle that this kind falls by."""
        ...

    def measure(self) -> M:
        """What the drivers know now."""
        ...

    def values(self, attitude: RollState, drives: M, command: Command, phase: float) -> tuple[float, ...]:
        """A row of the recording, in the order of `channels`, once the command has been sent."""
        ...

    def interlocks(self, drives: M) -> list[str]:
        """What of its own keeps a run from being started, each as a sentence with what to do."""
        ...

    def pilot(self) -> Pilot[M]:
        """The controller, designed from the vehicle file. Raises ControlDesignError."""
        ...
