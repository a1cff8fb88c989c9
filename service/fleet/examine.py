"""One recording of a fleet: the diagnosis of `upright diagnose`, as a row of the results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path, PurePosixPath
from time import perf_counter

from upright.diagnosis.findings import Diagnosis
from upright.estimators.methods.prediction_error import own_deviations, result
from upright.models.effect import Effect
from upright.models.model import Model
from upright.service.fleet import results
from upright.service.fleet.results import FAILED, Row
from upright.service.fleet.store import Store, Stored
from upright.service.offline.diagnose import actuators_of, diagnosed, to_be_completed
from upright.service.offline.inputs.can_log import is_can_log
from upright.service.offline.inputs.machine import name_of
from upright.service.offline.inputs.read import read_all
from upright.service.offline.models import Candidates, columns, identified_model
from upright.telemetry.errors import UprightError
from upright.telemetry.recording import Recording
from upright.telemetry.tables.mapping import Said, said_of
from upright.telemetry.tables.times import EPOCH
from upright.vehicles.file import VehicleFile, load

Task = tuple[Stored, Row | None]
"""A recording, and its row from before, made by the same settings of what were perhaps the same bytes."""


@dataclass(frozen=True, slots=True)
class Settings:
    """What is asked of each recording, as of `service.offline.diagnose.diagnosed`; `user` is said of its columns.

    `machine` is what the model is of. `name` and `sha256` are of the model's file; `everything` is a hash of all
    settings.
    """

    vehicle: VehicleFile
    model: Model | None
    candidates: tuple[Effect, ...] | None
    user: Said
    seconds: float | None
    machine: str
    name: str
    sha256: str
    everything: str

    @classmethod
    def of(
        cls,
        vehicle: str,
        model: str | None = None,
        *,
        effects: Sequence[str] = (),
        also: Sequence[str] = (),
        columns_as: Sequence[str] = (),
        assumed: Sequence[str] = (),
        seconds: float | None = None,
    ) -> Settings:
        """From the options of `upright fleet`. Raises UprightError for a name or a file that is invalid."""
        file = load(vehicle)
        chosen = Candidates.of(effects, also)
        user = said_of(columns_as, assumed, columns(model))
        own = Path(model) if model is not None and model.endswith(".toml") else None
        digest = _sha256(own or Path(file.path))
        name = own.name if own else model or file.vehicle.id
        found = None if model is None else identified_model(model, file)
        files = sorted((effect, _sha256(path)) for effect, path in chosen.files.items())
        names = sorted(each.name for each in chosen.effects or ())
        everything = (file.configuration_hash, digest, repr(found), names, files, columns_as, assumed, seconds)
        return cls(
            vehicle=file,
            model=found,
            candidates=chosen.effects,
            user=user,
            seconds=seconds,
            machine=name_of(to_be_completed(found, file), file),
            name=name,
            sha256=digest,
            everything=sha256(repr(everything).encode()).hexdigest(),
        )


def examine(settings: Settings, store: Store, task: Task) -> Row:
    """The row of a recording, with the reason if it cannot be read or diagnosed."""
    stored, before = task
    began, digest, here = perf_counter(), "", stored.name
    try:
        with store.fetched(stored) as (path, digest):
            here = str(path)
            if before is not None and before.sha256 == digest:
                return replace(before, stamp=stored.stamp)
            row = _diagnosed(settings, stored, path)
    except UprightError as error:
        row = failed(settings, task, str(error))
    except Exception as error:  # whatever is wrong with a recording is its result, and not that of the others
        row = failed(settings, task, f"{type(error).__name__}: {error}")
    # The path may be that of a copy.
    reason = row.reason.removeprefix(f"{here}: ").replace(here, stored.name)
    return replace(row, reason=reason, sha256=digest, seconds=perf_counter() - began)


def failed(settings: Settings, task: Task, reason: str) -> Row:
    """The row of a recording without a diagnosis."""
    return replace(_beginning(settings, task[0]), status=FAILED, reason=reason)


def _beginning(settings: Settings, stored: Stored) -> Row:
    return Row(
        recording=stored.name,
        vehicle=_folder(stored.name) or settings.machine,
        model=settings.name,
        model_sha256=settings.sha256,
        version=version("upright"),
        settings=settings.everything,
        stamp=stored.stamp,
    )


def _diagnosed(settings: Settings, stored: Stored, path: Path) -> Row:
    vehicle, model = settings.vehicle, settings.model
    needed = [to_be_completed(model, vehicle), *actuators_of(vehicle, model)]
    recordings = [each for each, _ in read_all(path, vehicle, needed, settings.user)]
    found = diagnosed(recordings, vehicle, model=model, candidates=settings.candidates, seconds=settings.seconds).found
    stated = "" if is_can_log(path) else recordings[0].metadata.get("vehicle", "")
    began, by = _began(recordings[0], stored)
    beginning = _beginning(settings, stored)
    return replace(
        beginning,
        vehicle=stated or beginning.vehicle,
        began=began,
        began_by=by,
        duration=sum(each.duration for each in recordings),
        samples=sum(map(len, recordings)),
        verdict=found.verdict.value,
        reason=found.reason,
        effects=tuple(
            results.Effect(
                each.effect, str(each.family), each.probability, each.p_value, each.negligible, tuple(each.tied_with)
            )
            for each in found.findings
        ),
        parameters=_parameters(found),
        innovation_ratio_before=found.innovation_ratio_before,
        innovation_ratio_after=found.innovation_ratio_after,
    )


def _parameters(found: Diagnosis) -> tuple[results.Parameter, ...]:
    """Those of the model with all findings; those of findings about the actuators are beside it."""
    fit = found.steps[-1].fit if found.steps else None
    estimates = dict(result(fit, 0.0).parameters) if fit else {}
    own = own_deviations(fit) if fit else {}
    for finding in found.findings:
        for name, each in finding.parameters.items():
            whole = name if name.startswith(f"{finding.effect}.") else f"{finding.effect}.{name}"
            estimates.setdefault(whole, each)
    return tuple(
        results.Parameter(name, each.value, each.std, own.get(name, each.std), each.unit, each.reason)
        for name, each in estimates.items()
    )


def _began(recording: Recording, stored: Stored) -> tuple[datetime | None, str]:
    """When a recording began, and who says so."""
    stamp = float(recording.timestamp_ns[0]) * 1e-9
    if EPOCH[0] < stamp < EPOCH[1]:
        return datetime.fromtimestamp(stamp, UTC), "recording"
    return stored.modified, "file" if stored.modified else ""


def _folder(name: str) -> str:
    """The first folder on the path of a recording; "" if there is none."""
    first, *rest = PurePosixPath(name).parts
    return first if rest else ""


def _sha256(path: Path) -> str:
    return sha256(path.read_bytes()).hexdigest()
