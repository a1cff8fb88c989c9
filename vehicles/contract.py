"""What differs between kinds of vehicle, as the code that they share sees it: four small interfaces.

The vehicle file's `kind` selects one (`vehicles.registry`). Everything else in the daemon, from bus to recorder, is
the same code for every vehicle, and uses

    Kind        the meaning of the drives' values, the axis it falls about, its limits, and what is recorded
    Pilot       the design of its controller
    Handling    how it gets up, balances and gets down in one experiment
    Measurement what the drives reported last, in the quantities of that kind

`M` is the kind's own class of measurements; only the kind's own code reads its fields.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from upright.drivers.cia402.states import State
from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.roll_filter import RollState
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Vector3
from upright.vehicles.bounds import Bound
from upright.vehicles.experiment.excitation import Excitation
from upright.vehicles.sections import VehicleFile
from upright.vehicles.views import Views

if TYPE_CHECKING:
    from upright.diagnosis.prediction.closed_loop import Experiment
    from upright.diagnosis.prediction.closed_loop_error import Loop
    from upright.estimators.identify.subject import OwnMethods
    from upright.models.control_design.robustness import CheckedDesign, Known
    from upright.models.model import Model
    from upright.simulation.config import Truth
    from upright.telemetry.recording import Recording
    from upright.vehicles.commissioning import Number

    Measure = Callable[[Any, Sequence[Recording]], Mapping[str, Number]]
    """An evaluation of a step of a commissioning: a vehicle file and recordings give numbers by name."""


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
    """The command to the drives in this cycle, and what it follows from.

    `setpoint` is the controller's output (rad/s of precession, V at the motors); `reference` (rad) the angle that was
    aimed at; `excitation` the test signal's value, in the unit of the signal to which it was added. `others`: setpoints
    of further roles by their number (`vehicles.sections.Role.follows`), from 1 on; those that are not given are 0.
    """

    target: State
    setpoint: float
    reference: float = 0.0
    excitation: float = 0.0
    others: tuple[float, ...] = ()


IDLE = Command(State.SWITCH_ON_DISABLED, 0.0)
QUICK_STOP = Command(State.QUICK_STOP_ACTIVE, 0.0)
HOLD = Command(State.OPERATION_ENABLED, 0.0)

M = TypeVar("M", bound=Measurement)
M_in = TypeVar("M_in", bound=Measurement, contravariant=True)


class Handling(Protocol[M_in]):
    """How one experiment moves the vehicle. Each method is one control cycle of `dt` s, in one phase."""

    @property
    def risen(self) -> bool:
        """Whether the vehicle is up, so that `balance` may take over."""
        ...

    @property
    def failure(self) -> str:
        """Why it did not get up, in words; empty while it still may."""
        ...

    @property
    def lowered(self) -> bool:
        """Whether it is at rest again."""
        ...

    def centre(self, drives: M_in) -> Command | None:
        """At rest on a support: bring the actuators to the middle; None when they are there."""
        ...

    def move(self, dt: float, drives: M_in, excitation: float) -> Command:
        """Stay on the support, with the excitation at this moment on the drives."""
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

    def handling(self, excitation: Excitation, controller: str | None) -> Handling[M_in]:
        """The handling of one run of an experiment with that one of the kind's controllers (`VehicleFile.CONTROLLERS`),
        by default the first; it keeps nothing of an earlier run."""
        ...

    def findings(self) -> dict[str, Any]:
        """What is known of the controller, JSON-ready."""
        ...

    def words(self) -> list[str]:
        """The same for people, one line each."""
        ...


class Watch(Protocol[M_in]):
    """What a kind's model says about its measurements: quantities for its bounds, as in "watched.recovery"."""

    @property
    def averaged(self) -> Sequence[float]:
        """s over which gyro and accelerometer are compared (estimators.checks.imu_consistency)."""
        ...

    def unexplained(self, contradiction: Vector3) -> Vector3:
        """What the motion of the axis that the vehicle falls about, as its drives tell it, does not explain of the
        contradiction of accelerometer and gyro: m/s^2, in the body's frame."""
        ...

    def reset(self) -> None:
        """An experiment starts."""
        ...

    def update(self, dt: float, lean: Lean, drives: M_in) -> None:
        """One control cycle, `dt` s after the last one and before its setpoints are sent."""
        ...


class Kind(Protocol[M]):
    """One kind of vehicle, built from a vehicle file and its drivers."""

    angle: str
    """Name of the angle by which it falls."""
    bounds: tuple[Bound, ...]
    """What is monitored beyond IMU and drives, most severe first."""

    @property
    def watch(self) -> Watch[M]:
        """What its model says about the measurements."""
        ...

    def lean(self, attitude: RollState) -> Lean:
        """The angle by which this kind falls, from the roll filter's state."""
        ...

    def measure(self) -> M:
        """The latest values of the drivers."""
        ...

    def values(self, attitude: RollState, drives: M, command: Command, phase: float) -> tuple[float, ...]:
        """A sample of the recording, in the order of the kind's channels, once the command has been sent."""
        ...

    def interlocks(self, drives: M) -> list[str]:
        """What prevents this kind from starting a run, each as a sentence with the remedy."""
        ...

    def obstacles(self, drives: M) -> list[str]:
        """What prevents it from getting up, though it may start a run that leaves it on its support."""
        ...

    def pilot(self) -> Pilot[M]:
        """The controller, designed from the vehicle file. Raises ControlDesignError."""
        ...


@dataclass(frozen=True, slots=True)
class Prediction:
    """How the loop of one kind of vehicle is predicted.

    The loop needs the outputs `needs` of a model and gives the inputs `gives`; `of` a vehicle file returns a
    function that predicts an experiment of it by name. `hardest_to_separate` are the effects that a record too poor
    for a diagnosis distinguishes least. `assumed` returns a model with assumed delays of the loop's inputs where no
    recording has identified them.
    """

    needs: frozenset[str]
    gives: frozenset[str]
    of: Callable[[Any], Callable[[str], Experiment]]
    hardest_to_separate: tuple[str, ...] = ("coulomb_friction", "viscous_friction")
    assumed: Callable[[Model], Model] = lambda model: model


@dataclass(frozen=True, slots=True)
class Models:
    """The models of one kind of vehicle: `nominal` is the one that is identified, with everything that identification
    assumes in addition to its equations; of the `actuators` alone, the one that fits is chosen. There are none if the
    nominal model includes them."""

    nominal: Model
    actuators: tuple[Model, ...] = ()


@dataclass(frozen=True, slots=True)
class Twin:
    """The parts of the virtual vehicle of one kind: its physics, and the shipped EDS that its drives follow."""

    truth: Truth
    eds: str


@dataclass(frozen=True, slots=True)
class VehicleKind:
    """Everything specific to one kind of vehicle.

    `file`: content of its vehicle file; `channels`: what is recorded of it; `kind` builds it from its file and its
    drivers; `views` is what people see of it. `models`: the one that is identified, and those of its actuators.
    `identification`: the methods of identification for this kind only; their regressions run along with the vehicle.
    `recorded_loop`: what closed the loop of a recording from the first sample of its excitation on, or why it is not
    known, in words; `designs`: its controllers by name, designed for the parameters of its file and checked wherever
    these may be, none if their gains are in the file; `prediction`: how that loop is predicted; `twin`: its virtual
    vehicle; `shaken`: range of the RMS of its random disturbance in benchmarks, in the unit of the force it falls by.
    `evaluations`: those that only steps of this kind need; `measured`: parameters (value and standard deviation, SI)
    that recordings themselves measure, which count in place of the vehicle file's. The functions import what they need
    when they are called.
    """

    file: type[VehicleFile]
    channels: ChannelTable
    kind: Callable[[Any, VehicleIo], Kind[Any]]
    views: Views
    models: Callable[[], Models]
    identification: Callable[[], OwnMethods]
    recorded_loop: Callable[[Any, Recording], Loop | str]
    designs: Callable[[Any, Known], Mapping[str, CheckedDesign]]
    prediction: Callable[[], Prediction]
    twin: Callable[[], Twin]
    shaken: tuple[float, float]
    evaluations: Callable[[], Mapping[str, Measure]] = dict
    measured: Callable[[Any, Sequence[Recording]], Mapping[str, tuple[float, float]]] = lambda vehicle, recordings: {}
