"""From the physics of a vehicle to its mechanics: each folder here that has a `kind` module says which moves as
which."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any

import simulation
from simulation.bus.machine import Machine
from simulation.config import SimulationConfig


@cache
def _kinds() -> tuple[Any, ...]:
    folders = sorted(f"simulation.{each.name}.kind" for each in iter_modules(simulation.__path__) if each.ispkg)
    return tuple(import_module(each) for each in folders if find_spec(each))


def machine(config: SimulationConfig) -> Machine:
    """The mechanics that `config` describes, at rest.

    Raises UnknownEffectError, and TypeError for a truth that no folder here has.
    """
    for each in _kinds():
        if type(config.plant) is each.TRUTH:
            made: Machine = each.MACHINE(config)
            return made
    raise TypeError(f"nothing here moves as a {type(config.plant).__name__} says")
