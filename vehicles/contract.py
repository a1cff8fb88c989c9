"""What differs between kinds of vehicle, as the code that they share sees it: four small interfaces.

The vehicle file's `kind` chooses (`vehicles.registry`). Everything else in the daemon, from the bus to the recorder, is
the same code for every vehicle, and asks

    Kind        what do the drives' values mean, about which axis does it fall, what are its limits, what is recorded?
    Pilot       how is its controller designed?
    Handling    how does it get up, balance and get down in one experiment?
    Measurement what the drives reported last, in the words of that kind

`M` is the kind's own class of measurements; only its own code looks into it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from drivers.cia402.states import State
from drivers.vehicle_io import VehicleIo
from estimators.roll_filter import RollState
from telemetry.channels import ChannelTable
from vehicles.bounds import Bound
from vehicles.excitation import Excitation
from vehicles.sections import VehicleFile
from vehicles.views import Views

if TYPE_CHECKING:
    from diagnosis.prediction.closed_loop import Experiment
    from diagnosis.prediction.closed_loop_error import Loop
    from estimators.identify.subject import OwnMethods
    from models.model import Model
    from simulation.config import Truth
    from telemetry.recording import Recording


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
        """A row of the recording, in the order of the kind's channels, once the command has been sent."""
        ...

    def interlocks(self, drives: M) -> list[str]:
        """What of its own keeps a run from being started, each as a sentence with what to do."""
        ...

    def pilot(self) -> Pilot[M]:
        """The controller, designed from the vehicle file. Raises ControlDesignError."""
        ...


@dataclass(frozen=True, slots=True)
class Prediction:
    """How the loop of one kind of vehicle is predicted.

    It needs these outputs of a model and gives these inputs; `of` a vehicle file makes what predicts an experiment of
    it by name. `untold` is what a record that is too poor for a diagnosis tells apart the least. `assumed` is a model
    with what no recording has told yet of how late the loop's inputs act.
    """

    needs: frozenset[str]
    gives: frozenset[str]
    of: Callable[[Any], Callable[[str], Experiment]]
    untold: tuple[str, ...] = ("coulomb_friction", "viscous_friction")
    assumed: Callable[[Model], Model] = lambda model: model


@dataclass(frozen=True, slots=True)
class Models:
    """Of one kind of vehicle: the one that is identified, with what identification assumes beside its equations, and
    those of the actuators alone, of which the one that fits is chosen; none where these are part of the first."""

    nominal: Model
    actuators: tuple[Model, ...] = ()


@dataclass(frozen=True, slots=True)
class Twin:
    """What the virtual vehicle of one kind is made of: its physics, and the shipped EDS that its drives follow."""

    truth: Truth
    eds: str


@dataclass(frozen=True, slots=True)
class VehicleKind:
    """All that is one kind of vehicle's own.

    `file`: what its vehicle file holds; `channels`: what is recorded of it; `kind` makes it of its file and of its
    drivers; `views` is what people see of it. `models`: the one that is identified, and those of its actuators.
    `identification`: what an identification has for it alone, of which the regressions run along with the vehicle.
    `recorded_loop`: what closed the loop of a
    recording from the first row of its excitation on, or why it is not known, in words; `prediction`: how that loop is
    predicted; `twin`: its virtual vehicle, which `shaken` (RMS from and to, in the unit of the force it falls by) is
    pushed by in benchmarks. What is a function imports what it needs when it is asked.
    """

    file: type[VehicleFile]
    channels: ChannelTable
    kind: Callable[[Any, VehicleIo], Kind[Any]]
    views: Views
    models: Callable[[], Models]
    identification: Callable[[], OwnMethods]
    recorded_loop: Callable[[Any, Recording], Loop | str]
    prediction: Callable[[], Prediction]
    twin: Callable[[], Twin]
    shaken: tuple[float, float]
