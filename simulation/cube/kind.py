"""Which truth moves as which machine."""

from __future__ import annotations

from simulation.cube.plant import CubePlant
from simulation.cube.truth import CubeTruth

TRUTH, MACHINE = CubeTruth, CubePlant
