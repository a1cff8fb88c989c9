"""How often is an effect found where nothing is missing? `python benchmarks/false_alarms.py --runs 60`

Clean recordings of the virtual vehicle, each with other sensor noise, are screened for the whole catalogue. The
smallest p-value of a recording knows that all effects were looked at: where nothing is missing it is uniform, below
0.01 once in a hundred recordings. Told is how often it is below some levels, with the 95 % interval (Wilson).
"""

from __future__ import annotations

import argparse
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from scipy.stats import binomtest

from diagnosis.screen import screen
from diagnosis.whitened import Whitened
from diagnosis.workspace import Workspace, attached
from estimators.identify import nominal_model, with_values
from estimators.methods.prediction_error import fit
from service.vehicle_file import load
from service.virtual_run import record

LEVELS = (0.01, 0.05, 0.2, 0.5)


def smallest(experiment: str, seed: int) -> tuple[float, str]:
    """The smallest p-value of one clean recording, and the effect that has it."""
    vehicle = load("monocab")
    bare = nominal_model("monocab").remove("static_torque")
    model = with_values(bare, vehicle.parameters.values, vehicle.parameters.deviations)
    workspace = Workspace.of(model, [record("monocab", experiment, seed=seed)], vehicle.support)
    innovations = Whitened.of(fit(workspace.problem(model)))
    found = screen(innovations, lambda group: workspace.problem(attached(model, group)), workspace.candidates)
    return found.scores[0].p_value, found.scores[0].candidate.name


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--runs", type=int, default=60, help="seeds 0 to RUNS - 1")
    parser.add_argument("--experiment", action="append", help="may be given several times; multisine by default")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    for experiment in arguments.experiment or ["multisine"]:
        with ProcessPoolExecutor(arguments.processes) as pool:
            found = list(pool.map(partial(smallest, experiment), range(arguments.runs)))
        print(f"{experiment}: {len(found)} recordings")
        for level in LEVELS:
            below = sum(p_value < level for p_value, _ in found)
            interval = binomtest(below, len(found)).proportion_ci(0.95, method="wilson")
            low, high = 100.0 * interval.low, 100.0 * interval.high
            print(f"  p < {level:<5g} in {100.0 * below / len(found):5.1f} %  ({low:.1f} to {high:.1f})")
        for seed, (p_value, name) in enumerate(found):
            if p_value < LEVELS[0]:
                print(f"  seed {seed}: {name}, p = {p_value:.2g}")


if __name__ == "__main__":
    main()
