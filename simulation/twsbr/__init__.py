"""The plant of the two-wheeled balancing robot: the source paper's equations (Hassan et al.), corrected, and its hidden
effects.

Tilt is positive forward, wheels and voltages when they drive forward, yaw to the left (ISO 8855). SI units.

What a master has to know: the robot starts at rest on its front bumper, at +12 deg, with open bridges; the wheels turn
freely and the IMU shows it lying. A balancing controller that saturates at the supply brings it up from there, the
wheels driving under the body for 0.2 m. (The paper's PID does so from up to 28 deg; from 29 deg on the wheels run
out of speed.) Only gravity lowers it: when power or control is lost, it lies on a bumper, front or rear, within a
second, whether the motors are open or shorted, and can be raised again from there. Nothing bounds its travel.

With `start="held"` a stand holds it upright until both motors have had power for 0.1 s, then releases it for good.
While it is held its wheels drive it along the floor, so the master must not wait between enabling and balancing.

Not modelled: wheels that slip or lift off, the floor's force on the bumpers along the floor, and the armature's
inductance.
"""
