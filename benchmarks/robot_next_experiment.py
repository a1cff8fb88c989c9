"""Does the experiment that is suggested for the balancing robot tell apart as much as was predicted?
`python benchmarks/robot_next_experiment.py`

A first recording of the virtual robot with an effect hidden in it leaves two candidates in question. Both are fitted to
it, as `upright experiment --separate` does, and the experiment of the vehicle file that tells them apart soonest is
predicted. It is then recorded with another seed, and both candidates are fitted to it. Told are the log odds (nats) for
the one that explains it better: of the first recording, as predicted for the experiment, and as measured.

A doublet that is short and small leaves dry and viscous friction tied; a square wave tells them apart, so that a
prediction for another one can be held against it. A centre of mass beside the axle and an IMU at a slant are nearly the
same to the controller.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from diagnosis.fits.refit import full
from diagnosis.next_experiment import Choice, suggest
from diagnosis.prepare.workspace import Workspace
from diagnosis.rivals import Rival, fitted_rivals
from estimators.identify.run import with_values
from models.model import Model
from service.offline.next_experiment import experiments_of
from service.virtual.run import record
from telemetry.recording import Recording
from vehicles.file import load
from vehicles.registry import nominal_model

VEHICLE = load("twsbr")
EXCITED = 6.8
"""s of a recording at which the excitation has begun and the models have settled."""
REPEATED = 8.0
"""s at which the recording of a suggested experiment is taken up."""


@dataclass(frozen=True, slots=True)
class Case:
    """`hide` as for `upright simulate`; `seconds` of the first recording from EXCITED on, of an experiment with another
    `amplitude` where one is given."""

    hide: str
    rivals: tuple[str, str]
    experiment: str
    seconds: float
    amplitude: float | None = None


FRICTIONS = ("coulomb_friction@wheels", "viscous_friction@wheels")
CASES = {
    "dry or viscous, after a short doublet": Case("coulomb_friction=0.2", FRICTIONS, "doublet", 1.6, 2.0),
    "dry or viscous, after a square wave": Case("coulomb_friction", FRICTIONS, "square", 20.0),
    "dry or asymmetric, after a square wave": Case(
        "coulomb_friction", ("coulomb_friction@wheels", "asymmetric_friction@wheels"), "square", 20.0
    ),
    "centre of mass or slanted IMU": Case("static_torque", ("static_torque", "sensor_offset"), "square", 20.0),
}


def model() -> Model:
    """With the vehicle file's numbers, which are up to 40 % off."""
    return with_values(nominal_model("twsbr"), VEHICLE.parameters.values, VEHICLE.parameters.deviations)


def first_recording(case: Case, seed: int) -> Recording:
    """What leaves the case's rivals in question."""
    changes = {} if case.amplitude is None else {"amplitude": case.amplitude}
    section = VEHICLE.experiments[case.experiment].model_copy(update=changes)
    vehicle = VEHICLE.model_copy(update={"experiments": {case.experiment: section}})
    recorded = record(vehicle, case.experiment, hide=[case.hide], seed=seed, duration=max(4.0, case.seconds))
    return recorded.between(EXCITED, EXCITED + case.seconds)


def log_odds(rivals: Sequence[Rival], recording: Recording) -> float:
    """nats for the first of two rivals against the second in a recording."""
    effects = tuple(dict.fromkeys(rival.name.split("@")[0] for rival in rivals))
    workspace = Workspace.of(model(), [recording], VEHICLE.support, effects)
    one, other = (full(rival.model, workspace).log_likelihood for rival in rivals)
    return one - other


def told(case: Case, seed: int) -> str:
    """One line."""
    first = first_recording(case, seed)
    rivals = fitted_rivals(model(), [first], VEHICLE.support, case.rivals)
    if len(rivals) < 2:
        return "one of the two cannot be fitted"
    there = f"first {log_odds(rivals, first):.1f} nats"
    choice = suggest(rivals, experiments_of(VEHICLE)[0])
    if choice.best is None:
        return f"{there}, nothing suggested ({_most(choice, rivals)})"
    best = choice.best
    predicted = best.rate * best.experiment.duration
    run = record("twsbr", best.experiment.name, hide=[case.hide], seed=seed + 1, duration=best.experiment.duration)
    measured = log_odds(rivals, run.between(REPEATED, float("inf")))
    what = f"{best.experiment.duration:g} s of {best.experiment.name}, {best.runs} x"
    return f"{there}; suggested {what}: predicted {predicted:.1f}, measured {measured:.1f} a run"


def _most(choice: Choice, rivals: Sequence[Rival]) -> str:
    """What the best experiment would tell of them."""
    (pair,) = combinations((rival.name for rival in rivals), 2)
    safe = [each for each in choice.outlooks if not each.refused]
    if not safe:
        return "; ".join(f"{each.experiment.name}: {each.refused}" for each in choice.outlooks)
    best = max(safe, key=lambda each: each.rates[pair])
    nats = best.rates[pair] * best.experiment.duration
    return f"{best.experiment.duration:g} s of {best.experiment.name}, the best, would come to {nats:.2g} nats"


def main() -> None:
    """One line for each case and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=3, help="seed of the first recording of each case (3)")
    parser.add_argument("--runs", type=int, default=1, help="seeds of each case, two apart (1)")
    parser.add_argument("--case", choices=list(CASES), help="only this one")
    arguments = parser.parse_args()
    for name in [arguments.case] if arguments.case else CASES:
        for seed in range(arguments.first, arguments.first + 2 * arguments.runs, 2):
            print(f"{name}, seed {seed}: {told(CASES[name], seed)}", flush=True)


if __name__ == "__main__":
    main()
