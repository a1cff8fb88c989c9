"""What is recorded of a balancing robot.

The tilt is a rotation about y: positive when the body leans forward; wheels and voltages are positive forward. A turn
to the left is (right - left wheel) radius / distance > 0.
"""

from __future__ import annotations

from upright.telemetry.channels import DRIVE_AGE, EXCITATION, PHASE, SETPOINT_AGE, Channel, ChannelTable

CHANNELS = ChannelTable(
    (
        Channel("tilt", "rad", "tilt of the body from the tilt filter, 0 upright, positive forward", leans=True),
        Channel("tilt_rate", "rad/s", "tilt rate: gyro about y minus its estimated bias"),
        Channel("tilt_std", "rad", "standard deviation of tilt as estimated by the tilt filter"),
        Channel(
            "left_wheel_angle",
            "rad",
            "angle of the left wheel relative to the body, as its encoder counts it, positive forward;"
            " on the floor it has rolled by this angle plus the tilt",
        ),
        Channel("right_wheel_angle", "rad", "angle of the right wheel relative to the body, likewise"),
        Channel("left_wheel_rate", "rad/s", "rate of the left wheel relative to the body as its drive measures it"),
        Channel("right_wheel_rate", "rad/s", "rate of the right wheel relative to the body as its drive measures it"),
        Channel(
            "left_voltage",
            "V",
            "voltage sent to the left motor's drive in this cycle, as quantised in the PDO; positive drives the wheel"
            " forward",
        ),
        Channel("right_voltage", "V", "voltage sent to the right motor's drive in this cycle, likewise"),
        SETPOINT_AGE,
        DRIVE_AGE,
        Channel(
            "tilt_reference", "rad", "reference of the tilt controller, with the excitation if it is injected there"
        ),
        EXCITATION,
        PHASE,
    )
)
