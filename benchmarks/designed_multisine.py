"""Does a designed multisine keep within the limits, and how much time does it save against the sweep of the paper?

    python benchmarks/designed_multisine.py [--runs N] [--records N] [--processes N]

`runs` closed loops of the model are simulated, each with other parameters, drawn from the standard deviations of the
vehicle file (a normal distribution, cut off where a parameter would not be positive), with the controller of the
nominal ones. A run counts as a violation if a channel exceeds its limit, and as too close above 80 % of it. Then the
virtual vehicle runs the designed multisine and the sweep of the vehicle file `records` times each, and prediction
error estimates the parameters: standard deviation as stated, scatter of the estimates, and error.
"""

from __future__ import annotations

import argparse
import os
import time
from collections import Counter
from dataclasses import replace
from functools import cache
from multiprocessing import get_context

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

import numpy as np

from upright.diagnosis.prediction.closed_loop import Experiment, causal, simulate
from upright.estimators.methods.prediction_error import prediction_error
from upright.service.offline.models import identified_model
from upright.service.offline.multisine import NAME, DesignedMultisine, designed_multisine
from upright.service.virtual.run import record
from upright.vehicles import registry
from upright.vehicles.file import VehicleFile, load

SEED = 500
"""Of the parameters and of the records. No setting was chosen with it."""
DISTURBED = "disturbance=8,0.3"
TRUE = {"inertia": 1650.0, "gravity_stiffness": 14500.0}


@cache
def designed() -> tuple[VehicleFile, DesignedMultisine]:
    """The vehicle file with the designed experiment, and the design."""
    vehicle = load("monocab")
    found = designed_multisine(vehicle, identified_model(None, vehicle))
    return vehicle.model_copy(update={"experiments": {**vehicle.experiments, NAME: found.section}}), found


def outcome(number: int) -> str:
    """Of one simulated run."""
    vehicle, _ = designed()
    model = causal(identified_model(None, vehicle))
    random = np.random.default_rng((SEED, number))
    drawn = {
        p.name: max(0.05 * p.value, p.value + p.std * random.standard_normal())
        for p in model.parameters
        if p.name in vehicle.parameters.values and p.std > 0.0
    }
    experiment: Experiment = registry.of("monocab").prediction().of(vehicle)(NAME)
    close = simulate(model.change(drawn), experiment).broken
    if not close:
        return "within"
    # The simulation stops at 80 % of a limit: 125 % of the limits are the limits themselves.
    wider = tuple(replace(each, largest=1.25 * each.largest) for each in experiment.limits)
    return "violation" if simulate(model.change(drawn), replace(experiment, limits=wider)).broken else "too close"


def print_records(count: int) -> None:
    vehicle, _ = designed()
    for name in (NAME, "sweep"):
        found = []
        for number in range(count):
            recording = record(vehicle, name, hide=[DISTURBED], seed=SEED + number)
            found.append(prediction_error(identified_model(None, vehicle), [recording], support=vehicle.support))
        seconds = vehicle.experiments[name].duration
        for parameter, true in TRUE.items():
            each = [estimate.parameters[parameter] for estimate in found]
            values = np.array([np.nan if one.value is None else one.value for one in each])
            stated = np.array([np.nan if one.std is None else one.std for one in each])
            scatter = f"{np.nanstd(values, ddof=1):.3g}" if count > 1 else "-"
            print(
                f"{name:9} {seconds:3g} s  {parameter:18} {np.nanmean(values):8.1f} (true {true:g}), stated ±"
                f" {np.nanmean(stated):.3g}, scatter {scatter}, worst error {np.nanmax(np.abs(values - true)):.3g}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--records", type=int, default=10)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    began = time.perf_counter()
    _, found = designed()
    print(found.toml)
    print("share of each limit:", ", ".join(f"{name} {100.0 * each:.0f} %" for name, each in found.largest.items()))
    for each in found.candidates:
        stds = ", ".join(f"{name} ± {each.deviations[name]:.3g}" for name in found.about)
        print(
            f"{each.name:13} {each.seconds:4g} s: {stds}; {found.seconds_like(each.name):.1f} s of {NAME} for the same"
        )
    with get_context("spawn").Pool(given.processes) as pool:
        counted = Counter(pool.imap_unordered(outcome, range(given.runs), chunksize=20))
    print(f"{given.runs} simulated runs: {', '.join(f'{count} {name}' for name, count in counted.most_common())}")
    if given.records:
        print_records(given.records)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
