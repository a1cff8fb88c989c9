"""Control of a MONOCAB: linear_model, the controller designed on it (roll_design), the control law (controller), the
one with the trim mass (full), the speed loops that both compute (speed_loop), and getting up from a support (rise)."""
