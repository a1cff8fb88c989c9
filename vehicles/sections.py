"""The sections of a vehicle file that all kinds of vehicle share, as pydantic models.

What a kind adds is in its own `file` module (`vehicles.monocab.file`, `vehicles.twsbr.file`). Units are SI unless a key
ends in `_deg` or `_rpm`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from upright.drivers import can_ids
from upright.drivers.observed_speed import SpeedConfig

IMU_RATES = (50, 100, 200, 250, 500)
"""Stream rates that are fast enough to balance on, Hz: those of the LPMS-IG1, and the 200 Hz of others."""

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
CanId = Annotated[int, Field(ge=1, le=0x7FF)]
NodeId = Annotated[int, Field(ge=1, le=127)]
BusAddress = Annotated[str, Field(pattern=r"^[a-z_0-9]+:.+$", description="IFACE:CHANNEL, as in socketcan:can0")]


def up_to(most: float, why: str) -> Any:
    """The field of a limit: above 0, at most `most` in its unit. `why` is the reason, after a colon, for whoever enters
    more."""
    return Field(gt=0, le=most, json_schema_extra={"$comment": why})


LARGEST = 1e15
"""Of a number in a vehicle file, and the inverse of the smallest: products and powers of such numbers are finite."""


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True, allow_inf_nan=False)

    @field_validator("*")
    @classmethod
    def _can_be_computed_with(cls, value: Any) -> Any:
        for each in value if isinstance(value, list | tuple) else (value,):
            if isinstance(each, float | int) and each and not 1.0 / LARGEST <= abs(each) <= LARGEST:
                raise ValueError(f"must be 0, or between {1.0 / LARGEST:g} and {LARGEST:g} in magnitude")
        return value


class VehicleSection(Section):
    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,32}$")]
    """Name in MQTT topics, recordings and the control socket."""
    kind: str
    """What the vehicle is: selects its channels, model, controller and way of getting up; see `vehicles.registry`."""
    description: str = ""


class BusSection(Section):
    drives: BusAddress
    """Bus of the drives."""
    imu: BusAddress
    """Bus of the IMU; the same as `drives` or a second one."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    """bit/s, of classical CAN."""


class ControlSection(Section):
    rate: int = 250
    """Hz: the IMU's stream rate, which is the clock of the control loop."""
    master_node: NodeId = 127
    """CANopen node id of this service."""
    heartbeat_period: Annotated[float, up_to(0.5, "drives that are monitored less often run on for too long")] = 0.02
    """s between heartbeats of the control loop."""
    heartbeat_timeout: Annotated[float, up_to(1.0, "so long a drive runs on when the service is gone")] = 0.12
    """s without the heartbeat after which a drive stops by itself (written to 1016h)."""
    lease: Annotated[float, Field(ge=0.2, le=2.0)] = 0.3
    """s without a renewal by the client that started an experiment, after which it ends in an orderly way."""

    @field_validator("rate")
    @classmethod
    def _rate_is_streamed(cls, rate: int) -> int:
        if rate not in IMU_RATES:
            raise ValueError(f"the IMU does not stream at {rate} Hz; use one of {', '.join(map(str, IMU_RATES))}")
        return rate

    @model_validator(mode="after")
    def _timeout_outlasts_a_heartbeat(self) -> Self:
        if self.heartbeat_timeout < 2 * self.heartbeat_period:
            raise ValueError("heartbeat_timeout must be at least twice heartbeat_period: one frame may get lost")
        return self


class FilterSection(Section):
    acceleration_std: Positive
    """m/s^2 per sample, vibration included."""
    angular_rate_density: Positive
    """rad/s/sqrt(Hz)."""
    bias_random_walk: Positive
    """rad/s/sqrt(s)."""


class ImuSection(Section):
    protocol: Literal["canopen", "sequential"]
    base_id: CanId
    """CAN id of the first frame of a set."""
    precision: Literal["float32", "int16"]
    slots: list[str]
    """What the device's channel slots carry, in order."""
    axes: tuple[str, str, str] = ("+x", "+y", "+z")
    """Sensor axis that points along the vehicle's x (forward), y (left) and z (up)."""
    acceleration_sign: Literal[1, -1] = 1
    """-1 if the device reports -1 g along the axis that points up."""
    angular_rate_unit: Literal["deg/s", "rad/s"] = "deg/s"
    acceleration_range: Annotated[float, up_to(400.0, "no reading would count as implausible")] = 39.2
    """m/s^2."""
    angular_rate_range_deg: Annotated[float, up_to(4000.0, "no reading would count as implausible")] = 400.0
    """deg/s."""
    angular_rate_change_deg: Annotated[float, up_to(4000.0, "no reading would count as wrong")] | None = None
    """deg/s from one set to the next that nothing can make: a single reading beyond it is left out; None for any."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m, from the axis that the vehicle falls about to the accelerometer, in vehicle axes."""
    latency: Annotated[float, Field(ge=0, le=0.1)] = 0.0
    """s from the measurement to the last frame on the bus."""
    filter: FilterSection

    @field_validator("slots")
    @classmethod
    def _slots_suffice(cls, slots: list[str]) -> list[str]:
        needed = [f"{kind}_{axis}" for kind in ("acceleration", "angular_rate") for axis in "xyz"]
        missing = [name for name in needed if name not in slots]
        if missing:
            raise ValueError(f"the roll filter needs {', '.join(missing)}: map them in the device and list them here")
        return slots


@dataclass(frozen=True, slots=True)
class Role:
    """The drives of one role in a kind of vehicle.

    There are `least` to `most` of them. They follow the controller's setpoint of number `follows`, 0 for its first. The
    axis of a `linear` one moves along a line.
    """

    least: int
    most: int
    follows: int = 0
    linear: bool = False


NO_ROLE = Role(0, 0)
REST, ON_SUPPORT, CONTROLLER_OUTPUT = "rest", "support", "controller_output"
"""Where an excitation may enter, in addition to the reference angles of a kind of vehicle: a vehicle at rest, the
drives while the vehicle stays on its support, or the controller's output. Without an excitation, `REST` is a recording
with the drives off."""


def is_reference(at: str) -> bool:
    """Whether an excitation there is added to a reference angle of the controller."""
    return at.endswith("_reference")


class DriveSection(Section):
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    role: str
    """What it moves: one of the roles of its kind of vehicle. Of two wheels the first one is the left."""
    node: NodeId
    direction: Literal[1, -1]
    """+1 if a positive motor speed gives a positive roll torque, or drives the vehicle forward."""
    gear_ratio: Positive | None = None
    """Motor turns per turn of the axis (rotary axes)."""
    lead: Positive | None = None
    """m per motor turn (linear axes)."""
    mode: Literal[2, 9, 10, -1]
    """CiA 402 mode: 2 velocity (6042h, rpm), 9 cyclic synchronous velocity (60FFh), 10 cyclic synchronous torque
    (6071h, per mille of the rated torque), -1 voltage (2400h, mV)."""
    increments_per_turn: Annotated[int, Field(gt=0)]
    """Of 6064h, per motor turn."""
    velocity_unit_rpm: Positive
    """rpm per unit of 606Ch and 60FFh."""
    rated_torque: Positive
    """N m at the motor, the base of 6071h and 6077h."""
    eds: str = "upright_servo.eds"
    vendor_id: Annotated[int, Field(ge=0)] = 0
    product_code: Annotated[int, Field(ge=0)] = 0
    setpoint_resolution: Annotated[float, Field(ge=0.0)] = 0.0
    """Of the setpoint (rad/s, m/s, N m or V), if the drive's is coarser than its objects: a PWM bridge has steps."""
    stop_reaction: Literal["quick_stop", "disable_voltage", "fault"] = "quick_stop"
    """What the drive does when this service is gone (6007h)."""
    sdo_timeout: Annotated[float, up_to(30.0, "a drive that is off would be noticed too late")] = 1.0
    """s that the drive may need to answer an SDO request, as after boot-up or while it stores a mapping."""
    mode_timeout: Annotated[float, up_to(60.0, "a drive that does not follow would be noticed too late")] = 5.0
    """s that the drive may need to adopt a mode, or to switch off."""
    target_velocity_fine_index: Annotated[int, Field(ge=0x2000, le=0x5FFF)] = 0x2F15
    """Vendor object of the fine part of the target velocity (1/8192 rpm), if `rpdo` maps it."""
    rpdo: list[list[str]]
    """Objects in each RPDO, in order."""
    tpdo: list[list[str]]
    """Objects in each TPDO, in order."""

    @property
    def axis_per_turn(self) -> float:
        """rad, or m of a linear axis, per motor turn."""
        if self.gear_ratio is not None:
            return 2.0 * math.pi / self.gear_ratio
        assert self.lead is not None
        return self.lead


class ParameterEntry(Section):
    value: float
    std: NotNegative
    """Standard deviation of the CAD value."""
    unit: str


class LimitsSection(Section):
    """Limits of every kind of vehicle; each has further limits of its own."""

    support_deg: Annotated[float, up_to(45.0, "a support carries a vehicle that leans, not one that lies")]
    missed_cycles: Annotated[int, Field(ge=1, le=50)] = 7


class ParametersSection(Section):
    """CAD values; each kind of vehicle has its own, with the units in `UNITS`. All are positive."""

    UNITS: ClassVar[Mapping[str, str]]

    @model_validator(mode="after")
    def _units_and_signs(self) -> Self:
        for name, entry in self._given.items():
            if entry.unit != self.UNITS[name]:
                raise ValueError(f"{name} is in {entry.unit!r}; give it in {self.UNITS[name]!r}")
            if entry.value <= 0:
                raise ValueError(f"{name} must be positive, not {entry.value}")
        return self

    @property
    def values(self) -> dict[str, float]:
        """Name to CAD value, SI, of those that are given."""
        return {name: entry.value for name, entry in self._given.items()}

    @property
    def deviations(self) -> dict[str, float]:
        """Name to the CAD value's standard deviation, SI."""
        return {name: entry.std for name, entry in self._given.items()}

    @property
    def _given(self) -> dict[str, ParameterEntry]:
        entries = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: entry for name, entry in entries.items() if entry is not None}


class ControllerSection(Section):
    """Parameters of the controller; each kind of vehicle has a controller of its own."""


class LoadSection(Section):
    """What a person does to the vehicle during an experiment, when the service says so."""

    torque: float
    """N m about the axis that the vehicle falls about, with the sign of its angle."""
    ramp: Positive = 1.0
    """s in which it is put on."""
    after: NotNegative = 5.0
    """s after the start of the excitation."""
    announcement: str
    """The sentence that asks the person for it."""

    @field_validator("torque")
    @classmethod
    def _is_a_load(cls, torque: float) -> float:
        if torque == 0.0 or not math.isfinite(torque):
            raise ValueError(f"{torque:g} N m is no load: give its torque, with the sign of the angle it pushes to")
        return torque


class TiltSection(Section):
    """What a person does with a vehicle at rest, when the service says so: tilt it over to its other support."""

    after: NotNegative = 5.0
    """s after the start of the recording."""
    duration: Positive = 5.0
    """s that it should take; slowly, so that nobody is hurt and the IMU sees a clean motion."""
    announcement: str
    """The sentence that asks the person for it."""


class SpinSection(Section):
    """What a person does with the flywheels of a vehicle at rest, when the service says so."""

    up: bool
    """Whether they are to be brought to their speed; else their inverters are switched off, and they run down."""
    after: NotNegative = 5.0
    """s after the start of the recording."""
    announcement: str
    """The sentence that asks the person for it."""


Asked = LoadSection | TiltSection | SpinSection
"""What a person may be asked to do during an experiment."""
ASKED: Mapping[str, type[Asked]] = {"load": LoadSection, "tilt": TiltSection, "spin": SpinSection}
"""The same by the key of the experiment, of the daemon's state and of the event."""


class ExperimentSection(Section):
    title: str
    excitation: Literal["none", "step", "sweep", "sine", "square", "doublet", "sine_stream", "multisine", "silence"]
    """`silence`: the service withholds setpoints and heartbeat for `width` s, as if its plug had been pulled."""
    at: str = ""
    """Where the excitation is added: one of the injection points of its kind of vehicle, by default the first of
    them."""
    controller: str | None = None
    """What holds the vehicle up: one of the controllers of its kind, by default the first of them."""
    duration: Positive
    amplitude: Positive | None = None
    amplitude_deg: Positive | None = None
    start_frequency: Positive | None = None
    stop_frequency: Positive | None = None
    frequency: Positive | None = None
    frequencies: list[Positive] | None = None
    width: Positive | None = None
    lines: Annotated[int, Field(ge=2)] | None = None
    spectrum: Annotated[list[tuple[Positive, Positive, float]], Field(min_length=1)] | None = None
    """Of a multisine in place of `start_frequency`, `stop_frequency` and `lines`: for each line its frequency (Hz), its
    share of the amplitude and its phase (deg). `upright multisine` designs one."""
    load: LoadSection | None = None
    """A load that a person puts on the vehicle; it stays until the vehicle lies on its support again."""
    tilt: TiltSection | None = None
    """A person tilts the vehicle over, which is at rest with its drives off."""
    spin: SpinSection | None = None
    """A person brings the flywheels to their speed, or lets them run down, while the vehicle is at rest."""

    @property
    def asks(self) -> Asked | None:
        """What a person is asked to do during the experiment."""
        return self.load or self.tilt or self.spin

    @property
    def gets_up(self) -> bool:
        """Whether the vehicle leaves its support."""
        return self.at != ON_SUPPORT and not (self.at == REST and self.excitation == "none")

    @model_validator(mode="after")
    def _person_finds_the_vehicle_as_told(self) -> Self:
        if self.load is not None and not self.gets_up:
            raise ValueError("a load is put on a vehicle that is up: leave out load, or choose another at")
        if sum(each is not None for each in (self.load, self.tilt, self.spin)) > 1:
            raise ValueError("a person does one thing during an experiment: leave only one of load, tilt and spin")
        at_rest = self.at == REST and self.excitation == "none"
        if self.tilt is not None and not at_rest:
            raise ValueError('a vehicle is tilted by hand with its drives off: excitation = "none" and at = "rest"')
        if self.spin is not None and not (at_rest and self.spin.after < self.duration):
            raise ValueError(
                "flywheels are switched while the vehicle lies on its support with its drives off, before the duration "
                'is over: excitation = "none", at = "rest", and a longer duration'
            )
        if self.tilt is not None and self.tilt.after + self.tilt.duration > self.duration:
            raise ValueError(
                f"the vehicle is tilted {self.tilt.after + self.tilt.duration:g} s after the start, but the duration "
                f"is {self.duration:g} s: make it longer"
            )
        return self

    @model_validator(mode="after")
    def _load_is_on_in_time(self) -> Self:
        if self.load is not None and self.load.after + self.load.ramp > self.duration:
            raise ValueError(
                f"the load is on {self.load.after + self.load.ramp:g} s after the start, but the duration is "
                f"{self.duration:g} s: make it longer"
            )
        return self

    @model_validator(mode="after")
    def _complete(self) -> Self:
        needed = {
            "none": (),
            "step": (),
            "sweep": ("start_frequency", "stop_frequency"),
            "sine": ("frequency",),
            "square": ("frequency",),
            "doublet": ("width",),
            "sine_stream": ("frequencies",),
            "multisine": ("start_frequency", "stop_frequency", "lines") if self.spectrum is None else (),
            "silence": ("width",),
        }[self.excitation]
        if self.spectrum is not None and self.excitation != "multisine":
            raise ValueError(f"only a multisine has a spectrum, not a {self.excitation}")
        missing = [key for key in needed if getattr(self, key) is None]
        if missing:
            raise ValueError(f"a {self.excitation} needs {', '.join(missing)}")
        if (self.excitation == "silence") and self.at != ON_SUPPORT:
            raise ValueError(f'a vehicle must lie on its support when its drives are left alone: at = "{ON_SUPPORT}"')
        if self.excitation in ("none", "silence"):
            return self
        on_angle = is_reference(self.at)
        amplitude, other = ("amplitude_deg", "amplitude") if on_angle else ("amplitude", "amplitude_deg")
        if getattr(self, amplitude) is None or getattr(self, other) is not None:
            raise ValueError(f"a {self.excitation} at {self.at} needs {amplitude}, and no {other}")
        if (self.excitation == "step") != (self.at == REST):
            raise ValueError('of the excitations the step, and only the step, starts at = "rest"')
        return self

    @property
    def amplitude_si(self) -> float:
        """rad on a reference angle, else in the unit of the controller's output (rad/s, V); 0 without excitation."""
        if self.amplitude_deg is not None:
            return math.radians(self.amplitude_deg)
        return self.amplitude or 0.0


class MqttSection(Section):
    broker: Annotated[str, Field(pattern=r"^$|^[^:\s]+:\d+$")] = ""
    """HOST:PORT; empty turns MQTT off."""
    base: Annotated[str, Field(pattern=r"^[^#+\s]+$")] = "upright"
    """Topics are BASE/VEHICLE_ID/..."""
    telemetry_rate: Annotated[int, Field(ge=1, le=50)] = 20
    username: str = ""
    password_file: str = ""
    """File whose first line is the password."""
    tls: bool = False
    """Whether to speak TLS; the broker's certificate must be valid for its host name."""
    ca_file: str = ""
    """File with the certificate of the authority that signed the broker's; empty: the system's."""
    commands: bool = False
    """Whether commands are accepted over MQTT."""
    home_assistant: bool = False
    """Whether the vehicle presents itself to Home Assistant, with sensors only."""


class VehicleFile(Section):
    """One vehicle, checked. Each kind has a subclass with the sections of its own."""

    ROLES: ClassVar[Mapping[str, Role]]
    """The drives that this kind of vehicle has."""
    INJECTION_POINTS: ClassVar[tuple[str, ...]]
    """Where the excitations of its experiments may enter; the first is the default."""
    CONTROLLERS: ClassVar[tuple[str, ...]] = ()
    """What may hold it up; the first is the default. Empty if there is only one."""

    vehicle: VehicleSection
    bus: BusSection
    control: ControlSection
    imu: ImuSection
    drive: list[DriveSection]
    limits: LimitsSection
    parameters: ParametersSection
    controller: ControllerSection
    experiments: dict[str, ExperimentSection]
    mqtt: MqttSection = MqttSection()
    columns: dict[str, str] = {}
    """By channel, or `time`: the column of a table of another origin that it is read from, as `COLUMN` or
    `COLUMN:UNIT`."""
    path: str = ""
    """Where it was read from."""
    configuration_hash: str = ""
    """SHA-256 of the file's bytes, first 16 hex digits."""

    @model_validator(mode="before")
    @classmethod
    def _experiments_enter_somewhere(cls, table: Any) -> Any:
        experiments = table.get("experiments") if isinstance(table, dict) else None
        if not isinstance(experiments, dict):
            return table
        usual = {"at": cls.INJECTION_POINTS[0]}
        placed = {name: usual | each if isinstance(each, dict) else each for name, each in experiments.items()}
        return {**table, "experiments": placed}

    @field_validator("drive")
    @classmethod
    def _one_transmission_each(cls, drives: list[DriveSection]) -> list[DriveSection]:
        for drive in drives:
            wanted, other = ("gear_ratio", "lead")
            if cls.ROLES.get(drive.role, NO_ROLE).linear:
                wanted, other = other, wanted
            if getattr(drive, wanted) is None or getattr(drive, other) is not None:
                raise ValueError(f"{drive.name}: a {drive.role} drive needs {wanted}, and no {other}")
        return drives

    @model_validator(mode="after")
    def _drives_fit_the_kind(self) -> Self:
        roles: list[str] = [drive.role for drive in self.drive]
        for role in (*self.ROLES, *roles):
            known = self.ROLES.get(role, NO_ROLE)
            if not known.least <= roles.count(role) <= known.most:
                count = f"{known.least}" if known.least == known.most else f"{known.least} to {known.most}"
                raise ValueError(
                    f"drive: {roles.count(role)} drives have the role {role}, but a {self.vehicle.kind} has {count}"
                )
        return self

    @model_validator(mode="after")
    def _experiments_fit_the_kind(self) -> Self:
        for name, experiment in self.experiments.items():
            if experiment.controller is not None and experiment.controller not in self.CONTROLLERS:
                several = ", ".join(self.CONTROLLERS)
                known = f"use one of {several}" if several else "leave it out: it has only one"
                raise ValueError(
                    f"experiments.{name}: controller = {experiment.controller!r} is not one of a {self.vehicle.kind}; "
                    f"{known}"
                )
            if experiment.at == ON_SUPPORT and experiment.amplitude_si > self.largest_on_support:
                raise ValueError(
                    f"experiments.{name}: an amplitude of {experiment.amplitude_si:g} on the support is more than the "
                    f"{self.largest_on_support:.3g} that leave a {self.vehicle.kind} lying there safely"
                )
            if experiment.gets_up and experiment.at not in self.INJECTION_POINTS:
                raise ValueError(
                    f"experiments.{name}: at = {experiment.at!r} is not an injection point of a {self.vehicle.kind}; "
                    f"use one of {', '.join(self.INJECTION_POINTS)}"
                )
        return self

    @model_validator(mode="after")
    def _nodes_do_not_clash(self) -> Self:
        names = [drive.name for drive in self.drive]
        if len(set(names)) != len(names):
            raise ValueError("drive: two drives have the same name")
        nodes = [drive.node for drive in self.drive]
        if len(set(nodes)) != len(nodes):
            raise ValueError("drive: two drives have the same node id")
        if self.control.master_node in nodes:
            raise ValueError(f"control.master_node {self.control.master_node} is also the node id of a drive")
        if self.imu.protocol == "canopen" and self.bus.imu == self.bus.drives and (self.imu.base_id & 0x7F) in nodes:
            raise ValueError(
                f"imu.base_id {self.imu.base_id:#x}: CANopen id {self.imu.base_id & 0x7F} is also a drive's node "
                "id, and both would send the same frames; change it in the device and here"
            )
        return self

    @model_validator(mode="after")
    def _ids_do_not_clash(self) -> Self:
        """A set of frames with consecutive ids may reach into those of CANopen."""
        nodes = [can_ids.Node(each.name, each.node, len(each.rpdo), len(each.tpdo)) for each in self.drive]
        owners = can_ids.owners(self.control.master_node, nodes)
        for speed in self.observed:
            if speed.can_id in owners:
                raise ValueError(
                    f"{speed.name}: the frame {speed.can_id:03X}h carries {owners[speed.can_id]}; give the id of the "
                    "frame in which its inverter reports the speed, or change that id in the inverter"
                )
            owners[speed.can_id] = f"the speed of {speed.name}"
        if self.bus.imu != self.bus.drives:
            return self
        ids = can_ids.imu_ids(self.imu.protocol, self.imu.base_id, self.imu.precision, self.imu.slots)
        for can_id in ids:
            if can_id in owners:
                free = can_ids.free_base(len(ids), owners)
                use = f", for example {free:#x}" if self.imu.protocol == "sequential" and free is not None else ""
                raise ValueError(
                    f"imu.base_id {self.imu.base_id:#x}: the IMU's frame {can_id:03X}h carries {owners[can_id]} as "
                    f"well; set another id in the device and here{use}, or use a second bus"
                )
        return self

    def has(self, section: str) -> bool:
        """Whether this section, which the kind has to know, has an entry in the file."""
        return bool(getattr(self, section))

    @property
    def observed(self) -> tuple[SpeedConfig, ...]:
        """The speeds that are read on the bus of the drives and commanded by somebody else."""
        return ()

    def with_values(self, values: Mapping[str, float], deviations: Mapping[str, float] | None = None) -> Self:
        """The same vehicle with other parameter values (SI) and standard deviations; names that it does not have, or
        does not give, are ignored.

        Raises ValueError if a value is not positive.
        """
        known = {
            name: {
                "value": values.get(name, entry.value),
                "std": (deviations or {}).get(name, entry.std),
                "unit": entry.unit,
            }
            for name, entry in self.parameters._given.items()
        }
        return self.model_copy(update={"parameters": type(self.parameters).model_validate(known)})

    @property
    def largest_on_support(self) -> float:
        """Largest excitation of the drives, in the unit of the controller's output, that leaves the vehicle lying on
        its support; 0 if that is not known of this kind, which is then not moved there."""
        return 0.0

    @property
    def period(self) -> float:
        """s of a control cycle."""
        return 1.0 / self.control.rate

    @property
    def longest_silence(self) -> float:
        """s without IMU or drive that a run survives: `limits.missed_cycles` whole cycles, and half a one of jitter."""
        return (self.limits.missed_cycles + 0.5) * self.period

    @property
    def setpoint_timeout(self) -> float:
        """s without a setpoint after which a drive stops by itself (1400h:5 and up). The service itself stops after
        `limits.missed_cycles` late cycles; a drive that goes on with its last setpoint for longer throws the vehicle
        onto its support. A cycle and a half more, but no longer than for a heartbeat."""
        return min(self.control.heartbeat_timeout, (self.limits.missed_cycles + 1.5) * self.period)

    @property
    def support(self) -> float:
        """rad of the angle at which the supports (monorail) or the bumpers (robot) carry the vehicle."""
        return math.radians(self.limits.support_deg)
