"""The page docs/reference/effects.md, written from the catalogue: `python docs/reference/effects_page.py > PAGE`."""

from __future__ import annotations

from upright.models.effect import Effect, EffectParameter, Family
from upright.models.effects.catalogue import CATALOGUE, families
from upright.models.file import own_effects as custom
from upright.models.parts import Place
from upright.models.place import EVERY_JOINT, SCALES, UNITS, VOCABULARY
from upright.models.text.expressions import names_in

_INTRODUCTION = """\
# Effects

What a model may lack, by canonical name. An effect is a term at a joint, on an actuator or on a sensor, and is exactly
absent if its amplitudes are zero. `upright model add` adds one to a model, `upright diagnose` ranks them all, and
`upright simulate --hide EFFECT` hides one in the virtual vehicle.

In a model, a parameter is called `EFFECT.NAME`, as in `coulomb_friction.torque`, or `EFFECT@PLACE.NAME` at any place
other than the first one that supports the effect. Units and start values depend on the place: `{force}` is N m if a
joint turns and N if it slides, `{coordinate}` rad or m; `{command}` and `{angle}` are the actuator's, `{angle}` and
`{rate}` the sensor's. `force_scale`, `coordinate_scale`, `rate_scale`, `command_scale` and `angle_scale` are typical
magnitudes that the model states for its joints, actuators and sensors. `time_scale` is the natural time of the model in
s, coordinate_scale / rate_scale of its slowest joint (0.4 s for the MONOCAB). `smooth_rate` is the rate below which
sgn(rate) is approximated by a slope, tanh(rate / smooth_rate).

F is a force at the joint, inertia * rate' = load + F, u a command, t the time in s since the first sample of a record.
"Amplitude" marks the parameters that are zero if the effect is absent.

"""

_KEYS = """\
Its keys are those of `models.effect.Effect`. `equation`, `signature`, `confused_with`, `separated_by`, `source`,
`dissipative`, `impacts`, `stiff` (its own motion is much faster than the sampling, so that the diagnosis during a run
does not search for it), `sets_in` (false if it cannot set in during a run), `onset_of` (the other effect of which it is
the onset), `formula_error` (the share of what it explains that its formula may leave unexplained, or that a second
effect may explain merely by bending the formula: 0.1, and 0 for an exact formula), `in_radians` and `[[states]]`
(`name`, `unit`, `derivative`, `meaning`, `spread`, the standard deviation of the state when a record begins, and on a
sensor `initial`, the reading that it begins with: angle or rate) are optional. A parameter has `name`, `unit`,
`meaning`, `amplitude`, `role`, `value`, `scale` (a typical magnitude), `lower`, `upper` and `starts`. A diagnosis
derives start values from the `role`: for "frequency" from a peak in the spectrum of the innovations, for "instant" from
the time at which a step would explain most, for "duration" (of the onset) the shortest possible one; any other
parameter is a "shape". An expression may contain numbers, + - * / **, brackets, the functions sin, cos, tan, asin,
acos, atan, sinh, cosh, tanh, exp, log, sqrt, abs, sign, min and max, `pi`, its own parameters and states, and the names
of its place:
"""

_RULES = """\
`load` is the force at the joint without the effect, so that `load / inertia` is its acceleration. `actuator_inertia` is
the part of `inertia` that is the actuator's own, e.g. that of a rotor before its gear. The derivative of a state may
also use `force`. `twist` is how far the effect lets the actuator be ahead of `coordinate`: the sensors on the actuator
show it. `angle_1` and `angle_2` are time derivatives. A place that lacks a name that is used, e.g. an actuator whose
angle is not measured, cannot have the effect.

A Python file assigns `EFFECT = Effect(...)`, of [`upright`](python.md#effect). It is code: reading it runs it, with all
the rights of the reader.
Read only files that you would run.
"""

_FAMILIES = {
    Family.BIAS: "Bias",
    Family.DRY_FRICTION: "Dry friction",
    Family.SPEED_DRAG: "Drag that grows with speed",
    Family.STIFFNESS: "Stiffness",
    Family.TIME_SHIFT: "Time shift",
    Family.GAIN: "Gain",
    Family.COUPLING: "Coupling",
    Family.PERIODIC: "Periodic",
    Family.MEMORY: "Memory",
    Family.STRUCTURE: "Structure",
    Family.SENSOR: "Sensor",
}

_PLACES = {
    Place.JOINT: "`force`, `twist`, and `states` if it has a memory",
    Place.ACTUATOR: "`command`, or the name of a parameter in s as `delay` or `lag`",
    Place.SENSOR: "`angle_reading`, `rate_reading`, the name of a parameter in s as `delay`, and `states` if it has a "
    "memory",
}


def markdown() -> str:
    """The whole page."""
    parts = [_INTRODUCTION, _overview()]
    for family, effects in families().items():
        parts.append(f"## {_FAMILIES[family]}\n\n")
        parts += [_section(effect) for effect in effects]
    return "".join([*parts, _own()]).rstrip() + "\n"


def _overview() -> str:
    rows = [
        f"| [`{effect.name}`](#{effect.name}) | {effect.family} | {effect.place} | {effect.title} |"
        for effect in CATALOGUE.values()
    ]
    return "\n".join(["| effect | family | place | description |", "|---|---|---|---|", *rows]) + "\n\n"


def _section(effect: Effect) -> str:
    lines = [f"### `{effect.name}`", "", f"{_sentence(effect.title)}", "", *_formula(effect)]
    if effect.instead:
        names = set().union(*map(names_in, effect.instead.expressions.values())) & VOCABULARY[effect.place]
        names -= set().union(EVERY_JOINT, *map(names_in, effect.expressions.values()))
        lines += [f"Instead, at a {effect.place} that offers {_code(names)}:", "", *_formula(effect.instead)]
    if effect.finer:
        lines += ["A diagnosis uses the finer formula if the record requires it:", "", *_equation(effect.finer)]
    return "\n".join([*lines, ""])


def _formula(effect: Effect) -> list[str]:
    lines = [*_equation(effect), f"**In a record:** {effect.signature}", ""]
    lines += [f"**Confused with:** {', '.join(f'[`{name}`](#{name})' for name in effect.confused_with)}.", ""]
    lines += [f"**Separated by:** {effect.separated_by}", ""]
    more = "It never adds energy. " if effect.dissipative else ""
    if effect.impacts:
        more += "Its parts collide: a diagnosis fits it from each start, whatever it does at a small amplitude. "
    if effect.beyond:
        beyond = " and ".join(f"[`{name}`](#{name})" for name in effect.beyond)
        more += f"It is detectable only by what it does beyond {beyond} at its usual shape. "
    if effect.in_radians:
        more += f"It needs {' and '.join(f'`{name}`' for name in effect.in_radians)} in rad. "
    return [*lines, f"{more}Source: {effect.source}.", ""]


def _equation(effect: Effect) -> list[str]:
    lines = ["```", effect.equation, "```", ""]
    lines += ["| parameter | unit | meaning | value | bounds |", "|---|---|---|---|---|"]
    return [*lines, *map(_row, effect.parameters), ""]


def _row(parameter: EffectParameter) -> str:
    value = "0, amplitude" if parameter.amplitude else parameter.value
    starts = f", then {', '.join(parameter.starts)}" if parameter.starts else ""
    bounds = f"{parameter.lower or '-inf'} to {parameter.upper or 'inf'}" if parameter.lower or parameter.upper else ""
    return f"| `{parameter.name}` | {parameter.unit} | {parameter.meaning} | {value}{starts} | {bounds} |"


def _sentence(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _own() -> str:
    documentation = custom.__doc__ or ""
    example = "\n".join(line[4:] for line in documentation.split("\n") if line.startswith("    ") or not line)
    lines = ["## An effect of your own", ""]
    lines += ["A TOML file describes an effect and runs no code. `upright model add` adds it to a model.", ""]
    lines += ["```toml", example.strip(), "```", "", _KEYS]
    lines += [
        "| place | keys for its action | names in expressions | names in values and bounds | names in units |",
        "|---|---|---|---|---|",
    ]
    for place, does in _PLACES.items():
        columns = [_code(VOCABULARY[place]), _code(SCALES[place]), _code({f"{{{unit}}}" for unit in UNITS[place]})]
        lines.append(f"| {place} | {does} | {' | '.join(columns)} |")
    return "\n".join([*lines, "", _RULES])


def _code(names: frozenset[str] | set[str]) -> str:
    return ", ".join(f"`{name}`" for name in sorted(names))


if __name__ == "__main__":
    print(markdown(), end="")
