"""The time of received frames, on a clock that nobody sets: CLOCK_MONOTONIC, counted from the wall clock at the start.

The kernel stamps frames with CLOCK_REALTIME, which NTP or a person may step at any time. Time here is

    monotonic + base,   base = realtime - monotonic at the start,

and a stamp is converted by adding a shift that is 0 until realtime and monotonic part. Both are read together whenever
frames are read. Beyond `STEP` their difference is a step of the wall clock, which is corrected at once and counted.
Less is corrected slowly, and nothing below `DEADBAND`, the error of reading two clocks: stamps then stay those of the
kernel, bit for bit. Nothing here reads a clock.
"""

from __future__ import annotations

DEADBAND = 500_000
"""ns between the two clocks that are left alone."""

STEP = 2_000_000
"""ns beyond which the wall clock has been stepped."""

SLEW = 1_000
"""ns of elapsed time for one ns of correction of a smaller difference: 1000 ppm, twice what NTP slews by."""

SETTLED = 100_000_000
"""ns after a step in which frames from before it may still be waiting."""


class FrameClock:
    """Converts the stamps of all buses of a process, from `base_ns` on.

    `steps` counts the steps of the wall clock, `last_step_ns` is the last one, positive if it was set forward.
    """

    def __init__(self, base_ns: int) -> None:
        self.base_ns = base_ns
        self.steps = 0
        self.last_step_ns = 0
        self.shift_ns = 0
        """To be added to a stamp, while not `stepping`."""
        self.stepping = False
        """Whether stamps from before and after a step have to be told apart, by `convert`."""
        self._before_ns = 0
        self._read_ns = 0
        self._window_ns = 0
        self._step_at_ns = 0
        self._latest_ns = 0

    def read(self, realtime_ns: int, monotonic_ns: int) -> None:
        """Take a simultaneous reading of both clocks, made after the frames to be converted were received."""
        now_ns = monotonic_ns + self.base_ns
        elapsed_ns, self._window_ns, self._read_ns = now_ns - self._read_ns, self._read_ns, now_ns
        parted_ns = now_ns - realtime_ns - self.shift_ns
        if self.stepping and now_ns - self._step_at_ns > SETTLED:
            self.stepping = False
        if -DEADBAND <= parted_ns <= DEADBAND:
            return
        if -STEP <= parted_ns <= STEP:
            most = elapsed_ns // SLEW
            self.shift_ns += max(-most, min(most, parted_ns))
            return
        self.steps += 1
        self.last_step_ns = -parted_ns
        self._before_ns, self.shift_ns = self.shift_ns, self.shift_ns + parted_ns
        self._step_at_ns, self._latest_ns, self.stepping = now_ns, self._window_ns, True

    def convert(self, stamp_ns: int) -> int:
        """The time of a frame while `stepping`. It arrived between the last two readings, which tells whether it was
        stamped before the step or after it; where it may be either, the later time is taken, since frames are read
        soon after they arrive. So the time is exact where a frame is read sooner than the step is long. Time never
        goes back."""
        after, before = stamp_ns + self.shift_ns, stamp_ns + self._before_ns
        beyond = self._outside(before) - self._outside(after)
        found = max(before, after) if beyond == 0 else before if beyond < 0 else after
        self._latest_ns = found = max(found, self._latest_ns)
        return found

    def _outside(self, time_ns: int) -> int:
        """ns by which a time lies outside of the interval between the last two readings."""
        return max(self._window_ns - time_ns, time_ns - self._read_ns, 0)

    def status(self) -> dict[str, float | int]:
        """For `upright status`: the number of steps, and the last one in s."""
        return {"steps": self.steps, "last_step": self.last_step_ns * 1e-9}
