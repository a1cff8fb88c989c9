"""The table: everything that reads bytes of others, by its name."""

from __future__ import annotations

from fuzz.target import Target
from fuzz.targets import bus, equations, files, network, recordings

TARGETS: dict[str, Target] = {
    target.name: target
    for target in (*bus.TARGETS, *files.TARGETS, *equations.TARGETS, *recordings.TARGETS, *network.TARGETS)
}
