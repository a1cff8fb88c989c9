"""Which truth moves as which machine."""

from __future__ import annotations

from simulation.monocab.plant import Plant
from simulation.monocab.truth import PlantTruth

TRUTH, MACHINE = PlantTruth, Plant
