"""How long does a diagnosis take? `python benchmarks/diagnosing.py`

A minute of sine sweep of the virtual vehicle at 200 Hz with viscous friction hidden in it is diagnosed with the whole
catalogue, after compilation. The program prints the wall clock and CPU seconds of

    first answer       data read and checked, the model fitted, score test of every effect: amplitudes and p-values
    diagnosis          all of it: quick and full fits, held-out data, the remaining error
    exhaustive search  what an expert would script: an output-error fit with each effect, ranked by BIC

and the ratio of the last to the first two in wall clock time. Required on two cores: a first answer within 1 s, the
diagnosis within 10 s.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

from upright.diagnosis.diagnose import diagnose
from upright.diagnosis.fits.refit import settled
from upright.diagnosis.prepare.usable import check
from upright.diagnosis.prepare.workspace import Workspace, attached
from upright.diagnosis.score.score_test import score_test
from upright.diagnosis.score.whitened import Whitened
from upright.estimators.identify.run import with_values
from upright.service.hidden_effects.methods.exhaustive import exhaustive_bic
from upright.service.virtual.run import record
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)


RATE = 200
"""Hz."""
FREE = 8.0
"""s from the start until the vehicle is off its support and excited."""


def minute(experiment: str = "sweep", hide: Sequence[str] = ("viscous_friction",), seed: int = 1) -> Recording:
    """A recording of 60 s of free motion."""
    slower = VEHICLE.model_copy(update={"control": VEHICLE.control.model_copy(update={"rate": RATE})})
    return record(slower, experiment, hide=list(hide), seed=seed, duration=60.0).between(FREE, FREE + 60.0)


def main() -> None:
    recording = minute()
    print(f"{recording.duration:.0f} s of sweep, {len(recording)} samples, {recording.rate:.0f} Hz")

    def first_answer() -> str:
        check(MODEL, [recording], VEHICLE.support)
        workspace = Workspace.of(MODEL, [recording], VEHICLE.support)
        base = settled(MODEL, workspace)
        found = score_test(
            Whitened.of(base.fit), lambda group: workspace.problem(attached(MODEL, group)), workspace.candidates
        )
        return f"{found.scores[0].candidate.name}, of {len(found.scores)} effects"

    def whole() -> str:
        found = diagnose(MODEL, [recording], support=VEHICLE.support)
        return f"{found.verdict}: {', '.join(each.effect for each in found.findings)}"

    first_answer(), whole()  # compiles the code
    seconds = {}
    for name, work in (("first answer", first_answer), ("diagnosis", whole), ("exhaustive search", _search(recording))):
        seconds[name] = _timed(name, work)
    for name in ("first answer", "diagnosis"):
        print(f"exhaustive search / {name}: {seconds['exhaustive search'] / seconds[name]:.0f}")


def _search(recording: Any) -> Callable[[], str]:
    def search() -> str:
        found = exhaustive_bic(MODEL, [recording], VEHICLE.support)
        return ", ".join(each.effect for each in found.found[:3])

    return search


def _timed(name: str, work: Callable[[], str]) -> float:
    wall, cpu = time.perf_counter(), time.process_time()
    result = work()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(f"{name:18s} {wall:6.2f} s wall, {cpu:6.2f} s CPU   {result}")
    return wall


if __name__ == "__main__":
    main()
