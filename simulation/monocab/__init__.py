"""The plant of the MONOCAB: truth has its parameters, plant its motion with the gimbals, roll_effects and hidden the
effects that may be hidden in it."""
