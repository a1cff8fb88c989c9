"""The results of the methods as columns of formatted text, for a terminal as well as for a page.

Methods are rows, each group under its name in square brackets; parameters are columns.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.identify.table import Domain
from upright.estimators.numbers import Scale, common

NUISANCES = frozenset({"drive_offset", "setpoint_offset", "drive_time_offset"})
"""Nuisance parameters: estimated so that they do not bias the others, but not properties of the vehicle. They are only
in the JSON."""

Columns = list[list[str]]
"""Columns, each with heading and unit first."""


def shown_parameters(methods: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Name to unit of the parameters that any of `methods` estimates, without nuisance parameters."""
    return {
        name: entry["unit"]
        for method in methods.values()
        for name, entry in method["parameters"].items()
        if name not in NUISANCES
    }


def joint_columns(methods: Mapping[str, Any], document: Mapping[str, Any], truth: Mapping[str, float]) -> list[Columns]:
    """The estimates from all recordings, below the prior values, as groups of columns that belong together."""
    before = document["before"]
    rows: list[tuple[str, Mapping[str, Any] | None]] = [("CAD", {"parameters": before})]
    if truth:
        rows.append(("truth", {"parameters": {name: {"value": value} for name, value in truth.items()}}))
    rows += list(_grouped(methods))
    groups: list[Columns] = [[["method", "", *(name for name, _ in rows)]]]
    for name, unit in shown_parameters(methods).items():
        entries = [(row or {}).get("parameters", {}).get(name) for _, row in rows]
        groups.append(_value_columns(name, unit, entries, before.get(name)))
    heading = "fit" if document["fit_measured_alike"] else "own fit"
    fits = [min(entry.get("fit_percent", {}).values(), default=None) if entry else None for _, entry in rows]
    seconds = [entry.get("seconds") or None if entry else None for _, entry in rows]
    groups.append([[heading, "%", *(_number(fit, 1) for fit in fits)]])
    groups.append([["took", "s", *(_number(each, 1) for each in seconds)]])
    return groups


def disturbances(document: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Method and its disturbance at each joint, for the methods that estimate one."""
    for name, entry in document["methods"].items():
        found = [DisturbanceEstimate.from_json(*each) for each in entry.get("disturbance", {}).items()]
        for each in found:
            yield name, f"{each.joint}: {each}" if len(found) > 1 else str(each)


def mean_columns(methods: Mapping[str, Any], document: Mapping[str, Any]) -> list[Columns]:
    """The mean of the single recordings for each method, with their scatter."""
    rows = list(_grouped({name: entry for name, entry in methods.items() if entry["mean"]}))
    groups: list[Columns] = [[["method", "", *(name for name, _ in rows)]]]
    for name, unit in shown_parameters(methods).items():
        entries = [entry["mean"].get(name) if entry else None for _, entry in rows]
        groups.append(_value_columns(name, unit, entries, document["before"].get(name)))
    counts = [max((mean["runs"] for mean in entry["mean"].values()), default=0) if entry else None for _, entry in rows]
    groups.append([["runs", "", *("" if count is None else str(count) for count in counts)]])
    return groups


def _grouped(methods: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any] | None]]:
    """The methods, each group under its name."""
    for domain in Domain:
        inside = {name: entry for name, entry in methods.items() if entry["domain"] == domain}
        if inside:
            yield f"[{domain.value}]", None
            yield from inside.items()


def _value_columns(
    name: str, unit: str, entries: Sequence[Mapping[str, Any] | None], before: Mapping[str, Any] | None
) -> Columns:
    """Value and standard deviation, and the deviation from the prior value in percent, if there is one."""
    words, scale = name.replace(".", "_").split("_"), scale_of(entries, unit)
    columns = [[" ".join(dict.fromkeys(words)), scale.unit, *(value_text(entry, scale) for entry in entries)]]
    if before is not None:
        values = [entry.get("value") if entry else None for entry in entries]
        changes = ["" if v in (None, before["value"]) else f"{100 * (v / before['value'] - 1):+.1f}" for v in values]
        columns.append(["vs CAD", "%", *changes])
    return columns


def scale_of(entries: Iterable[Mapping[str, Any] | None], unit: str) -> Scale:
    """What values of one parameter have in common: a power of ten, and the unit to which it belongs."""
    return common([(entry.get("value"), entry.get("std")) for entry in entries if entry], unit)


def value_text(entry: Mapping[str, Any] | None, scale: Scale) -> str:
    """Value and standard deviation, "-" if it is not known."""
    return "" if entry is None else scale.text(entry.get("value"), entry.get("std"))


def _number(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"


def sentence(text: str) -> str:
    """`text` with a capital at its start and a full stop at its end."""
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def others(methods: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Why each of the other methods that give values is not the one to rely on, grouped by reason."""
    by_reason: dict[str, list[str]] = {}
    for name, entry in methods.items():
        known = any(each["value"] is not None for each in entry["parameters"].values())
        if known and entry.get("not_chosen"):
            by_reason.setdefault(entry["not_chosen"], []).append(name)
    for reason, names in by_reason.items():
        yield f"{', '.join(names)}: {reason}"


def remarks(methods: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Remarks on single methods, grouped by remark."""
    grouped: dict[tuple[str, str], list[str]] = {}
    for name, entry in methods.items():
        whole = entry["reason"]
        if whole or entry["status"] != "ok":
            state = "" if entry["status"] == "ok" else f"{entry['status'].replace('_', ' ')}: "
            grouped.setdefault(("", f"{state}{whole}"), []).append(name)
        for parameter, each in entry["parameters"].items():
            if parameter not in NUISANCES and each.get("reason") not in (None, "", whole):
                grouped.setdefault((parameter, each["reason"]), []).append(name)
    for (parameter, reason), names in grouped.items():
        yield f"{', '.join(names)}: {f'{parameter}: ' if parameter else ''}{reason}"
