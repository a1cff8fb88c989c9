"""The truth of the MONOCAB, and the machine that simulates it."""

from __future__ import annotations

from upright.simulation.monocab.plant import Plant
from upright.simulation.monocab.truth import PlantTruth

TRUTH, MACHINE = PlantTruth, Plant
