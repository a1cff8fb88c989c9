"""The truth of the MONOCAB, and the machine that simulates it."""

from __future__ import annotations

from simulation.monocab.plant import Plant
from simulation.monocab.truth import PlantTruth

TRUTH, MACHINE = PlantTruth, Plant
