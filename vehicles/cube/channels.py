"""What is recorded of a reaction-wheel cube.

The tilt is a rotation about the edge, y: positive when the cube leans forward. The wheel's angle and rate are relative
to the body, with the same sign; a positive torque turns the wheel forward, and so the body backward.
"""

from __future__ import annotations

from upright.telemetry.channels import DRIVE_AGE, EXCITATION, PHASE, SETPOINT_AGE, Channel, ChannelTable

CHANNELS = ChannelTable(
    (
        Channel("tilt", "rad", "tilt of the body from the tilt filter, 0 upright, positive forward", leans=True),
        Channel("tilt_rate", "rad/s", "tilt rate: gyro about y minus its estimated bias"),
        Channel("tilt_std", "rad", "standard deviation of tilt as estimated by the tilt filter"),
        Channel(
            "wheel_angle", "rad", "angle of the wheel relative to the body, as its encoder counts it, positive forward"
        ),
        Channel("wheel_rate", "rad/s", "rate of the wheel relative to the body as its drive measures it"),
        Channel("torque", "N m", "torque sent to the wheel's drive in this cycle, as quantised in the PDO"),
        SETPOINT_AGE,
        DRIVE_AGE,
        EXCITATION,
        PHASE,
    )
)
