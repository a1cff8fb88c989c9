"""Estimators: from control cycles to roll angle and parameters, one frame at a time; no I/O, no clock."""
