"""The truth of the cube, and the machine that simulates it."""

from __future__ import annotations

from upright.simulation.cube.plant import CubePlant
from upright.simulation.cube.truth import CubeTruth

TRUTH, MACHINE = CubeTruth, CubePlant
