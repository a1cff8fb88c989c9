"""What the dashboard's live view draws for each kind of vehicle: data, so that the page knows no vehicle."""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees

TURN = degrees(1.0)


@dataclass(frozen=True, slots=True)
class Curve:
    """One curve. `look` is measured, setpoint, predicted or innovation; it chooses colour and dash."""

    channel: str
    label: str
    look: str = "measured"


@dataclass(frozen=True, slots=True)
class Chart:
    """Curves of one unit; `factor` turns SI into it."""

    id: str
    title: str
    unit: str
    factor: float
    curves: tuple[Curve, ...]


CHARTS: dict[str, tuple[Chart, ...]] = {
    "monocab": (
        Chart(
            "roll",
            "Roll",
            "deg",
            TURN,
            (
                Curve("roll", "measured"),
                Curve("roll_reference", "reference", "setpoint"),
                Curve("roll", "model, 0.5 s ahead", "predicted"),
            ),
        ),
        Chart(
            "roll_rate",
            "Roll rate",
            "deg/s",
            TURN,
            (Curve("roll_rate", "measured"), Curve("roll_rate", "model, 0.5 s ahead", "predicted")),
        ),
        Chart("precession", "Precession", "deg", TURN, (Curve("precession", "measured"),)),
        Chart(
            "precession_rate",
            "Precession rate",
            "deg/s",
            TURN,
            (Curve("precession_rate", "measured"), Curve("precession_rate_setpoint", "setpoint", "setpoint")),
        ),
        Chart("trim_position", "Trim mass", "mm", 1e3, (Curve("trim_position", "position"),)),
        Chart(
            "trim_rate",
            "Trim rate",
            "mm/s",
            1e3,
            (Curve("trim_rate", "measured"), Curve("trim_rate_setpoint", "setpoint", "setpoint")),
        ),
        Chart(
            "innovation",
            "Innovation of the roll rate",
            "deg/s",
            TURN,
            (Curve("roll_rate", "measured less predicted, one step ahead", "innovation"),),
        ),
    ),
    "twsbr": (
        Chart(
            "tilt",
            "Tilt",
            "deg",
            TURN,
            (Curve("tilt", "measured"), Curve("tilt_reference", "reference", "setpoint")),
        ),
        Chart("tilt_rate", "Tilt rate", "deg/s", TURN, (Curve("tilt_rate", "measured"),)),
        Chart(
            "wheel_rate",
            "Wheel rates",
            "rad/s",
            1.0,
            (Curve("left_wheel_rate", "left"), Curve("right_wheel_rate", "right", "setpoint")),
        ),
        Chart(
            "voltage",
            "Voltages",
            "V",
            1.0,
            (Curve("left_voltage", "left"), Curve("right_voltage", "right", "setpoint")),
        ),
    ),
}
