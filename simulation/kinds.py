"""From the physics of a vehicle to its mechanics: which of them moves as which machine."""

from __future__ import annotations

from simulation.bus.machine import Machine
from simulation.config import PlantTruth, SimulationConfig
from simulation.plant import Plant
from simulation.twsbr.plant import TwsbrPlant
from simulation.twsbr.truth import TwsbrTruth

MACHINES: dict[type, type[Plant] | type[TwsbrPlant]] = {PlantTruth: Plant, TwsbrTruth: TwsbrPlant}
"""Truth to machine."""


def machine(config: SimulationConfig) -> Machine:
    """The mechanics that `config` describes, at rest. Raises UnknownEffectError."""
    return MACHINES[type(config.plant)](config)
