"""Units of what the dashboard shows of a vehicle file, whose keys name only those that are not SI."""

from __future__ import annotations

AMPLITUDE = {"monocab": "rad/s", "twsbr": "V"}
"""Kind to the unit of an excitation that is not on a reference angle: what the controller puts out."""

LIMITS: dict[str, tuple[str, str]] = {
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
    "tilt_deg": ("tilt", "deg"),
    "tilt_rate_deg": ("tilt rate", "deg/s"),
    "upright_deg": ("upright", "deg"),
    "wheel_rate": ("wheel rate", "rad/s"),
    "voltage": ("voltage", "V"),
    "travel": ("travel", "m"),
    "travel_budget": ("travel budget", "m"),
}
"""Key under [limits] to its words and unit."""
