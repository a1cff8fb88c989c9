"""Physics of the vehicles: grey-box equations and the control design based on them. Pure: no I/O, no clock."""
