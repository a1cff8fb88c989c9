"""The table: everything that reads bytes of others, by its name."""

from __future__ import annotations

from fuzz.target import Target
from fuzz.targets import bus, can_logs, equations, files, formats, network, recordings

MODULES = (bus, files, equations, recordings, formats, can_logs, network)
TARGETS: dict[str, Target] = {target.name: target for module in MODULES for target in module.TARGETS}
