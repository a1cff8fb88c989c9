"""Identification methods for a MONOCAB only: balance_rows and torque_balance are its recursive regressions,
roll_prediction measures a fit, apparent_inertia follows from inertia and speed loops; own collects all of them."""
