"""What people see of the MONOCAB."""

from __future__ import annotations

from math import degrees

from upright.vehicles.views import DARK, LIGHT, TURN, Chart, Curve, Panel, Story, Views

CHARTS = (
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
        "angular_momentum",
        "Angular momentum",
        "N m s",
        1.0,
        (Curve("angular_momentum", "measured"),),
    ),
    Chart(
        "innovation",
        "Innovation of the roll rate",
        "deg/s",
        TURN,
        (Curve("roll_rate", "measured minus predicted, one step ahead", "innovation"),),
    ),
)

STORY = Story(
    experiments=("step", "sweep"),
    panels=(
        Panel("roll", "deg", degrees(1.0), (("roll_reference", LIGHT, "reference"), ("roll", DARK, "roll"))),
        Panel("precession", "deg", degrees(1.0), (("precession", DARK, ""),)),
    ),
    settling=(("inertia", "kg m²"), ("gravity_stiffness", "N m/rad")),
)

LIMITS = {
    "support_deg": ("support", "deg"),
    "missed_cycles": ("missed cycles", "in a row"),
    "roll_deg": ("roll", "deg"),
    "roll_rate_deg": ("roll rate", "deg/s"),
    "precession_deg": ("precession", "deg"),
    "precession_budget_deg": ("precession budget", "deg"),
    "precession_rate": ("precession rate", "rad/s"),
    "precession_acceleration": ("precession acceleration", "rad/s²"),
    "gimbal_mismatch_deg": ("gimbal mismatch", "deg"),
    "trim_position": ("trim position", "m"),
    "trim_rate": ("trim rate", "m/s"),
    "trim_acceleration": ("trim acceleration", "m/s²"),
    "load_torque": ("load", "N m"),
    "gimbal_following_deg": ("gimbals off their setpoint", "deg"),
    "trim_following": ("trim mass off its setpoint", "m"),
}

VIEWS = Views(CHARTS, STORY, "rad/s", LIMITS)
