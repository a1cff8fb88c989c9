"""A model file as text: written from scratch, or as small changes to the existing text.

The result is read again before it is used (models.file.model_file.write), so a failed edit of an unusual file does no
harm.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, asdict, fields, replace
from itertools import takewhile
from typing import Any

from upright.models import library
from upright.models.attach import attach
from upright.models.effect import AttachedEffect
from upright.models.file.document import ModelFile
from upright.models.model import Model
from upright.models.parts import Disturbance, Filter, NarrowBand, Parameter

_VALUES = ("value", "std", "lower", "upper", "estimated", "scale")
_INTRODUCTION = """\
# A model of upright; docs/reference/model-file.md explains every key. Units are SI.
# See it with `upright model show FILE`, change its effects with `upright model add` and `upright model remove`.
"""


def fresh(file: ModelFile) -> str:
    """The text of `file`, written from scratch."""
    model = file.model
    base = base_of(model)
    lines = [_INTRODUCTION, f"name = {_toml(model.name)}"]
    lines += [
        f"{key} = {_toml(getattr(model, key))}"
        for key, usual in (("title", ""), ("source", ""), ("settling", 0.0))
        if getattr(model, key) != (usual if base is None else getattr(base, key))
    ]
    if base is not None:
        lines += [f"base = {_toml(base.name)}"]
    if file.actuators_file:
        lines += [f"actuators_model = {_toml(file.actuators_file)}"]
    if base is not None:
        lines += ["", "[parameters]"]
        entries = {
            each.name: _values(each, default, {"value", "std"} if each.std else {"value"})
            for each, default in zip(model.base_parameters, base.base_parameters, strict=True)
        }
        lines += _aligned(entries, {each.name: _comment(each) for each in model.base_parameters})
        for joint, usual in zip(model.joints, base.joints, strict=True):
            if joint.disturbance != usual.disturbance:
                lines += ["", f"[joints.{joint.name}]", f"disturbance = {_toml(joint.disturbance)}"]
    else:
        lines += _equations(model)
    if file.columns:
        lines += ["", "[columns]", *(f"{_key(name)} = {_toml(text)}" for name, text in file.columns.items())]
    for attached in model.effects:
        lines += ["", *_effect(model, attached, file.effect_files.get(attached.name, ""))]
    for entry in file.history:
        lines += ["", *_history(entry)]
    return "\n".join(lines) + "\n"


def edited(text: str, old: ModelFile, new: ModelFile) -> str | None:
    """`text`, which describes `old`, edited to describe `new`; None if more than values, effects and history differ."""
    from tomlkit.exceptions import TOMLKitError

    kept = [each for each in new.model.effects if each.name in {other.name for other in old.model.effects}]
    removed = [place for place, each in enumerate(old.model.effects) if each.name not in {other.name for other in kept}]
    added = [each for each in new.model.effects if each not in kept]
    if _bare(old.model) != _bare(new.model):
        return None
    try:
        blocks = _blocks(_with_values(text, old.model, new.model))
    except (TOMLKitError, ValueError):  # tomlkit can read files that it cannot edit
        return None
    effects = [place for place, (table, _) in enumerate(blocks) if table == "effects"]
    if len(effects) != len(old.model.effects):
        return None
    for place in reversed(removed):
        del blocks[effects[place]]
    end = max((i + 1 for i, (table, _) in enumerate(blocks) if table == "effects"), default=-1)
    if end < 0:
        end = min((i for i, (table, _) in enumerate(blocks) if table == "history"), default=len(blocks))
    blocks[end:end] = [("effects", _effect(new.model, each, new.effect_files.get(each.name, ""))) for each in added]
    same = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(old.history, new.history, strict=False)))
    entries = [place for place, (table, _) in enumerate(blocks) if table == "history"]
    if len(entries) != len(old.history) and same < len(old.history):
        return None
    for place in reversed(entries[same:]):
        del blocks[place]
    blocks += [("history", _history(entry)) for entry in new.history[same:]]
    lines: list[str] = []
    for table, block in blocks:
        lines += ["", *block] if table and lines and lines[-1].strip() else block
    return "\n".join(lines).rstrip("\n") + "\n"


def base_of(model: Model) -> Model | None:
    """The shipped model that equals `model` except for values, effects, name and title; None if there is none."""
    for base in library.MODELS.values():
        if _unnamed(model) == _unnamed(base):
            return base
    return None


def _unnamed(model: Model) -> Model:
    """`model` without the attributes that a file may override."""
    return _bare(replace(model, name="", title="", source="", settling=0.0))


def _bare(model: Model) -> Model:
    """`model` without effects, parameter values and disturbances: the part that a change of values keeps."""
    plain = Parameter("", "", 0.0)
    values: dict[str, Any] = {key: getattr(plain, key) for key in _VALUES}
    return replace(
        model,
        effects=(),
        actuators_model=None,
        base_parameters=tuple(replace(each, **values) for each in model.base_parameters),
        joints=tuple(replace(each, disturbance=Disturbance()) for each in model.joints),
    )


def _values(parameter: Parameter, default: Parameter, always: Iterable[str] = ("value",)) -> dict[str, Any]:
    """What a file has to state about `parameter` if it would otherwise be `default`."""
    return {
        key: getattr(parameter, key)
        for key in _VALUES
        if key in always or getattr(parameter, key) != getattr(default, key)
    }


def _comment(parameter: Parameter) -> str:
    return ", ".join(part for part in (parameter.unit, parameter.meaning) if part)


def _aligned(entries: Mapping[str, Mapping[str, Any]], comments: Mapping[str, str]) -> list[str]:
    """`name = { ... }   # comment`, with aligned comments."""
    lines = {name: f"{name} = {_toml(entry)}" for name, entry in entries.items()}
    width = max(map(len, lines.values()), default=0)
    return [f"{line:<{width}}  # {comments[name]}" for name, line in lines.items()]


def _equations(model: Model) -> list[str]:
    """Tables of the user's own equations."""
    lines = []
    if model.definitions:
        lines += ["", "[definitions]", *(f"{name} = {_toml(text)}" for name, text in model.definitions.items())]
    if model.base_parameters:
        lines += ["", "[parameters]"]
        lines += [f"{each.name} = {_toml(_fields(each))}" for each in model.base_parameters]
    groups: dict[str, tuple[Any, ...]] = {
        "states": model.base_states,
        "inputs": model.inputs,
        "outputs": model.outputs,
        "joints": model.joints,
        "actuators": model.actuators,
        "sensors": model.sensors,
    }
    for key, entries in groups.items():
        for entry in entries:
            lines += ["", f"[{key}.{entry.name}]"]
            lines += [f"{name} = {_toml(value)}" for name, value in _fields(entry).items()]
    return lines


def _fields(entry: Any) -> dict[str, Any]:
    """The fields of a part of a model that differ from their defaults, except its name."""
    return {
        each.name: getattr(entry, each.name)
        for each in fields(entry)
        if each.name != "name" and (each.default is MISSING or getattr(entry, each.name) != each.default)
    }


def _effect(model: Model, attached: AttachedEffect, file: str) -> list[str]:
    lines = ["[[effects]]", f"name = {_toml(attached.effect.name)}", f"at = {_toml(attached.at)}"]
    if file:
        lines += [f"file = {_toml(file)}"]
    untouched = attach(replace(model, effects=()), attached.effect, attached.at)
    names = [parameter.name for parameter in attached.effect.parameters]
    if names:
        entries = {
            name: _values(parameter, default)
            for name, parameter, default in zip(names, attached.parameters, untouched.parameters, strict=True)
        }
        comments = {name: _comment(each) for name, each in zip(names, attached.parameters, strict=True)}
        lines += ["", "[effects.parameters]", *_aligned(entries, comments)]
    return lines


def _history(entry: Mapping[str, Any]) -> list[str]:
    return ["[[history]]", *(f"{_key(key)} = {_toml(value)}" for key, value in entry.items())]


def _toml(value: Any) -> str:
    """A value as TOML, on one line."""
    import tomlkit

    match value:
        case dict() | Mapping():
            return "{ " + ", ".join(f"{_key(key)} = {_toml(item)}" for key, item in value.items()) + " }"
        case list() | tuple():
            return "[" + ", ".join(map(_toml, value)) + "]"
        case Filter():
            return _toml(asdict(value))
        case Disturbance() | NarrowBand():
            return _toml(_fields(value))
        case None:  # a joint without a disturbance
            return "false"
        case float():
            return repr(float(value))
        case str():
            return str(tomlkit.item(str(value)).as_string())
        case _:
            return str(tomlkit.item(value).as_string())


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else _toml(name)


def _with_values(text: str, old: Model, new: Model) -> str:
    """`text` with the parameter values of `new` where they differ from those of `old`."""
    import tomlkit
    from tomlkit.items import InlineTable

    document = tomlkit.parse(text)
    changed = False

    def put(table: Any, name: str, before: Parameter, after: Parameter) -> bool:
        differences = _values(after, before, ())
        if not differences:
            return False
        if "parameters" not in table:
            table["parameters"] = tomlkit.inline_table() if isinstance(table, InlineTable) else tomlkit.table()
        if name not in table["parameters"]:
            table["parameters"][name] = tomlkit.inline_table()
            if not isinstance(table["parameters"], InlineTable):
                table["parameters"][name].comment(_comment(after))
        for key, value in differences.items():
            table["parameters"][name][key] = value
        return True

    for before, after in zip(old.base_parameters, new.base_parameters, strict=True):
        changed |= put(document, after.name, before, after)
    now = {attached.name: attached for attached in new.effects}
    for place, attached in enumerate(old.effects):
        if attached.name in now:
            pairs = zip(attached.effect.parameters, attached.parameters, now[attached.name].parameters, strict=True)
            for local, before, after in pairs:
                changed |= put(document["effects"][place], local.name, before, after)
    return document.as_string() if changed else text


def _blocks(text: str) -> list[tuple[str, list[str]]]:
    """(table, lines) in order: each entry of effects and history with the comment above it, and the text in between."""
    blocks: list[tuple[str, list[str]]] = [("", [])]
    for line in text.splitlines():
        header = re.match(r"\s*\[(\[?)\s*([A-Za-z0-9_-]+)", line)
        table, inside = (header[2], not header[1]) if header else ("", True)
        if header and not (inside and table == blocks[-1][0]):  # [effects.parameters] belongs to its [[effects]]
            above = list(takewhile(lambda each: each.lstrip().startswith("#"), reversed(blocks[-1][1])))
            if above and len(above) < len(blocks[-1][1]):
                del blocks[-1][1][-len(above) :]
            else:
                above = []
            blocks.append((table, above[::-1]))
        blocks[-1][1].append(line)
    return blocks
