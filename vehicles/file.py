"""The vehicle file: everything about one vehicle that is not code (TOML, checked by pydantic).

`load("monocab")` reads a shipped file, `load("path/to/file.toml")` one of the user's own. Every mistake in it raises a
`VehicleFileError` that names the file, the key and the remedy. The sections are in `vehicles.sections`,
those of one kind of vehicle in its own `file` module.
"""

from __future__ import annotations

import difflib
import hashlib
from collections.abc import Iterable
from functools import reduce
from importlib import resources
from operator import or_
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from upright.telemetry.documents import from_toml
from upright.telemetry.errors import UprightError
from upright.vehicles import registry
from upright.vehicles.sections import DriveSection, ExperimentSection, VehicleFile

__all__ = ["DriveSection", "ExperimentSection", "VehicleFile", "VehicleFileError", "load", "schema", "shipped"]


OUT_OF_RANGE = ("greater_than", "less_than_equal", "finite_number")
"""Errors of pydantic that mean that a limit is not in its range."""


class VehicleFileError(UprightError):
    """A vehicle file that cannot be used. `file` and `key` say where, `remedy` says what to change."""

    def __init__(self, file: str, key: str, message: str, *, remedy: str = "") -> None:
        super().__init__(f"{file}: {key}: {message}" if key else f"{file}: {message}", remedy=remedy)
        self.file = file
        self.key = key


def shipped() -> list[str]:
    """Names of the vehicle files that ship with upright."""
    return list(registry.names())


def shipped_file(name: str) -> Path:
    """The vehicle file that ships with upright under this name."""
    return Path(str(resources.files("upright.vehicles") / name / "vehicle.toml"))


def load(name_or_path: str) -> VehicleFile:
    """Read and check a vehicle file: the name of a shipped one, or a path.

    Raises:
        VehicleFileError: no such file, not TOML, or a key that is missing, unknown or wrong.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml" and name_or_path in shipped():
        path = shipped_file(name_or_path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise VehicleFileError(
            name_or_path,
            "",
            f"cannot be read: {error.strerror}",
            remedy=f"Give a path, or one of: {', '.join(shipped())}.",
        ) from error
    try:
        table = from_toml(content.decode("utf-8"))
    except ValueError as error:
        raise VehicleFileError(str(path), "", f"is not valid TOML: {error}", remedy="Correct that line.") from error
    return _check(table, str(path), hashlib.sha256(content).hexdigest()[:16])


def schema() -> dict[str, Any]:
    """The JSON Schema of vehicle files, of every kind."""
    kinds = [registry.of(name).file for name in registry.names()]
    found: dict[str, Any] = TypeAdapter(reduce(or_, kinds)).json_schema()
    places: dict[tuple[str, str], Iterable[str]] = {
        ("VehicleSection", "kind"): registry.names(),
        ("DriveSection", "role"): {role for kind in kinds for role in kind.ROLES},
        ("ExperimentSection", "at"): {point for kind in kinds for point in kind.INJECTION_POINTS},
    }
    for (section, key), values in places.items():
        found["$defs"][section]["properties"][key]["enum"] = sorted(values)
    return found


def _check(table: dict[str, Any], file: str, digest: str) -> VehicleFile:
    for reserved in ("path", "configuration_hash"):
        if reserved in table:
            raise VehicleFileError(file, reserved, "is not a key of a vehicle file", remedy="Remove it.")
    section = table.get("vehicle")
    name = section.get("kind") if isinstance(section, dict) else None
    # If it states no kind, that is found like any other mistake in it.
    try:
        kind = registry.of(name if isinstance(name, str) else registry.names()[0]).file
    except registry.UnknownKindError as error:
        raise VehicleFileError(file, "vehicle.kind", str(error.args[0]), remedy=error.remedy) from error
    try:
        return kind.model_validate({**table, "path": file, "configuration_hash": digest})
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        message = str(first["msg"]).removeprefix("Value error, ")
        remedy = "Correct this key; `upright config schema` lists every key with its unit."
        if first["type"] == "extra_forbidden":
            message = "is not a key of a vehicle file"
            near = difflib.get_close_matches(str(first["loc"][-1]), _known_keys(kind, first["loc"]), n=1)
            remedy = f"Did you mean {near[0]!r}?" if near else "Remove it; `upright config schema` lists every key."
        elif first["type"] == "missing":
            message = "is missing"
            remedy = "Add it; the shipped vehicle files show every key with its unit."
        elif first["type"] in OUT_OF_RANGE and (found := _range(kind, first["loc"])):
            message = f"{found} (found {first['input']!r})"
        elif "input" in first and not isinstance(first["input"], dict | BaseModel):
            message = f"{message} (found {first['input']!r})"
        more = len(error.errors()) - 1
        if more:
            remedy += f" ({more} more to correct after it.)"
        raise VehicleFileError(file, key, message, remedy=remedy) from error


def _range(kind: type[VehicleFile], location: tuple[int | str, ...]) -> str:
    """The range of the limit at `location`, with the reason, in words; "" for any other key."""
    model = _section(kind, location)
    field = model.model_fields.get(str(location[-1])) if model is not None else None
    extra = field.json_schema_extra if field is not None else None
    if field is None or not isinstance(extra, dict) or "$comment" not in extra:
        return ""
    most = next(each.le for each in field.metadata if hasattr(each, "le"))
    return f"must be above 0 and at most {most:g}: {extra['$comment']}"


def _known_keys(kind: type[VehicleFile], location: tuple[int | str, ...]) -> list[str]:
    """The keys of the section that `location` is in."""
    model = _section(kind, location)
    return list(model.model_fields) if model is not None else []


def _section(kind: type[VehicleFile], location: tuple[int | str, ...]) -> type[BaseModel] | None:
    """The section that `location` is in."""
    model: Any = kind
    for part in location[:-1]:
        if isinstance(part, str) and part in model.model_fields:
            annotation = model.model_fields[part].annotation
            inner = [a for a in getattr(annotation, "__args__", ()) if isinstance(a, type) and issubclass(a, BaseModel)]
            model = inner[0] if inner else annotation
    return model if isinstance(model, type) and issubclass(model, BaseModel) else None
