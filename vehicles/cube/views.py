"""What people see of the reaction-wheel cube."""

from __future__ import annotations

from math import degrees

from upright.vehicles.views import DARK, TURN, Chart, Curve, Panel, Story, Views

CHARTS = (
    Chart("tilt", "Tilt", "deg", TURN, (Curve("tilt", "measured"),)),
    Chart("tilt_rate", "Tilt rate", "deg/s", TURN, (Curve("tilt_rate", "measured"),)),
    Chart("wheel_rate", "Wheel rate", "rad/s", 1.0, (Curve("wheel_rate", "measured"),)),
    Chart("torque", "Torque", "mN m", 1e3, (Curve("torque", "sent", "setpoint"),)),
)

STORY = Story(
    experiments=("doublet", "multisine"),
    panels=(
        Panel("tilt", "deg", degrees(1.0), (("tilt", DARK, ""),)),
        Panel("torque", "mN m", 1e3, (("torque", DARK, ""),)),
        Panel("wheel rate", "rad/s", 1.0, (("wheel_rate", DARK, ""),)),
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
    "wheel_rate_budget": ("wheel rate budget", "rad/s"),
    "torque": ("torque", "N m"),
}

VIEWS = Views(CHARTS, STORY, "N m", LIMITS)
