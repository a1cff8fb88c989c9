"""The plant as the nodes on the bus see it: a clock, steps, axes that the drives move, a motion that the IMU feels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar

from upright.simulation.bus.drive_application import DriveApplication
from upright.simulation.config import DriveNode
from upright.simulation.physics.load import Action, LoadTorque, Spin
from upright.telemetry.samples import Vector3

Motion = tuple[float, ...]
"""Angle about the axis of `Machine.falling_axis`, its rate and acceleration; then all else that an IMU on it feels."""


class Machine(ABC):
    """A vehicle's mechanics, integrated in steps of `step_size` s. `falling_inertia`: kg m^2, see `Truth`."""

    name: ClassVar[str]
    """Its name in messages, with the article."""
    roles: ClassVar[Mapping[str, int]]
    """Role to number of drives."""
    falling_axis: ClassVar[int]
    """0: it falls about x (roll); 1: about y (tilt)."""

    def __init__(self, step_size: float, falling_inertia: float) -> None:
        self.step_size = step_size
        self.steps = 0
        self.event_origin: float | None = None
        """Time of the first SYNC, from which events are counted; None before it."""
        self.load = LoadTorque(step_size, falling_inertia)

    @property
    def time(self) -> float:
        """s since the start."""
        return self.steps * self.step_size

    @property
    def event_clock(self) -> float:
        """s since the first SYNC, -1 before it."""
        return self.time - self.event_origin if self.event_origin is not None else -1.0

    def advance(self, steps: int) -> None:
        """Integrate `steps` steps."""
        for _ in range(steps):
            self.step()

    @property
    def speeds(self) -> Sequence[float]:
        """rad/s of its flywheels, positive as each has to turn; none of a machine without."""
        return ()

    def undergo(self, action: Action | None) -> None:
        """Somebody does this from now on, or lets go (None)."""
        if not isinstance(action, Spin):
            self.load.carry(action)

    def restart_disturbance(self) -> None:  # noqa: B027 - a machine without a random part has nothing to restart
        """Restart the random disturbance: what follows depends on the seed alone."""

    @abstractmethod
    def step(self) -> None:
        """Integrate one step."""

    @abstractmethod
    def application(self, node: DriveNode, number: int) -> DriveApplication:
        """The application of the drive number `number` with the role of `node`."""

    @abstractmethod
    def motion(self) -> Motion:
        """The present motion."""

    @abstractmethod
    def felt(self, motion: Motion, position: Vector3, gravity: float) -> tuple[Vector3, Vector3]:
        """Specific force (m/s^2) and angular rate (rad/s) in vehicle axes, at `position` (m), for `motion`."""
