"""From single fits to the document of `identify --json`: joint estimates, runs and their mean, method to rely on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean, stdev
from typing import Any

from upright.estimators.contract import Estimate, ParameterEstimate, Status
from upright.estimators.identify.choice import OWN, choose
from upright.estimators.identify.subject import OwnMethods
from upright.estimators.identify.table import METHODS, Domain, Experiment
from upright.telemetry.recording import Recording

FAILED, NOT_SUITED, CANCELLED = "failed", "not_suited", "cancelled"
"""Status values of a method, in addition to those of an estimate."""

Results = dict[tuple[str, tuple[int, ...]], dict[str, Any]]
"""By method and the indices of its recordings: an estimate, JSON-ready."""


def nothing(status: str, reason: str) -> dict[str, Any]:
    """The entry of a method without a result."""
    return {
        "parameters": {},
        "fit_percent": {},
        "fit_measured": OWN,
        "pole": None,
        "window": None,
        "seconds": 0.0,
        "status": status,
        "reason": reason,
    }


def document(
    recordings: Sequence[Recording],
    experiments: Sequence[Experiment],
    left_out: Mapping[str, Sequence[str]],
    found: Results,
    *,
    before: Mapping[str, Mapping[str, Any]],
    own: OwnMethods,
    vehicle: Mapping[str, tuple[float, float]],
    horizon: float | None,
    cancelled: bool,
) -> dict[str, Any]:
    """The whole document.

    `left_out`: by method, for each recording, why it is not used, "" if it is. `before`: value, std and unit of the
    estimated parameters in the vehicle file or the model; `own`: methods of the kind of vehicle; `vehicle`: value and
    std of everything in the file. `horizon`: s ahead, of the fits that were measured in the same way; None if there
    are none.
    """
    methods = {
        name: {"domain": METHODS[name].domain.value, **_method(name, recordings, reasons, found)}
        for name, reasons in left_out.items()
    }
    # Every experiment of the service is recorded in closed loop, and so is every unstable vehicle.
    closed_loop = any(each.excitation for each in experiments) or any(
        (entry.get("pole") or 0.0) > 0.0 for entry in methods.values()
    )
    choice = choose(methods, closed_loop=closed_loop)
    best = choice.best
    for name, entry in methods.items():
        entry["unsound"], entry["not_chosen"] = choice.unsound[name], choice.not_chosen[name]
    for entry in methods.values():
        if entry["domain"] == Domain.DRIVES:
            entry["parameters"] |= _derived(own, entry["parameters"], methods.get(best, {}), vehicle)
            entry["inertia_from"] = best
    return {
        "methods": methods,
        "best": best,
        "best_reason": choice.reason,
        "fit_measured_alike": horizon is not None
        and not any(
            entry.get("fit_measured") == OWN and entry["fit_percent"]
            for entry in methods.values()
            if entry["domain"] != Domain.DRIVES
        ),
        "fit_horizon": horizon,
        "before": {name: dict(entry) for name, entry in before.items()},
        "recordings": [
            {"recording": recording.source, "experiment": str(experiment)}
            for recording, experiment in zip(recordings, experiments, strict=True)
        ],
        "cancelled": cancelled,
    }


def _method(name: str, recordings: Sequence[Recording], reasons: Sequence[str], found: Results) -> dict[str, Any]:
    """The joint estimate of one method, its runs and their mean."""
    taken = tuple(place for place, reason in enumerate(reasons) if not reason)
    cancelled = nothing(CANCELLED, "ended before it was finished")
    if not taken:
        return {**nothing(NOT_SUITED, "; ".join(dict.fromkeys(reasons)) or "no recording"), "runs": [], "mean": {}}
    runs = []
    for place, (recording, reason) in enumerate(zip(recordings, reasons, strict=True)):
        entry = nothing(NOT_SUITED, reason) if reason else found.get((name, (place,)), cancelled)
        kept = {key: entry[key] for key in ("parameters", "status", "reason", "seconds")}
        runs.append({"recording": recording.source, **kept})
    return {**found.get((name, taken), cancelled), "runs": runs, "mean": dict(_means(runs))}


def _means(runs: Sequence[Mapping[str, Any]]) -> Iterator[tuple[str, dict[str, Any]]]:
    """By parameter, the mean of the runs that identify it; `std` is their scatter, None for a single run."""
    units = {name: entry["unit"] for run in runs for name, entry in run["parameters"].items()}
    for name, unit in units.items():
        values = [run["parameters"][name]["value"] for run in runs if name in run["parameters"]]
        known = [value for value in values if value is not None]
        if known:
            std = stdev(known) if len(known) > 1 else None
            yield name, {"value": fmean(known), "std": std, "unit": unit, "runs": len(known)}


def _derived(
    own: OwnMethods,
    drives: Mapping[str, Any],
    best: Mapping[str, Any],
    vehicle: Mapping[str, tuple[float, float]],
) -> dict[str, Any]:
    """The parameters that the kind of vehicle derives from those of the drives and of the best method, JSON-ready."""
    of_drives, found = (
        {name: _estimate(entry) for name, entry in each.items()} for each in (drives, best.get("parameters", {}))
    )
    shown: dict[str, Any] = Estimate("", own.derived(of_drives, found, vehicle), Status.OK, "", 0, 0.0).to_json()
    parameters: dict[str, Any] = shown["parameters"]
    return parameters


def _estimate(entry: Mapping[str, Any]) -> ParameterEstimate:
    keys = ("value", "std", "unit", "status", "coverage_percent", "reason")
    value, std, unit, status, coverage, reason = (entry[key] for key in keys)
    return ParameterEstimate(value, std, unit, Status(status), coverage, reason)
