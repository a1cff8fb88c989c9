"""The vehicle as the control loop sees it: CAN frames in, one `Measurement` a cycle; setpoints in, CAN frames out.

Live control and replay of a raw log run this same code, so what a recording holds can be rebuilt from its frames.
Sign: a positive precession rate gives a positive roll torque; each drive's `direction` maps its motor onto that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drivers.cia402.drive import Drive
from drivers.cia402.states import State
from drivers.imu import Imu
from telemetry.samples import CanFrame, ImuSample

NAN = float("nan")


@dataclass(frozen=True, slots=True)
class Measurement:
    """What the drives reported last, in axis units (rad, rad/s, m, m/s).

    `timestamp_ns` is that of the oldest value in it, 0 while a drive has not answered yet; `gimbal_mismatch` is the
    largest difference between two gimbals (rad).
    """

    timestamp_ns: int
    precession: float
    precession_rate: float
    gimbal_mismatch: float
    trim_position: float
    trim_rate: float


NOTHING_MEASURED = Measurement(0, NAN, NAN, NAN, NAN, NAN)


class VehicleIo:
    """Dispatches the frames of the IMU and the drives, and builds the frames of a command."""

    def __init__(self, imu: Imu, drives: Sequence[Drive]) -> None:
        self.imu = imu
        self.drives = tuple(drives)
        self.gimbals = tuple(drive for drive in drives if drive.config.role == "gimbal")
        self.trim = next((drive for drive in drives if drive.config.role == "trim"), None)
        self._handlers: dict[int, Callable[[CanFrame], object]] = {}
        for drive in self.drives:
            for can_id in drive.can_ids:
                self._handlers[can_id] = drive.handle
        for can_id in imu.can_ids:
            self._handlers[can_id] = self._handle_imu
        self._sample: ImuSample | None = None

    @property
    def can_ids(self) -> tuple[int, ...]:
        """Every CAN id this vehicle is known to use."""
        return tuple(self._handlers)

    def handle(self, frame: CanFrame) -> ImuSample | None:
        """Take one frame; the IMU sample that it completed, if it did. Frames of others are ignored."""
        handler = self._handlers.get(frame.can_id)
        if handler is None or frame.error or frame.remote or frame.extended:
            return None
        self._sample = None
        handler(frame)
        return self._sample

    def _handle_imu(self, frame: CanFrame) -> None:
        self._sample = self.imu.handle(frame)

    def measurement(self) -> Measurement:
        """The drives' latest values; `NOTHING_MEASURED` until each of them has sent all of its own."""
        oldest = 0
        for drive in self.drives:
            timestamp_ns = drive.timestamp_ns
            if timestamp_ns == 0:
                return NOTHING_MEASURED
            if oldest == 0 or timestamp_ns < oldest:
                oldest = timestamp_ns
        positions = [gimbal.position for gimbal in self.gimbals]
        rates = [gimbal.velocity for gimbal in self.gimbals]
        trim = self.trim
        return Measurement(
            oldest,
            sum(positions) / len(positions),
            sum(rates) / len(rates),
            max(positions) - min(positions),
            trim.position if trim is not None else 0.0,
            trim.velocity if trim is not None else 0.0,
        )

    def command(self, target: State, precession_rate: float, trim_rate: float) -> list[tuple[int, bytes]]:
        """The setpoint frames of one cycle: each drive one step towards `target`, moving at these axis rates."""
        frames: list[tuple[int, bytes]] = []
        for drive in self.drives:
            frames.extend(drive.command(target, precession_rate if drive is not self.trim else trim_rate))
        return frames

    @property
    def precession_rate_setpoint(self) -> float:
        """rad/s as last sent, quantised; the mean over the gimbals."""
        return sum(gimbal.velocity_setpoint for gimbal in self.gimbals) / len(self.gimbals)

    @property
    def trim_rate_setpoint(self) -> float:
        """m/s as last sent, quantised."""
        return self.trim.velocity_setpoint if self.trim is not None else 0.0

    def reset(self, start_ns: int) -> None:
        """Forget every measured value: only frames from `start_ns` on count."""
        self.imu.reset(start_ns)
        for drive in self.drives:
            drive.reset()

    @property
    def state(self) -> State | None:
        """The state that all drives are in; None where they differ."""
        state = self.drives[0].state
        return state if all(drive.state is state for drive in self.drives) else None
