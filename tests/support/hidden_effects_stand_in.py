"""Stand-ins for the slow parts of the benchmark of hidden effects, importable by worker processes.

A "recording" carries in its metadata what is hidden in it, so that a stand-in for the diagnosis can read the answer.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from upright.models.effect import Effect
from upright.models.model import Model
from upright.service.hidden_effects.cases import Grid
from upright.service.hidden_effects.methods.answers import ADEQUATE, UNKNOWN, Answer
from upright.service.hidden_effects.trial import SUBJECT, Bench
from upright.service.hidden_effects.vehicles import Vehicle
from upright.simulation.monocab.hidden import HIDDEN, UNLISTED
from upright.simulation.physics.disturbance import Disturbance
from upright.telemetry.recording import Recording
from upright.vehicles.registry import channels_of

FOLDER = "UPRIGHT_TEST_FOLDER"
"""Folder in which the stand-ins write one file per call, so that a test can count calls in other processes."""
CATALOGUE_ONLY = frozenset(HIDDEN)
SMALL = Grid(
    effects=("static_torque", "coulomb_friction", "test_cubic_drag"),
    sizes=(2.0,),
    excitations=("multisine",),
    seeds=1,
)
"""Five cases: no effect, each effect alone, and the two listed effects together."""


def labelled(
    excitation: str,
    hidden: Mapping[str, float],
    noise: float,
    duration: float,
    seed: int,
    vehicle: Vehicle,
    disturbance: Disturbance | None = None,
) -> Recording:
    """A record without data, with the hidden effects in its metadata."""
    channels = channels_of("monocab")
    metadata = {
        "hidden": json.dumps(dict(hidden)),
        "seed": str(seed),
        "latency": repr(vehicle.latency),
        "disturbance": str(disturbance),
    }
    return Recording(
        channels=channels,
        timestamp_ns=np.arange(2, dtype=np.int64),
        values={name: np.zeros(2) for name in channels.names},
        metadata=metadata,
        source=excitation,
    )


def all_knowing(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """Names the hidden effects; unknown if one is not in the catalogue."""
    hidden = json.loads(recordings[0].metadata["hidden"])
    _record_call(recordings[0])
    detectable = {name: abs(effect.size) for name, effect in {**HIDDEN, **UNLISTED}.items()}
    if set(hidden) - CATALOGUE_ONLY:
        return Answer(UNKNOWN, detectable=detectable)
    answer = Answer.naming(*hidden)
    return Answer(answer.verdict, answer.found, detectable=detectable)


def blind(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """Never finds an effect."""
    return Answer(ADEQUATE)


def killed_once(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """All-knowing, but its process is killed the first time that it gets dry friction."""
    hidden = json.loads(recordings[0].metadata["hidden"])
    mark = Path(os.environ[FOLDER]) / "killed"
    if list(hidden) == ["coulomb_friction"] and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return all_knowing(model, recordings, support, candidates)


def always_killed(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """All-knowing, but dry friction kills its process every time."""
    if list(json.loads(recordings[0].metadata["hidden"])) == ["coulomb_friction"]:
        _record_call(recordings[0], "killed")
        os.kill(os.getpid(), signal.SIGKILL)
    return all_knowing(model, recordings, support, candidates)


def patient(
    model: Model,
    recordings: Sequence[Recording],
    support: float,
    candidates: Sequence[str | Effect] | None = None,
) -> Answer:
    """All-knowing, but takes a minute for every record with a hidden effect."""
    answer = all_knowing(model, recordings, support, candidates)
    if answer.verdict != ADEQUATE:
        time.sleep(60.0)
    return answer


def bench(method: object = all_knowing, **others: object) -> Bench:
    """The benchmark with stand-ins only."""
    return Bench(methods={SUBJECT: method, **others}, record=labelled)  # type: ignore[arg-type, dict-item]


def traces(kind: str = "asked") -> list[str]:
    """The hidden effects of all calls, in all processes."""
    return sorted(path.read_text() for path in Path(os.environ[FOLDER]).glob(f"{kind}-*"))


def _record_call(recording: Recording, kind: str = "asked") -> None:
    if FOLDER in os.environ:
        path = Path(os.environ[FOLDER]) / f"{kind}-{os.getpid()}-{time.monotonic_ns()}"
        path.write_text(recording.metadata["hidden"])
