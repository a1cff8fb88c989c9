"""The configuration of a virtual vehicle: its true physics, its drives, its IMU, and its hidden effects.

SI units. Axes are those of ISO 8855 (x forward, y left, z up); roll is positive right side down, precession positive
when its rate gives a positive roll torque, the trim mass positive to the right; tilt positive forward.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Protocol

from upright.simulation.drive_habits import DriveHabits
from upright.simulation.physics.disturbance import Disturbance, RandomTorque
from upright.simulation.physics.narrow_band import NarrowBand, NarrowBandTorque
from upright.simulation.registry import Registry, sizes_of
from upright.telemetry.samples import Vector3

EVENT_TIME = 10.0
"""s after the first SYNC at which a person sits down, unless stated otherwise."""


class Truth(Protocol):
    """The true physics of one kind of vehicle; simulation.kinds makes its mechanics from it."""

    @property
    def gravity(self) -> float:
        """m/s^2."""
        ...

    @property
    def falling_inertia(self) -> float:
        """kg m^2: effective inertia for a torque about the axis it falls about, near upright."""
        ...

    @property
    def registry(self) -> Registry:
        """The effects that can be hidden in this kind of vehicle."""
        ...


@dataclass(frozen=True, slots=True)
class DriveNode:
    """One drive on the bus. `rpdo` and `tpdo` are its power-on mapping, by object name (see `objects`)."""

    name: str
    role: str
    """Of several drives with the same role the first one is the left."""
    node: int
    direction: int
    """+1 if a positive motor speed gives a positive roll torque, or drives forward."""
    axis_per_turn: float
    """rad or m of the axis per motor turn."""
    increments_per_turn: int
    """Of 6064h, per motor turn."""
    velocity_unit_rpm: float
    """rpm per unit of 606Ch and 60FFh."""
    rated_torque: float
    """N m at the motor."""
    eds: Path | str
    mode: int = 2
    """CiA 402 mode of operation; 10 is cyclic synchronous torque, -1 the voltage mode of
    upright_motor.eds."""
    vendor_id: int = 0
    """Reported in 1018h:1; 0 leaves the EDS's value."""
    product_code: int = 0
    revision: int = 0
    """Of the firmware, 1018h:3; likewise."""
    rpdo: Sequence[Sequence[str]] = (("controlword", "target_velocity", "target_velocity_fine"),)
    tpdo: Sequence[Sequence[str]] = (("statusword", "velocity_actual", "torque_actual"), ("position_actual",))
    target_velocity_fine_index: int = 0x2F15
    """Vendor object of the fine part of the target velocity, 1/8192 rpm."""
    ramp_bits: bool = True
    """Honours controlword bits 4 to 6 in velocity mode (2): without them the reference is zero."""
    habits: DriveHabits = field(default_factory=DriveHabits)
    """How it answers over SDO."""


@dataclass(frozen=True, slots=True)
class ImuNode:
    """The LPMS-IG1 on the bus and its errors (noise of gyro I, data sheet figures)."""

    protocol: Literal["canopen", "sequential"] = "canopen"
    base_id: int = 0x18A
    precision: Literal["float32", "int16"] = "float32"
    slots: Sequence[str] = (
        "acceleration_x",
        "acceleration_y",
        "acceleration_z",
        "angular_rate_x",
        "angular_rate_y",
        "angular_rate_z",
    )
    axes: tuple[str, str, str] = ("+x", "+y", "+z")
    """Sensor axis that points along the vehicle's x, y and z."""
    acceleration_sign: int = 1
    angular_rate_unit: Literal["deg/s", "rad/s"] = "deg/s"
    position: Vector3 = (0.0, 0.0, 0.9)
    """m, from the axis that the vehicle falls about: the rail head, the axle."""
    angular_rate_density: float = 3.5e-5
    """rad/s/sqrt(Hz), white."""
    angular_rate_bias: Vector3 = (8.7e-4, -8.7e-4, 8.7e-4)
    """rad/s at switch-on (0.05 deg/s)."""
    bias_random_walk: float = 2.0e-6
    """rad/s/sqrt(s)."""
    acceleration_std: float = 0.015
    """m/s^2 per sample."""
    latency: float = 0.0
    """s, from the measurement to the frame that carries it."""
    send_jitter: float = 50e-6
    """s, standard deviation of how late a set leaves the device; in real time only."""


@dataclass(frozen=True, slots=True)
class SpeedNode:
    """The inverter of a flywheel, which reports its speed in the frame `can_id`: little-endian from `start_byte` on,
    `unit` rad/s a count, with the sign of the direction in which it has to turn."""

    can_id: int
    start_byte: int = 0
    layout: Literal["int16", "int32"] = "int32"
    unit: float = 1e-4
    period: float = 0.05
    """s between two reports."""


@dataclass(frozen=True, slots=True)
class SimulationConfig:
    """One virtual vehicle. `hidden` maps a hidden effect to its level, a multiple of its usual amplitude (None: 1)."""

    plant: Truth
    drives: Sequence[DriveNode] = ()
    imu: ImuNode = field(default_factory=ImuNode)
    speeds: Sequence[SpeedNode] = ()
    """Inverters of flywheels that report their speed, in the order of the machine's flywheels."""
    flywheels_stand: bool = False
    """Whether the flywheels stand still, switched off, at the start; else they are at their speed."""
    rate: int = 250
    """Hz of the IMU's stream: the control cycle."""
    seed: int = 1
    hidden: Mapping[str, float | None] = field(default_factory=dict)
    onsets: Mapping[str, float] = field(default_factory=dict)
    """s after the first SYNC at which a hidden effect sets in; the others act from the start."""
    disturbance: Disturbance | None = None
    """Random torque about the axis that the vehicle falls about; None: none."""
    narrow_band: NarrowBand | None = None
    """A second random torque, of a narrow band, likewise."""

    @property
    def sizes(self) -> dict[str, float]:
        """The amplitude of each hidden effect in its own unit. Raises UnknownEffectError."""
        return sizes_of(self.hidden, self.plant.registry)

    @property
    def random_torques(self) -> tuple[RandomTorque | NarrowBandTorque, ...]:
        """The random torques about the axis that the vehicle falls about, each at its beginning."""
        found: list[RandomTorque | NarrowBandTorque] = []
        if self.disturbance is not None:
            found.append(RandomTorque(self.disturbance, self.step, self.seed))
        if self.narrow_band is not None:
            found.append(NarrowBandTorque(self.narrow_band, self.step, self.seed))
        return tuple(found)

    @property
    def period_ns(self) -> int:
        """ns between IMU sets."""
        return 1_000_000_000 // self.rate

    @property
    def steps_per_ms(self) -> int:
        """Integration steps per millisecond: at least ten per control period, none longer than half a millisecond."""
        return max(2, -(-self.rate // 100))

    @property
    def steps_per_period(self) -> int:
        """Integration steps from one IMU set to the next."""
        return self.steps_per_ms * 1000 // self.rate

    @property
    def step(self) -> float:
        """s, of the integrator and of the drives' inner loops."""
        return 1e-3 / self.steps_per_ms
