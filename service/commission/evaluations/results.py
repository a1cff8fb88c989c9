"""What the command line makes of recordings: identification, design, comparison, diagnosis, effects.

Each runs the same command that a person would, and keeps the document and the page that it writes.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from math import degrees, inf, isfinite, log10, sqrt
from pathlib import Path
from typing import Any

from upright.estimators.identify.table import Domain
from upright.service.commission.evidence import Evidence, Found
from upright.service.offline.model_files import actuators_beside
from upright.service.whole_file import write_whole
from upright.vehicles.commissioning import CommissioningError, Number

UNHURRIED = ("--budget", "inf")
"""Of a diagnosis: what it names decides about the controller, so that a slow computer takes longer, not less."""


def identified(evidence: Evidence) -> Found:
    """Every method side by side on the recordings; the numbers are those of the recommended one, each parameter with
    its deviation from the vehicle file in standard deviations of the difference (`NAME_off`)."""
    page, picture = evidence.at(".html"), evidence.at(".png")
    document = evidence.upright(
        [
            "identify",
            *_recordings(evidence),
            *_begin(evidence),
            *_model(evidence),
            "--report",
            str(page),
            "--picture",
            str(picture),
        ]
    )
    result = _kept(evidence, document)
    best = document["best"]
    if not best:
        return Found(text=[document["best_reason"]], files=[result, page, picture], result=result)
    parameters = evidence.vehicle.parameters
    numbers: dict[str, Number] = {}
    for name, each in document["methods"][best]["parameters"].items():
        numbers[name] = Number(value=each["value"], std=each["std"], unit=each["unit"])
        if name in parameters.values and None not in (each["value"], each["std"]):
            spread = sqrt(each["std"] ** 2 + parameters.deviations[name] ** 2)
            off = (each["value"] - parameters.values[name]) / spread if spread else None
            numbers[f"{name}_off"] = Number(value=off)
    return Found(numbers, [f"{best}: {document['best_reason']}"], [result, page, picture], result)


def designed(evidence: Evidence) -> Found:
    """The controllers for the newest result, which act from the next experiment on. Parameters of drives are those of
    the result that knows them best."""
    merged = evidence.at("_result.json")
    documents = [json.loads(path.read_text("utf-8")) for path in evidence.results.values()]
    write_whole(merged, json.dumps(with_best_drives(documents), indent=1))
    document = evidence.upright(["design", str(merged), *_model(evidence), "--use"])
    result = _kept(evidence, document)
    numbers: dict[str, Number] = {}
    for name, each in document["controllers"].items():
        down, up = each["gain_margin"]
        numbers |= {
            f"{name}_gain_margin": Number(value=20.0 * log10(up), unit="dB"),
            f"{name}_gain_reduction_margin": Number(value=-20.0 * log10(down) if down > 0.0 else None, unit="dB"),
            f"{name}_phase_margin": Number(value=degrees(each["phase_margin"]), unit="deg"),
            f"{name}_delay_margin": Number(value=1e3 * each["delay_margin"], unit="ms"),
        }
    close = [f"{each['name']}: {each['broken']}" for each in document["expected"] if each["broken"] and each["largest"]]
    numbers["too_close"] = Number(value=float(len(close)))
    return Found(numbers, [document["how"], *close], [merged, result], result)


def with_best_drives(documents: list[dict[str, Any]]) -> dict[str, Any]:
    """The last of several documents of `identify --json`, where each method of drives is that of the document in which
    its parameters have the smallest deviations. Raises CommissioningError if there is none."""
    if not documents:
        raise CommissioningError("no result of an identification.", remedy="Carry out the steps before this one.")
    last = documents[-1]
    methods = dict(last["methods"])
    for document in documents[:-1]:
        for name, found in document["methods"].items():
            if found["domain"] == Domain.DRIVES and _spread(found) < _spread(methods.get(name)):
                methods[name] = found
    return {**last, "methods": methods}


def _spread(found: Mapping[str, Any] | None) -> float:
    """The relative deviation of a method's first parameter, its lag; infinite if it is not known."""
    first = next(iter((found or {}).get("parameters", {}).values()), None)
    if first is None or not first["value"] or first["std"] is None:
        return inf
    return abs(float(first["std"]) / float(first["value"]))


def compared(evidence: Evidence) -> Found:
    """The model against its recordings: the error over that of the noise, one step ahead (`innovation_ratio`) and in
    the closed loop with its controller (`loop_error`, that of the channel that is predicted worst; `gain_off` and
    `phase_off`, by how much the loop's first channel responds otherwise, in the octave where it differs most)."""
    page = evidence.at(".html")
    model = _model(evidence) or (["--model", str(evidence.result)] if evidence.results else [])
    document = evidence.upright(["compare", *_recordings(evidence), *model, "--report", str(page)])
    result = _kept(evidence, document)
    name = evidence.model.stem if evidence.model is not None else _best(evidence)
    subjects = [each for each in document["models"] if each["name"] == name] or document["models"]
    loops = [each["closed_loop"] for each in subjects if each.get("closed_loop", {}).get("available")]
    errors = [float(value) for each in loops for value in each["over_floor"].values()]
    bands = [band for each in loops for band in next(iter(each["response"].values()), [])]
    ratios = [float(each["innovation_ratio"]) for each in subjects if each.get("innovation_ratio") is not None]
    numbers = {
        "innovation_ratio": Number(value=max(ratios, default=None)),
        "loop_error": Number(value=max((each for each in errors if isfinite(each)), default=None)),
        "gain_off": Number(value=max((abs(20.0 * log10(each["gain"])) for each in bands), default=None), unit="dB"),
        "phase_off": Number(value=max((abs(each["phase_deg"]) for each in bands), default=None), unit="deg"),
        "not_adequate": Number(value=float(sum(not each["adequate"] for each in subjects))),
    }
    text = [line for each in subjects for line in each["summary"]]
    text += [line for each in loops for line in _responses(each["response"])]
    text += [each["closed_loop"]["reason"] for each in subjects if each.get("closed_loop", {}).get("reason")]
    return Found(numbers, text, [result, page], result)


def _responses(response: Mapping[str, Any]) -> list[str]:
    """Gain and phase of the measured over the simulated closed loop, a line for each channel."""
    return [
        f"{channel}, measured over simulated: {'; '.join(map(_octave, bands))}"
        for channel, bands in response.items()
        if bands
    ]


def _octave(band: Mapping[str, float]) -> str:
    gain = 20.0 * log10(band["gain"])
    return f"{band['from']:.2g} to {band['to']:.2g} Hz {gain:+.2f} dB, {band['phase_deg']:+.1f} deg"


def diagnosed(evidence: Evidence) -> Found:
    """Which physical effects the model lacks; nothing is added."""
    page = evidence.at(".html")
    document = evidence.upright(
        ["diagnose", *_recordings(evidence), *_begin(evidence), *_model(evidence), *UNHURRIED, "--report", str(page)]
    )
    return _diagnosis(evidence, document, [page])


def effects(evidence: Evidence) -> Found:
    """Adds the effects that the recordings show, one after the other, to the model of this commissioning."""
    page, model = evidence.at(".html"), evidence.at(".toml")
    document = evidence.upright(
        ["diagnose", *_recordings(evidence), *_begin(evidence), *UNHURRIED, "--auto", str(model), "--report", str(page)]
    )
    return _diagnosis(evidence, document, [page], model if model.is_file() else None)


def _diagnosis(
    evidence: Evidence, document: Mapping[str, Any], written: list[Path], model: Path | None = None
) -> Found:
    result = _kept(evidence, document)
    names = [str(each["effect"]) for each in document["findings"]]
    numbers = {
        "effects_found": Number(value=float(len(names))),
        "innovation_ratio": Number(
            value=document.get("innovation_ratio_after") or document.get("innovation_ratio_before")
        ),
        "unexplained": Number(value=float(document["verdict"] in ("unknown", "insufficient_data"))),
    }
    text = [str(each["explanation"]) for each in document["findings"]]
    verdict = document["reason"] or str(document["verdict"]).replace("_", " ")
    beside = [] if model is None else [model, actuators_beside(model)]
    files = [result, *written, *(path for path in beside if path.is_file())]
    return Found(numbers, text or [verdict], files, result if model is None else None, model)


def _recordings(evidence: Evidence) -> list[str]:
    return [str(evidence.recording), *(str(each) for each in evidence.recordings[1:])]


def _model(evidence: Evidence) -> list[str]:
    return ["--model", str(evidence.model)] if evidence.model is not None else []


def _begin(evidence: Evidence) -> list[str]:
    from upright.vehicles import registry

    begin = registry.of(evidence.vehicle.vehicle.kind).views.story.begin
    return ["--from", f"{begin:g}"] if begin else []


def _best(evidence: Evidence) -> str | None:
    """The recommended method of the newest result, whose model has its name; None if there is none."""
    if not evidence.results:
        return None
    best: str | None = json.loads(evidence.result.read_text("utf-8")).get("best")
    return best


def _kept(evidence: Evidence, document: Mapping[str, Any]) -> Path:
    path = evidence.at(".json")
    write_whole(path, json.dumps(document, indent=1))
    return path
