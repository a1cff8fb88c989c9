"""Physics of the vehicles: grey-box equations and the control design that rests on them. Pure: no I/O, no clock."""
