"""Model files: a model, the effects that were added to it, and the result of each addition, as TOML. Units are SI.

`load_model("monocab_reduced")` returns a shipped model, `load_model("mine.toml")` one from a file. `read` and `write`
also handle the history. Writing keeps the comments and the order of an existing file if possible.
"""

from __future__ import annotations

import os
import re
import stat
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from upright.models import library
from upright.models.file.document import ModelFile
from upright.models.file.own_equations import base_model, given
from upright.models.file.sections import EffectSection, HistorySection, one_of, sections
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.telemetry.documents import from_toml
from upright.telemetry.tables.mapping import MappingError, columns_of

if TYPE_CHECKING:
    from upright.models.effect import AttachedEffect, Effect


def load_model(name_or_path: str | Path) -> Model:
    """A shipped model by its name, or one from a file that ends in .toml. Raises ModelError."""
    if str(name_or_path).endswith(".toml"):
        return read(name_or_path).model
    if str(name_or_path) not in library.MODELS and Path(name_or_path).exists():
        raise ModelError(str(name_or_path), "is not a model file", remedy="its name has to end in .toml.")
    return library.get(str(name_or_path))


def read(path: str | Path, *, alone: bool = False) -> ModelFile:
    """The model file at `path`. If it has to stand `alone`, it has no model of its actuators.

    Raises:
        ModelError: no such file, not TOML, or invalid content; names file, key and remedy.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        remedy = f"give a path, or a shipped model: {', '.join(library.MODELS)}."
        raise ModelError(str(path), f"cannot be read: {error.strerror}", remedy=remedy) from error
    except UnicodeDecodeError as error:
        raise ModelError(str(path), f"is not text in UTF-8 ({error})", remedy="save it as UTF-8.") from error
    return parse(text, path, alone=alone)


def parse(text: str, path: str | Path, *, alone: bool = False) -> ModelFile:
    """The model file with the content `text`; `path` is where it is or will be. Raises ModelError as `read` does."""
    file = str(path)
    try:
        table = from_toml(text)
    except ValueError as error:
        remedy = "correct that line; a name can be given only once."
        raise ModelError(file, f"is not valid TOML: {error}", remedy=remedy) from error
    tables = sections(table, file)
    model = base_model(tables, file, tables.name or _name(file))
    effect_files = {}
    for place, entry in enumerate(tables.effects):
        model, attached = _attach(model, entry, file, f"{file}: effects.{place}")
        if entry.file:
            effect_files[attached.name] = entry.file
    _check_columns(model, tables.columns, file)
    beside = tables.actuators_model or ""
    if beside and alone:
        what = "is in a model of actuators, which has no further one"
        raise ModelError(f"{file}: actuators_model", what, remedy="remove the key.")
    if beside:
        model = replace(model, actuators_model=_actuators(model, Path(path).parent / beside, file))
    return ModelFile(model, tuple(map(_entry, tables.history)), effect_files, tables.columns, beside)


def write(file: ModelFile, path: str | Path) -> None:
    """Write `file` to `path` atomically. An existing file keeps its comments if possible.

    Raises:
        ModelError: a model file cannot express `file` (an own effect without a file), or it cannot be written.
    """
    from upright.models.file import text as as_text

    path = Path(os.path.realpath(path))
    for attached in file.model.effects:
        _check_origin(attached, file, path)
    if file.model.actuators_model is not None and not file.actuators_file:
        remedy = "write the model of its actuators first."
        raise ModelError(f"{path}: actuators_model", "no file is known for it", remedy=remedy)
    text = None
    if path.exists():
        before = path.read_text(encoding="utf-8")
        try:
            text = as_text.edited(before, parse(before, path), file)
            text = text if text is not None and parse(text, path) == file else None
        except ModelError:
            text = None  # the existing file is not a model file, or too unusual to be edited
    if text is None:
        text = as_text.fresh(file)
        if parse(text, path) != file:
            what = f"the model {file.model.name} cannot be written so that reading restores it"
            raise ModelError(str(path), what, remedy="build it from a shipped model, or from equations in a file.")
    _replace(path, text)


def _actuators(model: Model, path: Path, file: str) -> Model:
    """The model of the actuators in the file at `path`: it has a command, which is none of the inputs of `model`, and
    shows the motion that is one. Raises ModelError for any other.
    """
    where = f"{file}: actuators_model"
    found = read(path, alone=True).model
    inputs = {each.channel for each in model.inputs}
    commands = {name for each in found.actuators for name in each.commands}
    if not commands or commands & inputs or inputs.isdisjoint(each.name for each in found.outputs):
        what = f"{path} is no model from a command to the motion that is an input of {model.name}"
        raise ModelError(where, what, remedy="name the file that `upright diagnose --auto` wrote beside this one.")
    return found


def _check_columns(model: Model, columns: Mapping[str, str], file: str) -> None:
    """Raises ModelError for a channel that the model does not have, or a column that cannot be understood."""
    channels = ["time", *(each.channel for each in model.inputs), *(each.name for each in model.outputs)]
    for name, text in columns.items():
        if name not in channels:
            raise ModelError(f"{file}: columns.{name}", "is no channel of the model", remedy=one_of(name, channels))
        try:
            columns_of({name: text})
        except MappingError as error:
            raise ModelError(f"{file}: columns.{name}", str(error.args[0]), remedy=error.remedy) from error


def _attach(model: Model, entry: EffectSection, file: str, where: str) -> tuple[Model, AttachedEffect]:
    """`model` with the effect of `entry` and its values."""
    try:
        model = model.add(_effect(entry, file), entry.at)
    except ModelError as error:
        raise ModelError(where, str(error.args[0]).rstrip("."), remedy=error.remedy) from error
    *others, attached = model.effects
    prefix = f"{attached.name}."
    local = {parameter.name: parameter.name.removeprefix(prefix) for parameter in attached.parameters}
    parameters = given(attached.parameters, entry.parameters, f"{where}.parameters", local.__getitem__)
    attached = replace(attached, parameters=parameters)
    return replace(model, effects=(*others, attached)), attached


def _effect(entry: EffectSection, file: str) -> Effect:
    from upright.models.effects.catalogue import find

    if not entry.file:
        if not entry.name:
            what = "has neither name nor file"
            raise ModelError("effect", what, remedy="name an effect; `upright model list-effects` lists them.")
        return find(entry.name).with_parameters(entry.parameters)
    from upright.models.file.own_effects import load_effect

    effect = load_effect(Path(file).parent / entry.file)
    if entry.name and effect.name != entry.name:
        remedy = f"write name = {effect.name!r}, or leave it out."
        raise ModelError(f"effect {entry.name}", f"{entry.file} describes {effect.name}", remedy=remedy)
    return effect


def _entry(section: HistorySection) -> dict[str, Any]:
    return section.model_dump(exclude_none=True)


def _check_origin(attached: AttachedEffect, file: ModelFile, path: Path) -> None:
    """Raises ModelError unless the effect can be found again, in the catalogue or in a file."""
    from upright.models.effects.catalogue import find

    own = file.effect_files.get(attached.name)
    where = f"{path}: effect {attached.name}"
    if own is not None:
        from upright.models.file.own_effects import load_effect

        if load_effect(path.parent / own) != attached.effect:
            raise ModelError(where, f"{own} now describes another effect", remedy="read the model file again.")
        return
    try:
        known = find(attached.effect.name)
    except ModelError:
        known = None
    if known is None or attached.effect not in (known, known.instead, known.finer):
        remedy = "write it into a file of its own (.toml or .py), and add that."
        raise ModelError(where, "is not in the catalogue, and no file is known for it", remedy=remedy)


def _name(file: str) -> str:
    """A model's name if its file gives none: the file's name, as far as it is a valid name."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", Path(file).stem)[:64] or "model"


def _replace(path: Path, text: str) -> None:
    """Replaces the file atomically: readers, also after a power failure, find either the old file or the new one."""
    temporary = None
    try:
        mode = stat.S_IMODE(path.stat().st_mode) if path.exists() else 0o666 & ~_umask()
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "w", encoding="utf-8") as stream:
            stream.write(text)
            stream.flush()
            os.fchmod(stream.fileno(), mode)
            os.fsync(stream.fileno())
        os.replace(temporary, path)
        temporary = None
    except OSError as error:
        what = f"cannot be written: {error.strerror}"
        raise ModelError(str(path), what, remedy="check the folder, its permissions and the free space.") from error
    finally:
        if temporary is not None:
            os.unlink(temporary)


def _umask() -> int:
    """The umask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
