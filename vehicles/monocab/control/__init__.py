"""How a MONOCAB is held up: linear_model, the controller designed on it (roll_design), its law (controller), and how it
gets up from a support (rise)."""
