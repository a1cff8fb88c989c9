"""From the physics of a vehicle to its mechanics: the `kind` module of each folder here names its truth and the machine
that simulates it."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import Any

from upright import simulation
from upright.simulation.bus.machine import Machine
from upright.simulation.config import SimulationConfig


@cache
def _kinds() -> tuple[Any, ...]:
    folders = sorted(f"upright.simulation.{each.name}.kind" for each in iter_modules(simulation.__path__) if each.ispkg)
    return tuple(import_module(each) for each in folders if find_spec(each))


def machine(config: SimulationConfig) -> Machine:
    """The mechanics that `config` describes, at rest.

    Raises UnknownEffectError, and TypeError for a truth without a machine.
    """
    for each in _kinds():
        if type(config.plant) is each.TRUTH:
            made: Machine = each.MACHINE(config)
            return made
    raise TypeError(f"no machine simulates a {type(config.plant).__name__}")
