"""Gravity, as models and controllers reckon with it. IMUs have their own standard of it (9.80665 m/s^2)."""

GRAVITY = 9.81
"""m/s^2."""
