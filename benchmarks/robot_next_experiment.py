"""Does the experiment suggested for the balancing robot separate two effects as well as predicted?
`python benchmarks/robot_next_experiment.py`

A first recording of the virtual robot with a hidden effect leaves two candidates. Both are fitted to it, as by `upright
experiment --separate`, and the experiment of the vehicle file that separates them in the shortest time is chosen by
prediction. It is then recorded with another seed, and both candidates are fitted to it. The program prints the log odds
(nats) for the one that explains it better: in the first recording, as predicted for the experiment, and as measured.

A short and small doublet leaves dry and viscous friction tied. A square wave separates them, so that a prediction for
another one can be compared with the measurement. A centre of mass beside the axle and a misaligned IMU are nearly the
same for the controller.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

from upright.diagnosis.fits.refit import full
from upright.diagnosis.next_experiment import Choice, suggest
from upright.diagnosis.prepare.workspace import Workspace
from upright.diagnosis.rivals import Rival, fitted_rivals
from upright.estimators.identify.run import with_values
from upright.models.model import Model
from upright.service.offline.next_experiment import experiments_of
from upright.service.virtual.run import record
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("twsbr")
EXCITED = 6.8
"""Time at which the excitation has begun and the models have settled, s from the start of a recording."""
REPEATED = 8.0
"""Time from which on the recording of a suggested experiment is used, s."""


@dataclass(frozen=True, slots=True)
class Case:
    """`hide` as for `upright simulate`. The first recording is `seconds` from EXCITED on of `experiment`, with another
    `amplitude` if one is given."""

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
    """The model with the vehicle file's parameters, which are up to 40 % off."""
    return with_values(nominal_model("twsbr"), VEHICLE.parameters.values, VEHICLE.parameters.deviations)


def first_recording(case: Case, seed: int) -> Recording:
    """The recording that does not separate the case's rivals, or not sufficiently."""
    changes = {} if case.amplitude is None else {"amplitude": case.amplitude}
    section = VEHICLE.experiments[case.experiment].model_copy(update=changes)
    vehicle = VEHICLE.model_copy(update={"experiments": {case.experiment: section}})
    recorded = record(vehicle, case.experiment, hide=[case.hide], seed=seed, duration=max(4.0, case.seconds))
    return recorded.between(EXCITED, EXCITED + case.seconds)


def log_odds(rivals: Sequence[Rival], recording: Recording) -> float:
    """Log-likelihood ratio of the first of two rivals to the second in a recording, nats."""
    effects = tuple(dict.fromkeys(rival.name.split("@")[0] for rival in rivals))
    workspace = Workspace.of(model(), [recording], VEHICLE.support, effects)
    one, other = (full(rival.model, workspace).log_likelihood for rival in rivals)
    return one - other


def result(case: Case, seed: int) -> str:
    """The result of a case, one line."""
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
    return f"{there}; suggested {what}: predicted {predicted:.1f}, measured {measured:.1f} per run"


def _most(choice: Choice, rivals: Sequence[Rival]) -> str:
    """The log odds expected of the best experiment, or why all experiments are refused."""
    (pair,) = combinations((rival.name for rival in rivals), 2)
    safe = [each for each in choice.outlooks if not each.refused]
    if not safe:
        return "; ".join(f"{each.experiment.name}: {each.refused}" for each in choice.outlooks)
    best = max(safe, key=lambda each: each.rates[pair])
    nats = best.rates[pair] * best.experiment.duration
    return f"{best.experiment.duration:g} s of {best.experiment.name}, the best, would give {nats:.2g} nats"


def main() -> None:
    """Print one line for each case and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=3, help="seed of the first recording of each case (3)")
    parser.add_argument("--runs", type=int, default=1, help="runs of each case, with every other seed (1)")
    parser.add_argument("--case", choices=list(CASES), help="only this one")
    arguments = parser.parse_args()
    for name in [arguments.case] if arguments.case else CASES:
        for seed in range(arguments.first, arguments.first + 2 * arguments.runs, 2):
            print(f"{name}, seed {seed}: {result(CASES[name], seed)}", flush=True)


if __name__ == "__main__":
    main()
