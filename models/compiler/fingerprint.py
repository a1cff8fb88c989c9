"""Identifies models that need machine code of their own, and code that another version generated."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

from upright.models.compiler import machine_code
from upright.models.model import Model


def fingerprint(model: Model) -> str:
    """Identifies models that need code of their own: names, equations, holds, delays, and the generating code."""
    parts: list[Any] = [SOURCES, machine_code.processor(), model.name]
    parts += [(state.name, state.derivative) for state in model.base_states]
    parts += [(each.name, each.hold.value, each.delays, each.lag, each.ramp_of) for each in model.inputs]
    parts += [(each.name, each.expression) for each in model.outputs]
    parts += [parameter.name for parameter in model.base_parameters]
    parts += [sorted(model.definitions.items())]
    parts += [(j.name, j.coordinate, j.rate, j.inertia, j.load, j.smooth_rate) for j in model.joints]
    parts += [(a.name, a.commands, a.joint, a.rate, a.angle, a.gain, a.inertia) for a in model.actuators]
    parts += [(s.name, s.angle, s.rate, s.actuator, s.filter) for s in model.sensors]
    for attached in model.effects:
        effect = attached.effect
        expressions = list(effect.expressions.items())
        names = [parameter.name for parameter in effect.parameters]
        shifts = (effect.delay, effect.lag)
        parts += [(attached.name, attached.at, effect.place.value, expressions, shifts, names, attached.time_scale)]
    return digest(*parts)


def digest(*parts: Any) -> str:
    """A name for `parts` that changes with any of them."""
    return hashlib.sha256(repr(parts).encode()).hexdigest()[:20]


def _sources() -> str:
    """Changes with any change of the code that generates machine code."""
    here = Path(__file__).parent
    compiler = ("codegen", "column_code", "derivatives", "equations", "loops", "machine_code")
    above = ("text/expressions", "text/syntax", "sensing")
    files = [*(here / f"{name}.py" for name in compiler), *(here.parent / f"{name}.py" for name in above)]
    return hashlib.sha256(b"".join(each.read_bytes() for each in files)).hexdigest()


SOURCES = _sources()
"""Of the loaded code: computed at import, since an upgrade may change the files while this process runs."""
