"""How accurate are the balancing robot's estimates and their +-? `python benchmarks/robot_estimates.py --runs 20`

The virtual robot is recorded with the paper's square wave. The combinations of parameters that are identifiable near
upright (`vehicles.twsbr.model.IDENTIFIABLE_NEAR_UPRIGHT`) are estimated from the vehicle file's start values, which are
up to 40 % off. The program prints for each combination the scatter of estimate over truth, the error in standard
deviations (RMS: 1 if the +- is right), how often the 95 % interval contains the truth, and the error of the recursive
estimator at the end of the run (RMS). The six combinations of one record are not independent: the interval in the last
line (Wilson) counts records.

With `--validate` the sine, the doublet and the sine stream of the first seed are predicted 0.1 s ahead with the
estimates, with the vehicle file's parameters, and with the true ones, which give the best fit that the noise allows.
"""

from __future__ import annotations

import argparse
import os
from concurrent.futures import ProcessPoolExecutor

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

import numpy as np
from scipy.stats import binomtest

from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.fit.problem import problem
from upright.estimators.identify.combinations import combinations
from upright.estimators.identify.run import with_values
from upright.estimators.identify.validation import on_others
from upright.estimators.methods.prediction_error import predicted_percent
from upright.estimators.recursive.prediction_error import RecursivePredictionError
from upright.models.text.expressions import number
from upright.service.virtual.run import record
from upright.simulation.twsbr.truth import TwsbrTruth
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model
from upright.vehicles.twsbr.channels import CHANNELS as TWSBR
from upright.vehicles.twsbr.model import IDENTIFIABLE_NEAR_UPRIGHT

VEHICLE = load("twsbr")
GIVEN = VEHICLE.parameters
MODEL = with_values(nominal_model("twsbr"), GIVEN.values, GIVEN.deviations)
TRUTH = {**MODEL.values, **TwsbrTruth().table_1}
HORIZON = 0.1
"""s ahead: a tilt error doubles in that time."""
OTHERS = ("sine", "doublet", "sine_stream")
TWO_SIDED = 1.96
"""Standard deviations on either side of a 95 % interval."""


def true(name: str) -> float:
    return number(IDENTIFIABLE_NEAR_UPRIGHT[name], TRUTH, name)


def of_recording(seed: int) -> dict[str, tuple[float, float]]:
    """Estimate over truth of each combination, and its standard deviation."""
    fitted = fit(problem(MODEL, [record("twsbr", "square", seed=seed)], support=VEHICLE.support))
    found = combinations(fitted, IDENTIFIABLE_NEAR_UPRIGHT)
    return {name: (value / true(name), std / abs(true(name))) for name, (value, std) in found.items()}


def while_it_runs(seed: int) -> dict[str, float]:
    """Recursive estimate over truth of each combination at the end of the run."""
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
    return {name: number(text, values, name) / true(name) for name, text in IDENTIFIABLE_NEAR_UPRIGHT.items()}


def validated(seed: int) -> None:
    """Print which share of each channel's motion is predicted in experiments that were not fitted."""
    square = record("twsbr", "square", seed=seed)
    estimated = fit(problem(MODEL, [square], support=VEHICLE.support))
    ceiling = fit(
        problem(MODEL.change(TwsbrTruth().table_1), [square], estimate=["voltage_offset"], support=VEHICLE.support)
    )
    print(f"\npercent predicted {HORIZON:g} s ahead: vehicle file, estimates, true parameters")
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
    parser.add_argument("--first", type=int, default=1, help="the first seed; default: 1")
    parser.add_argument("--validate", action="store_true", help="predict three other experiments, too")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.runs)
    with ProcessPoolExecutor(arguments.processes) as pool:
        found = list(pool.map(of_recording, seeds))
        live = list(pool.map(while_it_runs, seeds))
    print(f"{len(found)} recordings of the square wave, estimate over truth")
    print(f"{'combination':26}{'mean':>8}{'scatter':>9}{'+-':>9}{'error/+-':>9}{'within 95 %':>13}{'live error %':>13}")
    held = []
    for name in IDENTIFIABLE_NEAR_UPRIGHT:
        ratio, std = (np.array([each[name][place] for each in found]) for place in (0, 1))
        off, recursive = (ratio - 1.0) / std, np.array([each[name] for each in live]) - 1.0
        held.append(np.abs(off) < TWO_SIDED)
        print(
            f"{name:26}{ratio.mean():13.4f}{ratio.std():13.4f}{np.median(std):13.4f}{np.sqrt(np.mean(off**2)):13.2f}"
            f"{f'{held[-1].sum()} of {len(off)}':>13}{100.0 * np.sqrt(np.mean(recursive**2)):13.2f}"
        )
    share = float(np.mean(held))
    edges = binomtest(round(share * len(found)), len(found)).proportion_ci(0.95, method="wilson")
    print(f"within 95 %: {100 * share:.0f} % of all ({100 * edges.low:.0f} to {100 * edges.high:.0f})")
    if arguments.validate:
        validated(arguments.first)


if __name__ == "__main__":
    main()
