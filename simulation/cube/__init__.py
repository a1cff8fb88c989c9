"""A cube that balances on one of its edges by a reaction wheel, as a plant: truth is what it is made of, plant how it
moves with its wheel, effects and hidden what may be hidden in it.

The tilt is a turn about the edge, y, positive forward; the wheel's angle and rate are against the body, positive the
same way. A torque that turns the wheel forward turns the body backward. SI units.

What a master has to know. The cube starts at rest on its front support, 8 deg ahead of upright, with its wheel at rest
and free. A balancing controller within the current limit brings it up from there in 0.2 s. When the power goes it falls
on a support, front or rear, within half a second, and its wheel runs down; it can be raised again from there.
"""
