"""From control cycles to rows of the MONOCAB's torque balance, with all signals filtered by one state-variable filter.

    angular_momentum * precession' + trim torque = inertia * roll'' - gravity_stiffness * roll - static_torque
    trim torque = trim_mass * g * trim_position - trim_mass * trim_height * trim_position''

A row holds the filtered left side and the filtered regressors of the right side. roll'' is the filtered derivative of
the roll rate; the constant is the filter's step response.

Alignment. The drives are sampled before the IMU, or after it if the IMU is late; `drive_age` states by how much, and
the drive signals are shifted to the IMU's instant. The user of a row fits the remaining misalignment, a fraction of a
sample, as a nuisance parameter: shifting the drive signals by `drive_time_offset` adds
angular_momentum * precession'' * offset, linear in it. The offset absorbs everything else that is proportional to
precession'', so it is neither a property of the vehicle nor a measurement of its drives.

Validity. Only a free vehicle obeys the balance: |roll| must be less than the support angle by a margin. The filter
restarts whenever the vehicle becomes free and after every gap, and is exact from that moment on. Rows without
instruments use only what was on the bus (BALANCE_CHANNELS); excitation and setpoint are used for the instruments only.

Signs as in telemetry.channels, SI units. Source: Griese et al., section III-B, equation (6), with the sign of the
gravity term corrected and the static torque added.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np

from upright.estimators.contract import EstimationError
from upright.estimators.data.instrument_bank import InstrumentBank
from upright.estimators.data.state_variable_filter import StateVariableFilter
from upright.models.gravity import GRAVITY
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Frame
from upright.vehicles.monocab.channels import CHANNELS as MONOCAB

REGRESSORS = ("inertia", "gravity_stiffness", "static_torque.torque", "drive_time_offset")
"""The parameters of a row, in the order of its regressors."""

BALANCE_CHANNELS = ChannelTable(
    MONOCAB[MONOCAB.index_of(name)]
    for name in (
        "roll",
        "roll_rate",
        "precession_rate",
        "trim_position",
        "trim_rate",
        "drive_age",
    )
)
"""The channels that a row is computed from."""

INSTRUMENT_CHANNELS = ChannelTable(
    MONOCAB[MONOCAB.index_of(name)] for name in (*BALANCE_CHANNELS.names, "excitation", "precession_rate_setpoint")
)
"""The channels that a row with instruments is computed from."""


@dataclass(frozen=True, slots=True)
class FilterConfig:
    """How the balance's signals are filtered.

    `bandwidth` rad/s and `order` of the state-variable filter: above the frequencies of the excitation, below those at
    which differentiated gyro noise dominates. `support_margin` rad: free is |roll| < support - margin.
    """

    bandwidth: float = 2.0 * np.pi * 5.0
    order: int = 4
    support_margin: float = float(np.radians(0.3))

    @property
    def stride(self) -> float:
        """s between rows: ten per period of the bandwidth; more would add no information."""
        return 0.2 * np.pi / self.bandwidth

    @property
    def longest_gap(self) -> float:
        """s over which the signal may be interpolated linearly between two samples."""
        return 1.0 / self.bandwidth


@dataclass(frozen=True, slots=True)
class BalanceRow:
    """One row: `output` (N m) = `regressors` (4,) . parameters, see REGRESSORS; `begins` if it follows no other row.

    `instruments` are filtered signals of the injected excitation, and the constant: (INSTRUMENTS,), or ().
    """

    timestamp_ns: int
    output: float
    regressors: tuple[float, ...]
    instruments: tuple[float, ...]
    begins: bool


class BalanceRows:
    """Takes control cycles, gives a row every `stride` seconds of free motion.

    `parameters` needs angular_momentum, trim_mass, trim_height; `support` is the roll angle, rad, at which the supports
    carry. With `instruments` a cycle of unknown excitation is an unknown cycle.
    Raises EstimationError if a parameter is missing or the support angle leaves no free range.
    """

    INSTRUMENTS = InstrumentBank.COUNT + 1

    def __init__(
        self,
        parameters: Mapping[str, float],
        support: float,
        channels: ChannelTable,
        config: FilterConfig | None = None,
        *,
        instruments: bool = False,
    ) -> None:
        self.config = config = config or FilterConfig()
        for name in ("angular_momentum", "trim_mass", "trim_height"):
            if name not in parameters:
                raise EstimationError(
                    f"parameter {name}", "missing", remedy="set it in [parameters] of the vehicle file."
                )
        if not support > config.support_margin:
            raise EstimationError(
                "support angle", f"{np.degrees(support):g} deg leaves no free range", remedy="set limits.support_deg."
            )
        self._momentum = float(parameters["angular_momentum"])
        self._trim_weight = GRAVITY * float(parameters["trim_mass"])
        self._trim_reaction = float(parameters["trim_mass"]) * float(parameters["trim_height"])
        self._free_angle = support - config.support_margin
        names = INSTRUMENT_CHANNELS.names if instruments else BALANCE_CHANNELS.names
        self._places = tuple(channels.index_of(name) for name in names)
        self._imu = StateVariableFilter(2, config.bandwidth, config.order)
        self._drive = StateVariableFilter(3, config.bandwidth, config.order)
        self._bank = InstrumentBank() if instruments else None
        self._recent: deque[tuple[int, float, float]] = deque(maxlen=8)
        self._coming: deque[tuple[int, tuple[float, ...]]] = deque()
        self.reset()

    def reset(self) -> None:
        """Back to before the first cycle."""
        self._reset_bank()
        self._recent.clear()
        self._coming.clear()
        self._running = self._begins = False
        self._imu_time = self._drive_time = 0
        self._next = 0.0
        self.cycles = 0
        """Cycles seen so far."""
        self.unknown_excitation = 0
        """Of these, how many lacked the excitation that instruments need."""
        self.free_time = 0.0
        """s of free motion so far."""

    def update(self, frame: Frame) -> BalanceRow | None:
        """The row that this cycle completes, if any. Cycles on the support, out of order or unknown are ignored."""
        values = frame.values
        roll, rate, speed, trim, trim_rate, age, *injected = [values[place] for place in self._places]
        now = frame.timestamp_ns
        recent = self._recent
        spacing = (now - recent[-1][0]) * 1e-9 if recent else 0.0
        if recent and spacing <= 0.0:
            return None
        self.cycles += 1
        known = roll + rate + speed + trim + trim_rate + age + sum(injected)
        if injected and not isfinite(injected[0]):
            self.unknown_excitation += 1
        longest = self.config.longest_gap
        if known - known != 0.0 or spacing > longest or not -longest <= age <= longest:
            self._running = False
            recent.clear()
            self._coming.clear()
            self._reset_bank()
            if known - known != 0.0:  # NaN or infinite
                return None
            spacing = 0.0
        if self._bank:
            self._bank.update(spacing, *injected)
        recent.append((now, roll, rate))
        coming = self._coming
        if abs(roll) >= self._free_angle:
            self._running = False
            coming.clear()
            return None
        coming.append((now - round(age * 1e9), (speed, trim, trim_rate)))
        if not self._running:
            if coming[0][0] <= now:
                self._begin(*coming.popleft())
            return None
        self._imu.update((now - self._imu_time) * 1e-9, (roll, rate))
        self._imu_time = now
        while coming and coming[0][0] <= now:
            drive_time, drive = coming.popleft()
            if drive_time > self._drive_time:
                self._drive.update((drive_time - self._drive_time) * 1e-9, drive)
                self._drive_time = drive_time
        self.free_time += spacing
        self._next -= spacing
        if self._next > 0.0:
            return None
        self._next += self.config.stride
        return self._row(now)

    def _reset_bank(self) -> None:
        if self._bank:
            self._bank.reset()

    def _begin(self, drive_time: int, drive: Sequence[float]) -> None:
        """Start both filters at one instant, that of the drive values; roll and roll rate are interpolated there."""
        samples = list(self._recent)
        later = next((place for place, sample in enumerate(samples) if sample[0] >= drive_time), 0)
        if later == 0 or drive_time < samples[later - 1][0]:
            return  # the drive values are older than all available IMU samples
        (early, *before), (late, *after) = samples[later - 1], samples[later]
        share = (drive_time - early) / (late - early)
        self._imu.start([a + share * (b - a) for a, b in zip(before, after, strict=True)])
        self._imu_time = drive_time
        for time, *sample in samples[later:]:
            self._imu.update((time - self._imu_time) * 1e-9, sample)
            self._imu_time = time
        self._drive.start(drive)
        self._drive_time = drive_time
        self._next = self.config.stride
        self._running = self._begins = True

    def _row(self, now: int) -> BalanceRow:
        imu = self._imu.outputs()
        drive = self._drive.outputs((now - self._drive_time) * 1e-9)
        begins, self._begins = self._begins, False
        momentum = self._momentum
        return BalanceRow(
            timestamp_ns=now,
            output=float(momentum * drive[0, 0] + self._trim_weight * drive[0, 1] - self._trim_reaction * drive[1, 2]),
            regressors=(imu[1, 1], -imu[0, 0], -imu[0, 2], -momentum * drive[1, 0]),
            instruments=(imu[0, 2], *self._bank.outputs) if self._bank else (),
            begins=begins,
        )
