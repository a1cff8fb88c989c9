"""What is recorded of a MONOCAB.

Roll is positive when the right side goes down (a right-handed rotation about x); precession is positive when its rate
gives a positive roll torque, so the torque balance reads

    inertia * roll'' = gravity_stiffness * roll + angular_momentum * precession' + disturbances
"""

from __future__ import annotations

from upright.telemetry.channels import DRIVE_AGE, EXCITATION, PHASE, SETPOINT_AGE, Channel, ChannelTable

TRIM = "trim mass"

CHANNELS = ChannelTable(
    (
        Channel(
            "roll",
            "rad",
            "roll angle of the cabin from the roll filter, 0 upright, positive right side down",
            leans=True,
        ),
        Channel("roll_rate", "rad/s", "roll rate: gyro about x minus its estimated bias"),
        Channel("roll_std", "rad", "standard deviation of roll as estimated by the roll filter"),
        Channel(
            "gyro_bias_std",
            "rad/s",
            "standard deviation of the gyro's bias about x as estimated by the roll filter",
            newer=True,
        ),
        Channel("pitch", "rad", "pitch angle from the roll filter, positive nose down", leans=True),
        Channel("precession", "rad", "mean angle of the gimbals, 0 in the middle"),
        Channel("precession_rate", "rad/s", "mean rate of the gimbals as the drives measure it"),
        Channel(
            "precession_rate_setpoint", "rad/s", "rate sent to the gimbal drives in this cycle, as quantised in the PDO"
        ),
        Channel(
            "trim_position",
            "m",
            "trim mass, 0 in the middle, positive to the right, where its weight gives a positive roll torque",
            part=TRIM,
        ),
        Channel("trim_rate", "m/s", "trim mass rate as the drive measures it", part=TRIM),
        Channel(
            "trim_rate_setpoint",
            "m/s",
            "rate sent to the trim drive in this cycle, as quantised in the PDO",
            part=TRIM,
        ),
        Channel(
            "angular_momentum",
            "N m s",
            "of the flywheels together, from their measured speeds; not known while one of them is silent",
            newer=True,
            only_with="flywheel",
        ),
        SETPOINT_AGE,
        DRIVE_AGE,
        Channel(
            "roll_reference", "rad", "reference of the roll controller, with the excitation if it is injected there"
        ),
        EXCITATION,
        PHASE,
    )
)
