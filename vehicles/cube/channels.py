"""What is recorded of a reaction-wheel cube.

The tilt is a turn about the edge, y: positive when the cube leans forward. The wheel's angle and rate are against the
body, positive the same way; a positive torque turns the wheel forward, and so the body backward.
"""

from __future__ import annotations

from telemetry.channels import DRIVE_AGE, EXCITATION, PHASE, SETPOINT_AGE, Channel, ChannelTable

CHANNELS = ChannelTable(
    (
        Channel("tilt", "rad", "tilt of the body from the tilt filter, 0 upright, positive forward", leans=True),
        Channel("tilt_rate", "rad/s", "tilt rate: gyro about y less its estimated bias"),
        Channel("tilt_std", "rad", "standard deviation of tilt as the tilt filter sees it"),
        Channel(
            "wheel_angle", "rad", "angle of the wheel against the body, as its encoder counts it, positive forward"
        ),
        Channel("wheel_rate", "rad/s", "rate of the wheel against the body as its drive measures it"),
        Channel("torque", "N m", "torque sent to the wheel's drive in this cycle, as quantised in the PDO"),
        SETPOINT_AGE,
        DRIVE_AGE,
        EXCITATION,
        PHASE,
    )
)
