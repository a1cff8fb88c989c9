"""The two-wheeled balancing robot as a plant: the source paper's equations (Hassan et al.), mended, and what is hidden.

Tilt is positive forward, wheels and voltages where they drive forward, yaw to the left (ISO 8855). SI units.

What a master has to know. The robot starts at rest on its front bumper, at +12 deg, with open bridges: the wheels turn
freely and the IMU sees it lie. From there a balancing controller that saturates at the supply brings it up by itself,
the wheels driving under the body for 0.2 m. (The paper's PID does so from up to 28 deg; from 29 deg on the wheels run
out of speed.) Nothing lowers it but gravity: when power or control goes it lies on a bumper, front or rear, within a
second, whether the motors are open or shorted, and can be raised again from there. Nothing bounds its travel.

With `start="held"` a stand holds it upright until both motors have had power for 0.1 s, then lets go for good. While
it is held its wheels drive it along the floor, so the master must not wait between enabling and balancing.

Not in it: wheels that slip or lift off, the floor's push on the bumpers along the floor, and the armature's inductance.
"""
