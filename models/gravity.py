"""The gravitational acceleration that models and controllers use. IMUs use standard gravity (9.80665 m/s^2)."""

GRAVITY = 9.81
"""m/s^2."""
