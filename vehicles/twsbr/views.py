"""What people see of the balancing robot."""

from __future__ import annotations

from math import degrees

from upright.vehicles.views import DARK, LIGHT, TURN, Chart, Curve, Panel, Story, Views

CHARTS = (
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
)

STORY = Story(
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
)

LIMITS = {
    "support_deg": ("support", "deg"),
    "missed_cycles": ("missed cycles", "in a row"),
    "tilt_deg": ("tilt", "deg"),
    "tilt_rate_deg": ("tilt rate", "deg/s"),
    "upright_deg": ("upright", "deg"),
    "wheel_rate": ("wheel rate", "rad/s"),
    "voltage": ("voltage", "V"),
    "travel": ("travel", "m"),
    "travel_budget": ("travel budget", "m"),
    "heading_deg": ("heading", "deg"),
}

VIEWS = Views(CHARTS, STORY, "V", LIMITS)
