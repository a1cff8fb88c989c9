"""How true are the balancing robot's estimates, and their +-? `python benchmarks/robot_estimates.py --runs 20`

The virtual robot is recorded with the paper's square wave, and what a record near upright can tell (combinations of
parameters, `vehicles.twsbr.model.TOLD_NEAR_UPRIGHT`) is estimated from the vehicle file's numbers, which are up to 40 %
off. Told are, of each combination, the scatter of estimate over truth, the deviations that it is off by (RMS: 1 where a
+- is right), and how often the 95 % interval holds the truth; then by how much the recursive estimator is off at the
end of the run (RMS). Six combinations of one record are not independent: the last line's interval (Wilson) counts
records.

With `--validate` the sine, the doublet and the sine stream of the first seed are predicted 0.1 s ahead with the
estimates, beside the vehicle file's numbers and the true ones, which are what the noise allows.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

import numpy as np
from scipy.stats import binomtest

from estimators.fit.maximum_likelihood import fit
from estimators.fit.problem import problem
from estimators.identify.combinations import combinations
from estimators.identify.run import with_values
from estimators.identify.validation import on_others
from estimators.methods.prediction_error import predicted_percent
from estimators.recursive.prediction_error import RecursivePredictionError
from models.expressions import number
from service.virtual.run import record
from simulation.twsbr.truth import TwsbrTruth
from vehicles.file import load
from vehicles.registry import nominal_model
from vehicles.twsbr.channels import CHANNELS as TWSBR
from vehicles.twsbr.model import TOLD_NEAR_UPRIGHT

VEHICLE = load("twsbr")
GIVEN = VEHICLE.parameters
MODEL = with_values(nominal_model("twsbr"), GIVEN.values, GIVEN.deviations)
TRUTH = {**MODEL.values, **TwsbrTruth().table_1}
HORIZON = 0.1
"""s ahead: an error of the tilt doubles in that time."""
OTHERS = ("sine", "doublet", "sine_stream")
TWO_SIDED = 1.96
"""Deviations on either side that hold 95 %."""


def true(name: str) -> float:
    return number(TOLD_NEAR_UPRIGHT[name], TRUTH, name)


def of_recording(seed: int) -> dict[str, tuple[float, float]]:
    """Estimate over truth, and its deviation, of each combination."""
    fitted = fit(problem(MODEL, [record("twsbr", "square", seed=seed)], support=VEHICLE.support))
    found = combinations(fitted, TOLD_NEAR_UPRIGHT)
    return {name: (value / true(name), std / abs(true(name))) for name, (value, std) in found.items()}


def while_it_runs(seed: int) -> dict[str, float]:
    """Estimate over truth of each combination when the run is over."""
    live = RecursivePredictionError(
        nominal_model("twsbr"),
        parameters=GIVEN.values,
        deviations=GIVEN.deviations,
        support=VEHICLE.support,
        channels=TWSBR,
    )
    for frame in record("twsbr", "square", seed=seed).frames(TWSBR):
        live.update(frame)
    values = {**MODEL.values, **live.result().values}
    return {name: number(text, values, name) / true(name) for name, text in TOLD_NEAR_UPRIGHT.items()}


def validated(seed: int) -> None:
    """Prints what share of each channel's motion is predicted on experiments that were not fitted."""
    square = record("twsbr", "square", seed=seed)
    estimated = fit(problem(MODEL, [square], support=VEHICLE.support))
    ceiling = fit(
        problem(MODEL.change(TwsbrTruth().table_1), [square], estimate=["voltage_offset"], support=VEHICLE.support)
    )
    print(f"\npercent predicted {HORIZON:g} s ahead: vehicle file, estimated, true numbers")
    for name in OTHERS:
        other = [record("twsbr", name, seed=seed)]
        shares = [
            predicted_percent(on_others(fitted, other, values=values), HORIZON)
            for fitted, values in ((estimated, MODEL.values), (estimated, {}), (ceiling, {}))
        ]
        for channel in shares[0]:
            print(f"{name:12}{channel:20}" + "".join(f"{each[channel]:9.2f}" for each in shares))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--runs", type=int, default=20, help="seeds FIRST to FIRST + RUNS - 1")
    parser.add_argument("--first", type=int, default=1, help="the first seed; 1 by default")
    parser.add_argument("--validate", action="store_true", help="predict three other experiments, too")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.runs)
    with ProcessPoolExecutor(arguments.processes) as pool:
        found = list(pool.map(of_recording, seeds))
        live = list(pool.map(while_it_runs, seeds))
    print(f"{len(found)} recordings of the square wave, estimate over truth")
    print(
        f"{'combination':26}{'mean':>8}{'scatter':>9}{'told +-':>9}{'off, +-':>9}{'within 95 %':>13}{'live, off %':>13}"
    )
    held = []
    for name in TOLD_NEAR_UPRIGHT:
        ratio, told = (np.array([each[name][place] for each in found]) for place in (0, 1))
        off, recursive = (ratio - 1.0) / told, np.array([each[name] for each in live]) - 1.0
        held.append(np.abs(off) < TWO_SIDED)
        print(
            f"{name:26}{ratio.mean():13.4f}{ratio.std():13.4f}{np.median(told):13.4f}{np.sqrt(np.mean(off**2)):13.2f}"
            f"{f'{held[-1].sum()} of {len(off)}':>13}{100.0 * np.sqrt(np.mean(recursive**2)):13.2f}"
        )
    share = float(np.mean(held))
    edges = binomtest(round(share * len(found)), len(found)).proportion_ci(0.95, method="wilson")
    print(f"within 95 %: {100 * share:.0f} % of all ({100 * edges.low:.0f} to {100 * edges.high:.0f})")
    if arguments.validate:
        validated(arguments.first)


if __name__ == "__main__":
    main()
