"""The truth of the balancing robot, and the machine that simulates it."""

from __future__ import annotations

from upright.simulation.twsbr.plant import TwsbrPlant
from upright.simulation.twsbr.truth import TwsbrTruth

TRUTH, MACHINE = TwsbrTruth, TwsbrPlant
