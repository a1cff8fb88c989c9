"""Which truth moves as which machine."""

from __future__ import annotations

from simulation.twsbr.plant import TwsbrPlant
from simulation.twsbr.truth import TwsbrTruth

TRUTH, MACHINE = TwsbrTruth, TwsbrPlant
