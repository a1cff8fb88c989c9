"""How often is an effect found if nothing is missing? `python benchmarks/false_alarms.py --runs 60`

The score test of the whole catalogue is applied to clean recordings of virtual vehicles. Each has its own sensor noise
and is disturbed by a random torque; the MONOCAB's parameters are drawn within the uncertainty of its vehicle file. The
smallest p-value of a recording is corrected for the number of effects: if nothing is missing it is uniform, below 0.01
once in a hundred recordings. The program prints how often it is below some levels, with the 95 % interval (Wilson).
With `--named` it runs the whole diagnosis of each recording instead, and prints how many get a name and how many are
rejected for insufficient data: effects that pass the score test have to hold on held-out data as well. That takes ten
times as long. `--disturbance` is that of `upright benchmark hidden-effects`: RMS,CORRELATION_TIME in multiples of the
sensor floor and s, or none; if it is not given, it is drawn for each recording.
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from scipy.stats import binomtest

from upright.diagnosis.diagnose import Verdict, diagnose
from upright.diagnosis.prepare.workspace import Workspace, attached
from upright.diagnosis.score.score_test import score_test
from upright.diagnosis.score.whitened import Whitened
from upright.estimators.data.segments import after_settling
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.identify.run import with_values
from upright.models.model import Model
from upright.service.hidden_effects.disturbances import Disturbances, drawn_for, parse_disturbances, sensor_floor
from upright.service.hidden_effects.vehicles import drawn
from upright.service.virtual.run import record
from upright.simulation.config import ImuNode, Truth
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

LEVELS = (0.01, 0.05, 0.2, 0.5)
EXPERIMENTS = {"monocab": "multisine", "twsbr": "square"}
"""The experiment of each vehicle if `--experiment` is not given."""


def bare(name: str) -> Model:
    """The vehicle's own equations, with its CAD values."""
    vehicle, model = load(name), nominal_model(name)
    for each in model.effects:
        model = model.remove(each.name)
    return with_values(model, vehicle.parameters.values, vehicle.parameters.deviations)


def clean(name: str, experiment: str, disturbances: Disturbances | None, seed: int) -> Recording:
    """A recording with nothing missing: of the MONOCAB drawn with this seed, or of another vehicle as it is."""
    if name != "monocab":
        return record(
            name, experiment, hide=hidden_disturbance(disturbances, registry.of(name).twin().truth, seed), seed=seed
        )
    vehicle = drawn(seed)
    hide = hidden_disturbance(disturbances, vehicle.plant, seed)
    return record(vehicle.file, experiment, hide=hide, seed=seed, configure=vehicle.configured)


def hidden_disturbance(disturbances: Disturbances | None, truth: Truth, seed: int) -> list[str]:
    """The values of `--hide` for the disturbance of this seed."""
    if disturbances is None:
        return []
    found = disturbances.of(seed, partial(sensor_floor, truth, ImuNode()))
    return [f"disturbance={found.rms:.6g},{found.correlation_time:.6g}"]


def smallest(name: str, experiment: str, disturbances: Disturbances | None, seed: int) -> tuple[float, str]:
    """The smallest p-value of one clean recording, and the effect that has it."""
    model, support = bare(name), load(name).support
    recording = clean(name, experiment, disturbances, seed)
    workspace = Workspace.of(model, after_settling(model, [recording], support), support)
    innovations = Whitened.of(fit(workspace.problem(model)))
    found = score_test(innovations, lambda group: workspace.problem(attached(model, group)), workspace.candidates)
    return found.scores[0].p_value, found.scores[0].candidate.name


def named(name: str, experiment: str, disturbances: Disturbances | None, seed: int) -> str:
    """The effects that the diagnosis of one clean recording names, or its verdict; empty if it is adequate."""
    recording = clean(name, experiment, disturbances, seed)
    found = diagnose(bare(name), [recording], support=load(name).support)
    names = " and ".join(each.effect for each in found.findings)
    return "" if found.verdict is Verdict.ADEQUATE else names or found.verdict.value


def print_named(experiment: str, found: dict[int, str]) -> None:
    """Print how many of the recordings (by seed) have a name, are unknown, or were rejected for insufficient data."""
    refused = sum(names == Verdict.INSUFFICIENT_DATA for names in found.values())
    wrong = {seed: names for seed, names in found.items() if names and names != Verdict.INSUFFICIENT_DATA}
    line = f"{experiment}: {len(found)} recordings, rejected {refused}"
    if refused < len(found):
        line += f", of the others not adequate {share(len(wrong), len(found) - refused)}"
    print(line, flush=True)
    for seed, names in wrong.items():
        print(f"  seed {seed}: {names}")


def share(count: int, of: int) -> str:
    """The share in percent, with its interval."""
    interval = binomtest(count, of).proportion_ci(0.95, method="wilson")
    return f"{100.0 * count / of:5.1f} %  ({100.0 * interval.low:.1f} to {100.0 * interval.high:.1f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--vehicle", choices=list(EXPERIMENTS), default="monocab", help="monocab by default")
    parser.add_argument("--runs", type=int, default=60, help="seeds FIRST to FIRST + RUNS - 1")
    parser.add_argument("--first", type=int, default=0, help="the first seed; 0 by default")
    parser.add_argument("--named", action="store_true", help="run the whole diagnosis, and count named effects")
    parser.add_argument(
        "--experiment", action="append", help="may be given several times; default: multisine or square"
    )
    parser.add_argument(
        "--disturbance", help="random torque: RMS,CORRELATION_TIME in sensor floors and s, or none; drawn by default"
    )
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    try:
        disturbances = parse_disturbances(arguments.disturbance, drawn_for(arguments.vehicle))
    except ValueError as error:
        parser.error(f"--disturbance: {error}")
    print(disturbances.conditions if disturbances else "no disturbance", flush=True)
    seeds = range(arguments.first, arguments.first + arguments.runs)
    for experiment in arguments.experiment or [EXPERIMENTS[arguments.vehicle]]:
        with ProcessPoolExecutor(arguments.processes) as pool:
            if arguments.named:
                names = pool.map(partial(named, arguments.vehicle, experiment, disturbances), seeds)
                print_named(experiment, dict(zip(seeds, names, strict=True)))
                continue
            found = list(pool.map(partial(smallest, arguments.vehicle, experiment, disturbances), seeds))
        print(f"{experiment}: {len(found)} recordings")
        for level in LEVELS:
            print(f"  p < {level:<5g} in {share(sum(p_value < level for p_value, _ in found), len(found))}")
        for seed, (p_value, name) in zip(seeds, found, strict=True):
            if p_value < LEVELS[0]:
                print(f"  seed {seed}: {name}, p = {p_value:.2g}")


if __name__ == "__main__":
    main()
