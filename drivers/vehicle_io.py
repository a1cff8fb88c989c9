"""The vehicle as the control loop sees it: CAN frames in, IMU samples and drive values out; setpoints in, frames out.

Live control and replay of a raw log run this same code, so a recording can be rebuilt from its frames. What the drives'
values mean for one kind of vehicle (a precession rate, a wheel angle) is defined by `vehicles.registry`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import State
from upright.drivers.imu.imu import Imu
from upright.drivers.observed_speed import ObservedSpeed
from upright.telemetry.samples import CanFrame, ImuSample

LARGEST = 8
"""Data bytes of a classical CAN frame."""


class VehicleIo:
    """Dispatches the frames of the IMU, the drives and the observed speeds, and builds the frames of a command."""

    def __init__(self, imu: Imu, drives: Sequence[Drive], speeds: Sequence[ObservedSpeed] = ()) -> None:
        self.imu = imu
        self.drives = tuple(drives)
        self.speeds = tuple(speeds)
        self._following = tuple((drive, drive.config.follows) for drive in self.drives)
        self._handlers: dict[int, Callable[[CanFrame], object]] = {}
        for drive in self.drives:
            for can_id in drive.can_ids:
                self._handlers[can_id] = drive.handle
        for speed in self.speeds:
            self._handlers[speed.config.can_id] = speed.handle
        for can_id in imu.can_ids:
            self._handlers[can_id] = self._handle_imu
        self._sample: ImuSample | None = None

    def watch(self, can_ids: Iterable[int], handler: Callable[[CanFrame], None]) -> None:
        """Give the frames with these ids to `handler` from now on, except those of the IMU.

        For live operation: there, a frame with an id of our own is from somebody else, and says nothing of what we have
        sent. In a raw log, it is our own.
        """
        for can_id in can_ids:
            if can_id not in self.imu.can_ids:
                self._handlers[can_id] = handler

    @property
    def can_ids(self) -> tuple[int, ...]:
        """Every CAN id this vehicle is known to use."""
        return tuple(self._handlers)

    def role(self, name: str) -> tuple[Drive, ...]:
        """The drives of a role, in the order of the vehicle file."""
        return tuple(drive for drive in self.drives if drive.config.role == name)

    def handle(self, frame: CanFrame) -> ImuSample | None:
        """Take one frame; returns the IMU sample that it completed, if any. Frames of others are ignored."""
        handler = self._handlers.get(frame.can_id)
        if handler is None or not self.knows(frame):
            return None
        self._sample = None
        handler(frame)
        return self._sample

    def knows(self, frame: CanFrame) -> bool:
        """Whether a driver reads this frame: a classical data frame with one of `can_ids`."""
        foreign = frame.error or frame.remote or frame.extended or len(frame.data) > LARGEST
        return not foreign and frame.can_id in self._handlers

    def _handle_imu(self, frame: CanFrame) -> None:
        self._sample = self.imu.handle(frame)

    @property
    def timestamp_ns(self) -> int:
        """Receive time of the oldest of the drives' latest values; 0 until each of them has sent all of its own."""
        return min([drive.timestamp_ns for drive in self.drives])

    def command(self, target: State, setpoint: float, others: Sequence[float] = ()) -> list[tuple[int, bytes]]:
        """The setpoint frames of one cycle: each drive one step towards `target`, with the setpoint that it follows:
        `setpoint`, or one of the `others`, which are counted from 1 on; with 0 if that is not given.

        Setpoints are in axis unit/s (rad/s, m/s) or V, as the drives' mode takes it.
        """
        frames: list[tuple[int, bytes]] = []
        given = len(others)
        for drive, number in self._following:
            its = setpoint if number == 0 else others[number - 1] if number <= given else 0.0
            frames.extend(drive.command(target, its))
        return frames

    def reset(self, start_ns: int) -> None:
        """Forget every measured value: only frames from `start_ns` on count."""
        self.imu.reset(start_ns)
        for drive in self.drives:
            drive.reset()
        for speed in self.speeds:
            speed.reset(start_ns)

    @property
    def state(self) -> State | None:
        """The state that all drives are in; None if they differ."""
        state = self.drives[0].state
        return state if all(drive.state is state for drive in self.drives) else None
