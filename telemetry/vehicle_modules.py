"""What a kind of vehicle provides for the layers that know no vehicle: modules of its folder under `vehicles`.

    {kind: module.CHANNELS for kind, module in each_with("channels").items()}

A layer finds here what it defines itself (telemetry: a table of channels, models: models), by the name of the module
that has it; such a module imports nothing above that layer (import-linter's contracts in pyproject.toml). So a further
vehicle is a further folder, and no layer names a vehicle.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from types import ModuleType

FOLDER = "upright.vehicles"


@cache
def kinds_with(module: str) -> tuple[str, ...]:
    """The kinds of vehicle, sorted, whose folder has a module of this name."""
    there = find_spec(FOLDER)
    folders = iter_modules(there.submodule_search_locations) if there else ()
    kinds = sorted(each.name for each in folders if each.ispkg)
    return tuple(kind for kind in kinds if find_spec(f"{FOLDER}.{kind}.{module}"))


@cache
def each_with(module: str) -> dict[str, ModuleType]:
    """The modules of this name, by kind of vehicle."""
    return {kind: import_module(f"{FOLDER}.{kind}.{module}") for kind in kinds_with(module)}
