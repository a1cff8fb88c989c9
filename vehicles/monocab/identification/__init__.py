"""What an identification has for a MONOCAB alone: balance_rows and torque_balance are its recursive regressions,
roll_prediction measures a fit, apparent_inertia follows from inertia and speed loops; own hands all of them over."""
