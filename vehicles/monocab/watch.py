"""What the model of a MONOCAB says about its measurements while it runs: do the axes follow their setpoints, does the
gyro change by more than anything can accelerate the vehicle, and can the vehicle still be brought back upright?

Axes. No speed loop within what is known of it explains a rate outside the band of their responses: twice the standard
deviation of its lag, twice the reaction to the rolling vehicle in either direction, setpoints that are late by up to
half of the lag, a tenth of error in its scale. The angle by which an axis has moved outside the band is added up, less
what is forgiven (a CUSUM: Page, Biometrika 41 (1954) 100).

Recovery. With the fastest precession, all that is left of the precession angle brings the unstable motion
z = roll + roll_rate / pole back from no more than

    z_max = angular_momentum rate / gravity_stiffness (1 - exp(-pole left / rate)),    pole^2 = stiffness / inertia

`recovery` is z, as it will be once the drives have answered, over z_max. Source: integration of equation (3) of the
paper.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import ceil, exp, expm1, inf, radians

from upright.drivers.cia402.drive import Drive
from upright.drivers.vehicle_io import VehicleIo
from upright.estimators.checks.imu_consistency import AVERAGED
from upright.estimators.speed_loop_steps import SpeedLoopSteps
from upright.models.gravity import GRAVITY
from upright.telemetry.samples import Vector3
from upright.vehicles.contract import Lean
from upright.vehicles.monocab.axes import GimbalMeasurement
from upright.vehicles.monocab.control.linear_model import MonocabParameters
from upright.vehicles.monocab.file import MonocabFile
from upright.vehicles.watch import DEVIATIONS, SCALE, GyroJumps

ON_THE_BUS = 2
"""Cycles from the one in which a setpoint is sent to the first in which a rate that follows it is read."""
LATE = 0.5
"""Share of its lag by which setpoints may be late: twice the small time constant, dead time included, that a speed loop
by the symmetric optimum is tuned for (lag = 4 tau)."""
FORGIVEN = 0.01
"""Share of the largest rate that an axis may be outside the band for ever: resolution and noise of the drive."""
REACTION = 8.0 / 16.0
"""Reaction of a speed loop by the symmetric optimum, over lag^2 and load per inertia: 8 tau^2 with lag = 4 tau."""
SHORTEST = 0.25
"""Share of its mean below which no lag is tried: two standard deviations may reach zero."""
NOTHING_LEFT = 1e3
"""Share that stands for a lean with no precession left."""


class Following:
    """One axis that several drives move together. `error` (rad or m) is how far the worst drive has moved outside the
    band of speed loops, 0 for an axis without drives."""

    __slots__ = ("_bands", "_drives", "_errors", "_forgiven", "_latest", "_loops", "_period", "_reaction", "error")

    def __init__(
        self, drives: Sequence[Drive], lag: float, std: float, reaction: float, rate: float, period: float
    ) -> None:
        """`lag` and its `std` (s), the likely `reaction` (s, or s^2 for a load in m/s^2), the largest `rate`."""
        self._drives = tuple(drives)
        lags = {max(lag + each * std, SHORTEST * lag) for each in (-DEVIATIONS, 0.0, DEVIATIONS)}
        self._loops = [SpeedLoopSteps(each, 0.0, 0.0, period, 0.0) for each in sorted(lags)]
        self._reaction = 2.0 * reaction / period
        self._forgiven = FORGIVEN * rate
        self._period = period
        self._latest = ON_THE_BUS + ceil(LATE * lag / period)
        self.reset()

    def reset(self) -> None:
        """Begin again with no error."""
        self._errors = [0.0] * len(self._drives)
        self._bands: deque[tuple[float, float]] = deque(maxlen=self._latest)
        self.error = 0.0

    def update(self, dt: float, load: float) -> None:
        """One cycle, `dt` s after the last. `load` is what the axis reacts to: the roll rate, or an acceleration."""
        if not self._drives:
            return
        for _ in range(max(1, round(dt / self._period))):
            self._step(load)

    def _step(self, load: float) -> None:
        setpoint = sum(drive.setpoint for drive in self._drives) / len(self._drives)
        lowest, highest = 1e9, -1e9
        for loop in self._loops:
            rate, response = loop.parts(setpoint, load)
            reaction = abs(self._reaction * response)
            lowest, highest = min(lowest, rate - reaction), max(highest, rate + reaction)
        bands = self._bands
        if len(bands) == self._latest:
            self._judge(min([low for low, _ in bands]), max([high for _, high in bands]))
        # The band of this cycle's setpoint is not in the measured rates yet.
        bands.append((lowest - SCALE * abs(lowest), highest + SCALE * abs(highest)))

    def _judge(self, lowest: float, highest: float) -> None:
        worst = 0.0
        for number, drive in enumerate(self._drives):
            rate = drive.velocity
            beyond = lowest - rate if rate < lowest else rate - highest if rate > highest else 0.0
            error = max(0.0, self._errors[number] + (beyond - self._forgiven) * self._period)
            self._errors[number] = error
            worst = max(worst, error)
        self.error = worst


class Momentum:
    """The torque balance of roll, equation (1) of the paper. `gained` (rad/s) is the roll rate that no torque explains:
    not gravity, gyroscopes and trim mass within twice the standard deviations of their parameters and a tenth of scale,
    and not a load up to the largest of the vehicle file. Two sums as for an axis, one for each direction."""

    __slots__ = ("_down", "_inertia", "_load", "_momentum", "_period", "_stiffness", "_up", "_weight", "gained")

    def __init__(self, vehicle: MonocabFile) -> None:
        values, deviations = vehicle.parameters.values, vehicle.parameters.deviations

        def known(name: str, scale: float = 0.0) -> tuple[float, float]:
            """A parameter, and how far it may be off."""
            return values[name], DEVIATIONS * deviations[name] + scale * values[name]

        self._inertia = known("inertia")
        self._stiffness = known("gravity_stiffness")
        self._momentum = known("angular_momentum", SCALE)
        self._weight = known("trim_mass", SCALE)
        self._load = vehicle.limits.load_torque
        self._period = vehicle.period
        self.reset()

    def reset(self) -> None:
        """Begin again with nothing gained."""
        self._up = self._down = self.gained = 0.0

    def update(self, dt: float, change: float, roll: float, precession_rate: float, trim_position: float) -> None:
        """One cycle of `dt` s, in which the roll rate has changed by `change` (rad/s)."""
        expected, doubt = 0.0, self._load
        for (value, error), by in (
            (self._stiffness, roll),
            (self._momentum, precession_rate),
            (self._weight, GRAVITY * trim_position),
        ):
            expected += value * by
            doubt += error * abs(by)
        inertia, error = self._inertia
        torque = inertia * change / dt
        doubt += error * abs(change) / dt
        share = dt / inertia
        self._up = max(0.0, self._up + (torque - expected - doubt) * share)
        self._down = max(0.0, self._down + (expected - torque - doubt) * share)
        self.gained = max(self._up, self._down)


class MonocabWatch:
    """`gimbal_following` (rad) and `trim_following` (m): how far the axes are from their setpoints; `jump` (rad/s): how
    much the gyro jumped; `gained` (rad/s): the roll rate that no torque explains; `recovery`: share of what can be
    brought back that is used up."""

    averaged = AVERAGED

    __slots__ = (
        "_angle",
        "_height",
        "_jumps",
        "_lag",
        "_period",
        "_pole",
        "_rate",
        "_reach",
        "_share",
        "gained",
        "gimbal_following",
        "gimbals",
        "jump",
        "momentum",
        "recovery",
        "trim",
        "trim_following",
    )

    def __init__(self, vehicle: MonocabFile, io: VehicleIo) -> None:
        parameters = MonocabParameters.from_values(vehicle.parameters.values)
        deviations, limits, period = vehicle.parameters.deviations, vehicle.limits, vehicle.period
        lag, trim_lag = parameters.speed_loop_lag, parameters.trim_lag
        gimbal = vehicle.parameters.values.get("gimbal_inertia")
        # A gimbal whose inertia nobody stated may weigh as little as lets it react by its lag.
        reaction = REACTION * lag**2 * parameters.angular_momentum / gimbal if gimbal else lag
        self.gimbals = Following(
            io.role("gimbal"), lag, deviations["speed_loop_lag"], reaction, limits.precession_rate, period
        )
        trim_std = deviations.get("trim_speed_loop_lag", deviations["speed_loop_lag"])
        self.trim = Following(io.role("trim"), trim_lag, trim_std, REACTION * trim_lag**2, limits.trim_rate, period)
        self.momentum = Momentum(vehicle)
        self._height = parameters.trim_height
        self._period = period
        self._pole = parameters.unstable_pole
        self._lag = lag + period
        self._rate = limits.precession_rate
        self._angle = radians(limits.precession_deg)
        self._reach = parameters.angular_momentum * limits.precession_rate / parameters.gravity_stiffness
        # Twice what precession at its limit and gravity on a support give, on the lightest vehicle that is likely.
        lightest = parameters.inertia - DEVIATIONS * deviations["inertia"]
        torque = parameters.angular_momentum * limits.precession_rate + parameters.gravity_stiffness * vehicle.support
        self._jumps = GyroJumps(2.0 * torque / max(lightest, 0.5 * parameters.inertia), period)
        self.reset()

    def reset(self) -> None:
        """Begin again: an experiment starts."""
        self.gimbals.reset()
        self.trim.reset()
        self.momentum.reset()
        self._jumps.reset()
        self._share = inf
        self.gimbal_following = self.trim_following = self.jump = self.gained = self.recovery = 0.0

    def update(self, dt: float, lean: Lean, drives: GimbalMeasurement) -> None:
        """One cycle, `dt` s after the last one, before its setpoints are sent."""
        change = self._jumps.update(lean.rate)
        self.jump = self._jumps.jump
        self.gimbals.update(dt, lean.rate)
        self.trim.update(dt, self._height * change / dt - GRAVITY * lean.angle)
        self.gimbal_following, self.trim_following = self.gimbals.error, self.trim.error
        self.momentum.update(dt, change, lean.angle, drives.precession_rate, drives.trim_position)
        self.gained = self.momentum.gained
        self._watch_recovery(lean, drives.precession)

    def unexplained(self, contradiction: Vector3) -> Vector3:
        """All of it: the rail does not move."""
        return contradiction

    def _watch_recovery(self, lean: Lean, precession: float) -> None:
        """The smaller of two cycles, so that a single wrong sample of the gyro is forgiven."""
        falling = lean.angle + lean.rate / self._pole
        left = self._angle + precession if falling > 0.0 else self._angle - precession
        most = self._reach * -expm1(-self._pole * max(left, 0.0) / self._rate)
        used = abs(falling) * exp(self._pole * self._lag)
        share, before = used / most if most > 0.0 else NOTHING_LEFT, self._share
        self._share = share
        self.recovery = min(share, before)
