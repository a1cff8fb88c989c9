"""The MONOCAB as a plant: truth is what it is made of, plant how it moves with its gimbals, roll_effects and hidden
what it may contain that nobody knows."""
