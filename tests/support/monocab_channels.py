"""What the shipped MONOCAB records."""

from __future__ import annotations

from upright.vehicles import registry
from upright.vehicles.file import load

MONOCAB = registry.recorded(load("monocab"))
