"""A user-defined effect, from a file; `Model.add` takes it, and it is scored and ranked like the others.

A TOML file has the attributes of models.effect.Effect as keys, and `[[parameters]]` and `[[states]]` have those of
EffectParameter and EffectState. Required are name, family, title, place, a parameter that is an amplitude, and an
expression for the place (force; command, delay or lag; angle_reading or rate_reading):

    name = "rail_bump"
    family = "stiffness"
    title = "a dent in the rail head"
    place = "joint"
    force = "-torque * exp(-(coordinate / width) ** 2)"

    [[parameters]]
    name = "torque"
    unit = "{force}"
    meaning = "at the dent"
    amplitude = true
    scale = "force_scale"

    [[parameters]]
    name = "width"
    unit = "{coordinate}"
    meaning = "of the dent"
    value = "coordinate_scale / 4"
    scale = "coordinate_scale / 20"

A Python file assigns `EFFECT = Effect(...)`. It is code, and reading it runs it with the rights of the reader. So it is
refused unless this user has allowed exactly this file (`models.file.allowed_code`). A TOML file runs no code.
"""

from __future__ import annotations

import dataclasses
import difflib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from upright.models.attach import BELONGING
from upright.models.effect import Effect, EffectParameter, EffectState, Family, Role
from upright.models.effects.catalogue import CATALOGUE
from upright.models.file.allowed_code import is_allowed, sha256
from upright.models.file.effect_rules import validate
from upright.models.parts import ModelError, Place
from upright.telemetry.documents import from_toml

_OPTIONAL = frozenset(("equation", "signature", "confused_with", "separated_by"))
"""Attributes without a default that a file may omit; the equation then consists of the expressions."""
_NO_KEYS = frozenset(("instead",))
"""Attributes that are not keys of a file: one file describes one formula."""
_FORMERLY = {"strikes": "impacts"}
"""Keys of files written for earlier versions, with today's name of the attribute."""

Table = Mapping[str, object]


def load_effect(path: str | Path, *, allow: bool = False) -> Effect:
    """The effect that the file at `path` describes: TOML, or Python, which is run if this user or `allow` allows it.

    Raises ModelError, which names file, key and remedy, if it cannot be read or is not allowed, a key is missing,
    unknown or of the wrong type, an expression is invalid, the effect is not neutral at zero amplitudes, or the
    catalogue has its name.
    """
    path = Path(path)
    if path.suffix not in (".toml", ".py"):
        raise ModelError(str(path), "is not an effect file", remedy="give it the ending .toml or .py.")
    try:
        effect = _from_python(path, allow) if path.suffix == ".py" else _from_toml(path)
    except OSError as error:
        raise ModelError(str(path), f"cannot be read ({error.strerror or error})", remedy="check the path.") from error
    if effect.name in CATALOGUE:
        remedy = "choose another name, or use that one."
        raise ModelError(f"{path}: name", f"the catalogue has an effect {effect.name}", remedy=remedy)
    try:
        validate(effect)
    except ModelError as error:
        raise _in_file(path, error) from error
    return effect


def _in_file(path: Path, error: ModelError) -> ModelError:
    """The same error, with the name of the file."""
    what = error.args[0].removeprefix(f"{error.where}: ").removesuffix(".")
    return ModelError(f"{path}: {error.where}", what, remedy=error.remedy)


def _from_python(path: Path, allow: bool) -> Effect:
    content = path.read_bytes()
    if not (allow or is_allowed(content)):
        what = f"is Python code (SHA-256 {sha256(content)}), and was not allowed to run, or has changed since"
        remedy = f"read it; if you would run it, allow it: upright model allow {path}"
        raise ModelError(str(path), what, remedy=remedy)
    names: dict[str, Any] = {"__name__": "<run_path>", "__file__": str(path)}
    try:
        exec(compile(content, str(path), "exec"), names)
        effect = names.get("EFFECT")
    except (Exception, SystemExit) as error:
        what = f"fails when it is run ({type(error).__name__}: {error})"
        raise ModelError(str(path), what, remedy="correct the Python code.") from error
    if not isinstance(effect, Effect):
        what = "does not define EFFECT" if effect is None else f"EFFECT is a {type(effect).__name__}, not an Effect"
        raise ModelError(f"{path}: EFFECT", what, remedy="write EFFECT = upright.Effect(...).")
    return effect


def _from_toml(path: Path) -> Effect:
    try:
        document = from_toml(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ModelError(str(path), f"is not TOML ({error})", remedy="correct the line.") from error
    where = str(path)
    document = {_FORMERLY.get(key, key): value for key, value in document.items()}
    _check_keys(document, Effect, where, _OPTIONAL)
    family = _one_of(Family, document["family"], f"{where}: family")
    place = _one_of(Place, document["place"], f"{where}: place")
    parts: dict[str, Any] = {
        key: tuple(_part(kind, entry, f"{where}: {key}.{i}") for i, entry in enumerate(_tables(document, key, where)))
        for key, kind in (("parameters", EffectParameter), ("states", EffectState))
    }
    plain = {key: value for key, value in document.items() if key not in ("family", "place", *parts)}
    entries = _values(plain, Effect, where)
    if "equation" not in entries:
        does = [key for key in BELONGING[place] if key in entries]
        entries["equation"] = ",  ".join(f"{key} = {entries[key]}" for key in does)
    entries = {**dict.fromkeys(("signature", "separated_by"), ""), "confused_with": (), **entries}
    return Effect(family=family, place=place, **entries, **parts)


def _tables(document: Table, key: str, where: str) -> list[Table]:
    entries = document.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ModelError(f"{where}: {key}", "is not a list of tables", remedy=f"write each below a line [[{key}]].")
    return entries


def _part(kind: type[EffectParameter] | type[EffectState], entry: Table, where: str) -> Any:
    """A parameter or a state."""
    _check_keys(entry, kind, where, frozenset())
    return kind(**_values(entry, kind, where))


def _check_keys(entry: Table, kind: type[Any], where: str, optional: Collection[str]) -> None:
    """All keys are attributes of `kind`, and those without a default are there."""
    fields = {field.name: field for field in dataclasses.fields(kind) if field.name not in _NO_KEYS}
    for key in entry:
        if key not in fields:
            close = difflib.get_close_matches(key, fields, n=1)
            remedy = f"did you mean {close[0]}?" if close else f"use: {', '.join(fields)}."
            raise ModelError(f"{where}: {key}", "there is no such key", remedy=remedy)
    for name, field in fields.items():
        if field.default is dataclasses.MISSING and name not in entry and name not in optional:
            raise ModelError(f"{where}: {name}", "is missing", remedy=f"add {name} = ...")


def _values(entry: Table, kind: type[Any], where: str) -> dict[str, Any]:
    """`entry` with the types of the attributes of `kind`: text, a number, a boolean, a role, or a list of texts."""
    types = {field.name: str(field.type) for field in dataclasses.fields(kind)}
    return {key: _value(value, types[key], f"{where}: {key}") for key, value in entry.items()}


def _value(value: object, kind: str, where: str) -> object:
    if kind == "Role":
        return _one_of(Role, value, where)
    if kind == "bool":
        if not isinstance(value, bool):
            raise ModelError(where, f"{value!r} is neither true nor false", remedy="write true or false.")
        return value
    if kind == "float":
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ModelError(where, f"{value!r} is not a number", remedy="write a number without quotes.")
        return float(value)
    if kind == "tuple[str, ...]":
        if not isinstance(value, list):
            raise ModelError(where, f"{value!r} is not a list", remedy='write ["...", "..."].')
        return tuple(_text(each, where) for each in value)
    return _text(value, where)


def _text(value: object, where: str) -> str:
    """Numbers may be written without quotes."""
    if isinstance(value, bool) or not isinstance(value, (str, int, float)):
        raise ModelError(where, f"{value!r} is not text", remedy='write it in quotes: "...".')
    return str(value)


def _one_of(kind: type[Family] | type[Place] | type[Role], value: object, where: str) -> Any:
    names = [str(each) for each in kind]
    if value not in names:
        raise ModelError(where, f"there is no {value!r}", remedy=f"use one of: {', '.join(names)}.")
    return kind(value)
