"""The vehicle file: everything about one vehicle that is not code (TOML, checked by pydantic).

`load("monocab")` reads a shipped file, `load("path/to/file.toml")` one of the user's own. Whatever is wrong ends in a
`VehicleFileError` that names the file, the key and the remedy. Units are SI unless a key ends in `_deg` or `_rpm`.
"""

from __future__ import annotations

import difflib
import hashlib
import math
import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from telemetry.errors import UprightError

IMU_RATES = (50, 100, 250, 500)
"""Stream rates of the LPMS-IG1 that are fast enough to balance on, Hz."""

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]
CanId = Annotated[int, Field(ge=1, le=0x7FF)]
NodeId = Annotated[int, Field(ge=1, le=127)]
BusAddress = Annotated[str, Field(pattern=r"^[a-z_0-9]+:.+$", description="IFACE:CHANNEL, as in socketcan:can0")]


class VehicleFileError(UprightError):
    """A vehicle file that cannot be used. `file` and `key` say where, `remedy` says what to change."""

    def __init__(self, file: str, key: str, message: str, *, remedy: str = "") -> None:
        super().__init__(f"{file}: {key}: {message}" if key else f"{file}: {message}", remedy=remedy)
        self.file = file
        self.key = key


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class VehicleSection(_Section):
    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,32}$")]
    """Name in MQTT topics, recordings and the control socket."""
    kind: Literal["monocab"]
    """What the vehicle is: chooses its channels, model and controller."""
    description: str = ""


class BusSection(_Section):
    drives: BusAddress
    """Bus of the servo inverters."""
    imu: BusAddress
    """Bus of the IMU; the same as `drives` or a second one."""
    bitrate: Annotated[int, Field(ge=10_000, le=1_000_000)] = 1_000_000
    """bit/s, of classical CAN."""


class ControlSection(_Section):
    rate: int = 250
    """Hz: the IMU's stream rate, which is the clock of the control loop."""
    master_node: NodeId = 127
    """CANopen node id of this service."""
    heartbeat_period: Positive = 0.04
    """s between heartbeats of the control loop."""
    heartbeat_timeout: Positive = 0.12
    """s after which a drive that misses the heartbeat stops by itself (written to 1016h)."""

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


class FilterSection(_Section):
    acceleration_std: Positive
    """m/s^2 a sample, vibration included."""
    angular_rate_density: Positive
    """rad/s/sqrt(Hz)."""
    bias_random_walk: Positive
    """rad/s/sqrt(s)."""


class ImuSection(_Section):
    protocol: Literal["canopen", "sequential"]
    base_id: CanId
    """CAN id of the first frame of a set."""
    precision: Literal["float32", "int16"]
    slots: list[str]
    """What the device's channel slots carry, in order."""
    axes: tuple[str, str, str] = ("+x", "+y", "+z")
    """Sensor axis that points along the vehicle's x (forward), y (left) and z (up)."""
    acceleration_sign: Literal[1, -1] = 1
    """-1 where the device reports -1 g along the axis that points up."""
    angular_rate_unit: Literal["deg/s", "rad/s"] = "deg/s"
    acceleration_range: Positive = 39.2
    """m/s^2."""
    angular_rate_range_deg: Positive = 400.0
    """deg/s."""
    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """m, from the roll axis to the accelerometer, in vehicle axes."""
    latency: NotNegative = 0.0
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


class DriveSection(_Section):
    name: Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]
    role: Literal["gimbal", "trim"]
    node: NodeId
    direction: Literal[1, -1]
    """+1 where a positive motor speed gives a positive roll torque."""
    gear_ratio: Positive | None = None
    """Motor turns a gimbal turn (rotary axes)."""
    lead: Positive | None = None
    """m a motor turn (linear axes)."""
    mode: Literal[2, 9]
    """CiA 402 mode: 2 velocity (6042h, rpm), 9 cyclic synchronous velocity (60FFh)."""
    increments_per_turn: Annotated[int, Field(gt=0)]
    """Of 6064h, a motor turn."""
    velocity_unit_rpm: Positive
    """rpm a unit of 606Ch and 60FFh."""
    rated_torque: Positive
    """N m at the motor, the base of 6077h."""
    eds: str = "upright_servo.eds"
    vendor_id: Annotated[int, Field(ge=0)] = 0
    product_code: Annotated[int, Field(ge=0)] = 0
    stop_reaction: Literal["quick_stop", "disable_voltage"] = "quick_stop"
    target_velocity_fine_index: Annotated[int, Field(ge=0x2000, le=0x5FFF)] = 0x2F15
    """Vendor object of the fine part of the target velocity (1/8192 rpm), where `rpdo` maps it."""
    rpdo: list[list[str]]
    """Objects in each RPDO, in order."""
    tpdo: list[list[str]]
    """Objects in each TPDO, in order."""

    @model_validator(mode="after")
    def _one_transmission(self) -> Self:
        wanted, other = ("gear_ratio", "lead") if self.role == "gimbal" else ("lead", "gear_ratio")
        if getattr(self, wanted) is None or getattr(self, other) is not None:
            raise ValueError(f"a {self.role} drive has a {wanted}, and no {other}")
        return self

    @property
    def axis_per_turn(self) -> float:
        """rad (gimbal) or m (trim) of the axis a motor turn."""
        if self.gear_ratio is not None:
            return 2.0 * math.pi / self.gear_ratio
        assert self.lead is not None
        return self.lead


class LimitsSection(_Section):
    roll_deg: Positive
    roll_rate_deg: Positive
    precession_deg: Positive
    precession_budget_deg: Positive
    precession_rate: Positive
    precession_acceleration: Positive
    gimbal_mismatch_deg: Positive
    trim_position: Positive
    trim_rate: Positive
    support_deg: Positive
    missed_cycles: Annotated[int, Field(ge=1, le=50)] = 3

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.support_deg >= self.roll_deg:
            raise ValueError("support_deg must be below roll_deg, or resting on a support is a fault")
        if self.precession_budget_deg >= self.precession_deg:
            raise ValueError("precession_budget_deg must be below precession_deg, or a run cannot end in order")
        if self.precession_deg >= 90:
            raise ValueError("precession_deg must be below 90: there the gyro has no roll torque left")
        return self


class ParameterEntry(_Section):
    value: float
    std: NotNegative
    """Standard deviation of the CAD value."""
    unit: str


class ParametersSection(_Section):
    inertia: ParameterEntry
    gravity_stiffness: ParameterEntry
    angular_momentum: ParameterEntry
    speed_loop_lag: ParameterEntry
    trim_mass: ParameterEntry
    trim_height: ParameterEntry
    gimbal_inertia: ParameterEntry | None = None
    """Of both gimbals with their rotors, about the precession axes; for the apparent inertia alone."""

    @model_validator(mode="after")
    def _units_and_signs(self) -> Self:
        units = {
            "inertia": "kg m^2",
            "gravity_stiffness": "N m/rad",
            "angular_momentum": "N m s",
            "speed_loop_lag": "s",
            "trim_mass": "kg",
            "trim_height": "m",
            "gimbal_inertia": "kg m^2",
        }
        for name, unit in units.items():
            entry: ParameterEntry | None = getattr(self, name)
            if entry is None:
                continue
            if entry.unit != unit:
                raise ValueError(f"{name} is in {entry.unit!r}; give it in {unit!r}")
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


class ControllerSection(_Section):
    roll_weight: Positive
    roll_rate_weight: NotNegative
    integral_weight: Positive
    effort_weight: Positive
    precession_return_time: NotNegative
    precession_return_limit_deg: NotNegative


class ExperimentSection(_Section):
    title: str
    excitation: Literal["none", "step", "sweep", "square", "doublet", "sine_stream", "multisine"]
    at: Literal["rest", "roll_reference", "controller_output"] = "roll_reference"
    duration: Positive
    amplitude: Positive | None = None
    amplitude_deg: Positive | None = None
    start_frequency: Positive | None = None
    stop_frequency: Positive | None = None
    frequency: Positive | None = None
    frequencies: list[Positive] | None = None
    width: Positive | None = None
    lines: Annotated[int, Field(ge=2)] | None = None

    @model_validator(mode="after")
    def _complete(self) -> Self:
        needed = {
            "none": (),
            "step": (),
            "sweep": ("start_frequency", "stop_frequency"),
            "square": ("frequency",),
            "doublet": ("width",),
            "sine_stream": ("frequencies",),
            "multisine": ("start_frequency", "stop_frequency", "lines"),
        }[self.excitation]
        missing = [key for key in needed if getattr(self, key) is None]
        if missing:
            raise ValueError(f"a {self.excitation} needs {', '.join(missing)}")
        if self.excitation == "none":
            return self
        amplitude = "amplitude_deg" if self.at == "roll_reference" else "amplitude"
        other = "amplitude" if self.at == "roll_reference" else "amplitude_deg"
        if getattr(self, amplitude) is None or getattr(self, other) is not None:
            raise ValueError(f"a {self.excitation} at {self.at} has its size in {amplitude}, and no {other}")
        if (self.excitation == "step") != (self.at == "rest"):
            raise ValueError('the step, and only the step, starts at = "rest"')
        return self

    @property
    def amplitude_si(self) -> float:
        """rad on the roll reference, rad/s of precession rate elsewhere; 0 without excitation."""
        if self.amplitude_deg is not None:
            return math.radians(self.amplitude_deg)
        return self.amplitude or 0.0


class MqttSection(_Section):
    broker: Annotated[str, Field(pattern=r"^$|^[^:\s]+:\d+$")] = ""
    """HOST:PORT; empty turns MQTT off."""
    base: Annotated[str, Field(pattern=r"^[^#+\s]+$")] = "upright"
    telemetry_rate: Annotated[int, Field(ge=1, le=50)] = 20
    username: str = ""
    password_file: str = ""
    """File whose first line is the password."""


class VehicleFile(_Section):
    """One vehicle, checked."""

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
    path: str = ""
    """Where it was read from."""
    configuration_hash: str = ""
    """SHA-256 of the file's bytes, first 16 hex digits."""

    @model_validator(mode="after")
    def _nodes_do_not_clash(self) -> Self:
        names = [drive.name for drive in self.drive]
        if len(set(names)) != len(names):
            raise ValueError("drive: two drives have the same name")
        if not any(drive.role == "gimbal" for drive in self.drive):
            raise ValueError("drive: there is no gimbal drive, so nothing holds the vehicle up")
        if sum(drive.role == "trim" for drive in self.drive) > 1:
            raise ValueError("drive: at most one drive has the role trim")
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

    @property
    def period(self) -> float:
        """s of a control cycle."""
        return 1.0 / self.control.rate

    @property
    def support(self) -> float:
        """rad of roll at which the supports carry the vehicle."""
        return math.radians(self.limits.support_deg)


def shipped() -> list[str]:
    """Names of the vehicle files that ship with upright."""
    return sorted(entry.name[:-5] for entry in resources.files("vehicles").iterdir() if entry.name.endswith(".toml"))


def load(name_or_path: str) -> VehicleFile:
    """Read and check a vehicle file: the name of a shipped one, or a path.

    Raises:
        VehicleFileError: no such file, not TOML, or a key that is missing, unknown or wrong.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml" and name_or_path in shipped():
        path = Path(str(resources.files("vehicles") / f"{name_or_path}.toml"))
    try:
        content = path.read_bytes()
    except OSError as error:
        raise VehicleFileError(
            name_or_path,
            "",
            f"cannot be read: {error.strerror}",
            remedy=f"Give a path, or one of: {', '.join(shipped())}.",
        ) from error
    try:
        table = tomllib.loads(content.decode("utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise VehicleFileError(str(path), "", f"is not valid TOML: {error}", remedy="Mend that line.") from error
    return _check(table, str(path), hashlib.sha256(content).hexdigest()[:16])


def _check(table: dict[str, Any], file: str, digest: str) -> VehicleFile:
    for reserved in ("path", "configuration_hash"):
        if reserved in table:
            raise VehicleFileError(file, reserved, "is not a key of a vehicle file", remedy="Remove it.")
    try:
        return VehicleFile.model_validate({**table, "path": file, "configuration_hash": digest})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        message = str(first["msg"]).removeprefix("Value error, ")
        remedy = "Mend this key; `upright config schema` lists every key with its unit."
        if first["type"] == "extra_forbidden":
            message = "is not a key of a vehicle file"
            near = difflib.get_close_matches(str(first["loc"][-1]), _known_keys(first["loc"]), n=1)
            remedy = f"Did you mean {near[0]!r}?" if near else "Remove it; `upright config schema` lists every key."
        elif first["type"] == "missing":
            message = "is missing"
            remedy = "Add it; vehicles/monocab.toml shows every key with its unit."
        elif "input" in first and not isinstance(first["input"], dict | BaseModel):
            message = f"{message} (found {first['input']!r})"
        more = len(error.errors()) - 1
        if more:
            remedy += f" ({more} more to mend after it.)"
        raise VehicleFileError(file, key, message, remedy=remedy) from error


def _known_keys(location: tuple[int | str, ...]) -> list[str]:
    """The keys of the section that `location` is in."""
    model: Any = VehicleFile
    for part in location[:-1]:
        if isinstance(part, str) and part in model.model_fields:
            annotation = model.model_fields[part].annotation
            inner = [a for a in getattr(annotation, "__args__", ()) if isinstance(a, type) and issubclass(a, BaseModel)]
            model = inner[0] if inner else annotation
    return list(model.model_fields) if isinstance(model, type) and issubclass(model, BaseModel) else []
