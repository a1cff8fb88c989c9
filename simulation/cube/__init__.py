"""The plant of a cube that balances on one of its edges by a reaction wheel: truth has its parameters, plant the motion
of cube and wheel, effects and hidden the effects that may be hidden in it.

The tilt is a rotation about the edge, y, positive forward; the wheel's angle and rate are relative to the body, with
the same sign. A torque that turns the wheel forward turns the body backward. SI units.

What a master has to know: the cube starts at rest on its front support, 8 deg ahead of upright, with its wheel at rest
and free. A balancing controller within the current limit brings it up from there in 0.2 s. When power is lost, it falls
on a support, front or rear, within half a second, and its wheel runs down; it can be raised again from there.
"""
