"""The two-wheeled balancing robot: its vehicle file, controller, and way of getting up and down."""
