"""What the demo does with each kind of vehicle, and what its picture shows of a run."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees

LIGHT, DARK = "#9ecae1", "#08519c"


@dataclass(frozen=True, slots=True)
class Panel:
    """Lines over time in one `unit`: `lines` are channel, colour and legend ("" for none), each times `scale`."""

    title: str
    unit: str
    scale: float
    lines: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True, slots=True)
class Story:
    """The demo of one kind of vehicle.

    `experiments` are run where none are named; the last one is diagnosed. `begin`, s: what is before it, while the
    vehicle gets up and its filter settles, tells nothing of the vehicle. `settling`: parameters and units that are
    estimated while it runs; where none are, the last recording is identified afterwards.
    """

    experiments: tuple[str, ...]
    panels: tuple[Panel, ...]
    settling: tuple[tuple[str, str], ...] = ()
    begin: float = 0.0


STORIES: dict[str, Story] = {
    "monocab": Story(
        experiments=("step", "sweep"),
        panels=(
            Panel("roll", "deg", degrees(1.0), (("roll_reference", LIGHT, "reference"), ("roll", DARK, "roll"))),
            Panel("precession", "deg", degrees(1.0), (("precession", DARK, ""),)),
        ),
        settling=(("inertia", "kg m²"), ("gravity_stiffness", "N m/rad")),
    ),
    "twsbr": Story(
        experiments=("doublet", "square"),
        panels=(
            Panel("tilt", "deg", degrees(1.0), (("tilt_reference", LIGHT, "reference"), ("tilt", DARK, "tilt"))),
            Panel("motor voltage", "V", 1.0, (("left_voltage", DARK, ""),)),
            Panel(
                "wheel angle",
                "rad",
                1.0,
                (("left_wheel_angle", DARK, "left"), ("right_wheel_angle", LIGHT, "right")),
            ),
        ),
        begin=8.0,
    ),
}
"""By the vehicle file's kind."""
