"""Faults of the vehicle itself: flywheels that run down, torques that it cannot hold, a support that is not there."""

from __future__ import annotations

from collections.abc import Callable
from math import exp, radians

from faults import clues
from faults.bench import Bench
from faults.fault import DETECTED, MEASURED_FLYWHEELS, MONOCAB, UP, Fault, Wanted, When, harmless, in_order, stopped
from upright.simulation.physics.contact import Supports
from upright.simulation.physics.load import Load
from upright.vehicles.monocab.flywheels import SILENT

STEP = 0.004
"""s in which a torque steps on."""
PUSH, PUSHED = 0.1, 0.45
"""s of a push, and the rate that it gives, as the share of the way to the support in a second."""
BEAM = 2.5
"""deg at which the obstacle is."""
FELL = (Wanted.FALLEN, Wanted.RECOVERY, "precession")


def run_down(time_constant: float) -> Callable[[Bench], None]:
    """The flywheels lose their speed with this time constant, s."""

    def inject(bench: Bench) -> None:
        begin, flywheels = bench.truth.time, bench.truth.flywheels
        before = [flywheel.speed for flywheel in flywheels]

        def slow() -> None:
            share = exp(-(bench.truth.time - begin) / time_constant)
            for flywheel, speed in zip(flywheels, before, strict=True):
                flywheel.on, flywheel.speed = False, share * speed

        bench.each_cycle.append(slow)

    return inject


def unplug_flywheel(bench: Bench) -> None:
    """One flywheel no longer reports its speed, which it keeps."""
    bench.plant_side.speed_reports.silent[0] = True


def torque(size: float, seconds: float | None = None) -> Callable[[Bench], None]:
    """A static torque (N m) about the axis of the fall steps on, for `seconds` or for ever."""

    def inject(bench: Bench) -> None:
        bench.truth.load.carry(Load(size, STEP))
        if seconds is not None:
            bench.plant_side.later(seconds, lambda: bench.truth.load.carry(None))

    return inject


def shove(bench: Bench) -> None:
    """A push for a tenth of a second, after which the vehicle falls over within a few seconds if nobody holds it."""
    inertia = bench.plant_side.config.plant.falling_inertia
    torque(inertia * PUSHED * bench.support / PUSH, PUSH)(bench)


def beam(bench: Bench) -> None:
    """Something lies under the vehicle: it comes to rest at 2.5 deg, and not on its support."""
    truth = bench.plant_side.config.plant
    bench.truth.supports = Supports(radians(BEAM), truth.support_stiffness, truth.support_damping)  # type: ignore[attr-defined]


GOES_ON = tuple(when for when in UP if when is not When.LOWER)
"""Parts of a run that can still be ended in order."""
OVER_ITS_LIMIT = "the vehicle can hold 550 N m; known once the gimbals are used up, or it lies on its support"
FAULTS: tuple[Fault, ...] = (
    *(
        in_order(
            f"{measured}flywheels_run_down_{seconds:g}s",
            f"the flywheels{', whose speed is measured,' if measured else ''} run down with a time constant of"
            f" {seconds:g} s",
            run_down(seconds),
            Wanted.FLYWHEELS if measured else Wanted.TORQUE_BALANCE,
            says=("flywheel", "momentum"),
            since=clues.flywheels_weak,
            why="known once a tenth of the angular momentum is missing; then there is still enough to lower it",
            kinds=(MEASURED_FLYWHEELS,) if measured else MONOCAB,
            when=GOES_ON,
        )
        for measured in ("", "measured_")
        for seconds in (10.0, 2.0)
    ),
    in_order(
        "flywheel_unplugged",
        "a flywheel no longer reports its speed",
        unplug_flywheel,
        Wanted.FLYWHEELS,
        within=SILENT + DETECTED,
        why="a flywheel without its motor loses a hundredth of its speed in a second: so long its last report is good",
        kinds=(MEASURED_FLYWHEELS,),
        when=GOES_ON,
    ),
    *(
        harmless(
            f"torque_{size}",
            f"a static torque of {size} N m steps on",
            torque(size),
            kinds=MONOCAB,
            when=(When.SETTLE, When.EXCITE, When.LOWER),
            or_in_order=True,
            pushes=True,
            why="the vehicle is built for a person of 550 N m who sits down on the frame",
        )
        for size in (300, 550)
    ),
    *(
        in_order(
            f"torque_{size}",
            f"a static torque of {size} N m steps on",
            torque(size),
            Wanted.RECOVERY,
            "precession_budget",
            since=clues.budget_used_up,
            why=OVER_ITS_LIMIT,
            kinds=MONOCAB,
            when=(When.SETTLE, When.EXCITE),
            pushes=True,
            says=("precession", "recover", "no torque explains"),
        )
        for size in (1000, 1500)
    ),
    stopped(
        "torque_3000",
        "a static torque of 3000 N m steps on",
        torque(3000),
        *FELL,
        since=clues.budget_used_up,
        why=OVER_ITS_LIMIT,
        kinds=MONOCAB,
        when=(When.SETTLE, When.EXCITE),
        pushes=True,
        or_in_order=True,
    ),
    stopped(
        "held_down",
        "the vehicle is pushed onto its support with 3000 N m and held there for 8 s",
        torque(3000, 8.0),
        *FELL,
        since=clues.budget_used_up,
        why=OVER_ITS_LIMIT + ", which it must not while it is to be upright",
        kinds=MONOCAB,
        when=(When.SETTLE, When.EXCITE),
        pushes=True,
        or_in_order=True,
    ),
    harmless(
        "shove",
        "somebody pushes the vehicle for a tenth of a second",
        shove,
        when=(When.SETTLE, When.EXCITE),
        pushes=True,
    ),
    in_order(
        "support_not_reached",
        "something lies under the vehicle, which comes to rest at 2.5 deg when it is lowered",
        beam,
        since=clues.lies_still,
        within=12.0,
        says=("lower", "support"),
        why="lowering has 12 s: it may take its time as long as nothing moves",
        kinds=("monocab", "cube"),
        when=(When.EXCITE,),
    ),
)
