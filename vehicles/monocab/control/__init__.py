"""Control of a MONOCAB: linear_model, the controller designed on it (roll_design), the control law (controller), and
getting up from a support (rise)."""
