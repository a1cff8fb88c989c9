"""Model files for tests: one with equations of its own, one that changes a shipped model, and an effect."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

OWN = """
title = "Pendulum on a motor"    # my own

[definitions]
pull = "mass * 9.81 * arm"
torque = "motor_constant * voltage"

[parameters]
mass = { unit = "kg", value = 2.0, std = 0.1, lower = 0.0, meaning = "of the bob" }
arm = { unit = "m", value = 0.5, estimated = false }
motor_constant = { unit = "N m/V", value = 0.3, std = 0.05 }
late = { unit = "s", value = 0.001, lower = 0.0, upper = 0.05 }

[states]
angle = { unit = "rad", derivative = "rate", initial = "angle", initial_std = 1e-3 }
rate = { unit = "rad/s", derivative = "pivot_force / (mass * arm ** 2)", process_noise = 1e-3 }

[inputs.voltage]
unit = "V"
hold = "zero_order"
delays = ["late"]

[outputs.angle]
unit = "rad"
expression = "angle"
noise = 1e-4

[joints.pivot]
coordinate = "angle"
rate = "rate"
inertia = "mass * arm ** 2"
load = '''
    torque
    - pull * sin(angle)'''
force_unit = "N m"
coordinate_unit = "rad"
force_scale = 5.0
coordinate_scale = 0.5
rate_scale = 1
smooth_rate = 1e-3

[actuators.motor]
command = "voltage"
joint = "pivot"
gain = "motor_constant"
rate_unit = "V"

[sensors.encoder]
angle = "angle"
"""

BASED = """\
# The vehicle in the hall.
name = "hall"
base = "monocab_roll"

[parameters]
inertia = { value = 1500, std = 50.0 }   # weighed

# since the bearings were changed
[[effects]]
name = "coulomb_friction"
at = "roll"
[effects.parameters]
torque = { value = 12.5, std = 1.5 }     # N m

# an unbalanced load
[[effects]]
name = "static_torque"

# what was done
[[history]]
action = "add"
effect = "coulomb_friction"
recording = "sweep.arrow"
date = 2026-01-02
error_before = 3.2
error_after = { roll = 1.1 }
who = "me"
"""

BUMP = """
name = "rail_bump"
family = "stiffness"
title = "a dent in the rail head"
place = "joint"
force = "-torque * exp(-(coordinate / width) ** 2)"
confused_with = ["position_cogging"]

[[parameters]]
name = "torque"
unit = "{force}"
meaning = "at the dent"
amplitude = true
scale = "force_scale"

[[parameters]]
name = "width"
unit = "{coordinate}"
meaning = "of the dent"
value = 0.002
scale = "coordinate_scale / 20"
"""

NOW = datetime(2026, 5, 6, 7, 8, 9, tzinfo=UTC)


def write_based(folder: Path) -> Path:
    """BASED as a file."""
    path = folder / "mine.toml"
    path.write_text(BASED)
    return path
