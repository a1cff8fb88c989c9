"""What runs on a virtual drive behind its object dictionary: power states, process data, reaction to faults.

The mode of operation, and what it does to an axis, is up to the application: `servo_drive`, `torque_drive`,
`voltage_drive`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

from upright.simulation.bus.objects import CONTROLWORD, ERROR_CODE, ERROR_REGISTER, MODE, STATUSWORD
from upright.simulation.bus.power_state import PowerState, PowerStateMachine
from upright.simulation.config import DriveNode

HALT = 0x100


@dataclass(slots=True)
class DriveParameters:
    """Parameters that a master can set by SDO: option codes and ramps (rpm/s), with their defaults."""

    quick_stop_option: int = 2
    shutdown_option: int = 0
    disable_option: int = 1
    fault_reaction: int = 2
    acceleration: float = 30_000.0
    deceleration: float = 30_000.0
    quick_stop: float = 30_000.0
    maximum_rpm: float = 3000.0


class DriveApplication(ABC):
    """`image` holds the process data, keyed as in `objects`; `write` takes a value from the bus."""

    modes: ClassVar[tuple[int, ...]]
    """Modes of operation (6060h) that the drive has."""

    def __init__(self, config: DriveNode, commands: Iterable[int]) -> None:
        """`commands`: keys of the objects beyond controlword and mode that the master writes."""
        self.parameters = DriveParameters()
        self.power = PowerStateMachine()
        self.remote = False
        """The NMT state lets the master control the drive (statusword bit 9)."""
        self.synchronous = False
        """SYNCs arrive (statusword bit 8 in mode 9)."""
        self.supplied = True
        """The power stage has its supply (statusword bit 4)."""
        self.warning = False
        """The drive warns, and goes on (statusword bit 7)."""
        self.image: dict[int, int] = {}
        self.shown_mode = 0
        """The mode of operation that it displays."""
        self._mode_due = 0.0
        self._config = config
        self._keys = (CONTROLWORD, STATUSWORD, *commands, MODE, ERROR_CODE, ERROR_REGISTER)
        self.reset()

    def reset(self) -> None:
        """Process data of a drive that has just been switched on."""
        self.parameters = DriveParameters()
        self.image.clear()
        self.image.update(dict.fromkeys(self._keys, 0))
        self.shown_mode = 0

    @property
    def state(self) -> PowerState:
        return self.power.state

    def restart(self, now: float) -> None:
        """Power-on."""
        self.reset()
        self.power.restart(now)
        self._release()

    def write(self, key: int, value: int, now: float) -> bool:
        """Write a value to the image; returns whether it has reset a fault."""
        if key == MODE and value != self.image[MODE]:
            self._mode_due = now + self._config.habits.mode_time
        self.image[key] = value
        if key != CONTROLWORD:
            return False
        reset = self.power.write(value, now)
        if reset:
            self.image[ERROR_CODE] = self.image[ERROR_REGISTER] = 0
        return reset

    def fail(self, code: int, register: int, now: float, *, under_power: bool) -> None:
        """Go to Fault with this error code and error register."""
        self.image[ERROR_CODE] = code
        self.image[ERROR_REGISTER] = register | 0x01
        self.power.fail(now, under_power=under_power and self.parameters.fault_reaction > 0)
        self.update(now)

    def update(self, now: float) -> None:
        """Advance the state machine and let the axis follow it."""
        if now >= self._mode_due:
            self.shown_mode = self.image[MODE]
        power = self.power
        power.stay_in_stop = self.parameters.quick_stop_option >= 5
        power.ramp_before_disable = self.parameters.disable_option == 1
        power.ramp_before_shutdown = self.parameters.shutdown_option == 1
        power.update(now, standstill=self._standstill())
        coasts = power.state is PowerState.QUICK_STOP_ACTIVE and self.parameters.quick_stop_option == 0
        if power.stopping and not coasts:
            self._brake()
        elif power.state is PowerState.OPERATION_ENABLED:
            self._drive()
        else:
            self._unpower(now)

    @abstractmethod
    def sample(self) -> None:
        """Bring the actual values in the image up to date."""

    @abstractmethod
    def _release(self) -> None:
        """Power-on: bring the axis into its initial state."""

    @abstractmethod
    def _standstill(self) -> bool: ...

    @abstractmethod
    def _brake(self) -> None:
        """Bring the axis to a standstill under power."""

    @abstractmethod
    def _drive(self) -> None:
        """Operation enabled: follow mode and target."""

    @abstractmethod
    def _unpower(self, now: float) -> None:
        """Remove the power from the axis if it is on."""

    def _statusword(self) -> int:
        """The bits of the statusword that do not depend on the mode of operation."""
        state = self.power.state
        word = int(state)
        if self.supplied and state is not PowerState.NOT_READY_TO_SWITCH_ON:
            word |= 0x10
        if self.warning:
            word |= 0x80
        if self.remote:
            word |= 0x200
        return word


def wrapped(value: int) -> int:
    """`value` as a 32-bit counter shows it."""
    return (value + 0x8000_0000) % 0x1_0000_0000 - 0x8000_0000


def permille(value: float) -> int:
    """`value` in per mille, limited to the range of 6077h."""
    return max(-32768, min(32767, round(value)))
