"""Measure what the live estimators cost, and after how many seconds they part.

    OPENBLAS_NUM_THREADS=1 python benchmarks/live_estimators.py cost
    OPENBLAS_NUM_THREADS=1 python benchmarks/live_estimators.py parting --seeds 5

`cost`: for each kind of vehicle, processor time per second of data of each live estimator, as share of real time and
relative to the recursive prediction error (which has the live diagnosis with it), and the longest single update. The
minimum of several runs, as other processes may be running.

`parting`: a virtual MONOCAB on a multisine, without and with hidden effects, sensor noise and a disturbance. By
parameter and pair of methods: in how many recordings they part (estimators.parting, looked at four times a second) and
still do so at the end, and the median of the time since when, s from the first sample. The last line counts the
recordings in which any two methods part at any time.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from upright.estimators.parting import partings
from upright.service.observer.live.online_estimators import RECURSION, EstimatorBank, estimators_of
from upright.service.virtual.run import record
from upright.simulation.config import SimulationConfig
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.file import load

EXPERIMENTS = {"monocab": "multisine", "twsbr": "sine_stream", "cube": "multisine"}
REPEATS = 3
LOOK = 0.25
"""s between two looks at the results, as in the observer."""
NOISY_GYROS = (3e-4, 1e-3)
"""rad/s/sqrt(Hz), of a frame that shakes; the data sheet's is 3.5e-5 (docs/explanation/methods.md)."""


@dataclass(frozen=True, slots=True)
class Situation:
    """A virtual vehicle with the effects `hide`, and the gyro's noise, rad/s/sqrt(Hz), unless it is the default."""

    title: str
    hide: tuple[str, ...] = ()
    gyro: float | None = None

    def configure(self, configuration: SimulationConfig) -> SimulationConfig:
        if self.gyro is None:
            return configuration
        return replace(configuration, imu=replace(configuration.imu, angular_rate_density=self.gyro))


SITUATIONS = (
    Situation("nothing missing"),
    Situation("disturbance of 8 N m RMS", ("disturbance=8,0.3",)),
    Situation("coulomb_friction", ("coulomb_friction",)),
    Situation("sensor_delay", ("sensor_delay",)),
    *(Situation(f"gyro noise of {noise:g} rad/s/sqrt(Hz)", gyro=noise) for noise in NOISY_GYROS),
)


def bank_of(kind: str) -> EstimatorBank:
    vehicle = load(kind)
    bank = estimators_of(vehicle)
    bank.join()
    return bank


def cost_once(recording: Recording, kind: str) -> dict[str, tuple[float, float]]:
    """By method: s of processor time per second of data, and the longest single update, s."""
    total: dict[str, float] = defaultdict(float)
    longest: dict[str, float] = defaultdict(float)
    estimators = bank_of(kind).estimators
    for frame in recording.frames(registry.channels_of(kind)):
        for estimator in estimators:
            begin = time.thread_time()
            estimator.update(frame)
            spent = time.thread_time() - begin
            total[estimator.method] += spent
            longest[estimator.method] = max(longest[estimator.method], spent)
    return {method: (spent / recording.duration, longest[method]) for method, spent in total.items()}


def cost() -> None:
    for kind, experiment in EXPERIMENTS.items():
        recording = record(kind, experiment)
        runs = [cost_once(recording, kind) for _ in range(REPEATS)]
        least = {method: tuple(np.min([run[method] for run in runs], axis=0)) for method in runs[0]}
        every = sum(share for share, _ in least.values())
        print(f"{kind}, {experiment}, {recording.duration:.0f} s: {100 * every:.1f} % of real time in all")
        for method, (share, longest) in least.items():
            ratio = share / least[RECURSION][0]
            print(f"  {method:34} {100 * share:5.2f} %   {ratio:5.2f} x   longest update {1e3 * longest:4.0f} ms")


Pair = tuple[str, str, str]


def course(recording: Recording, kind: str) -> tuple[Mapping[Pair, float], set[Pair]]:
    """The pairs that part at the end with the time since when, s from the first sample, and those that ever did."""
    bank, look = bank_of(kind), LOOK
    since: dict[Pair, float] = {}
    ever: set[Pair] = set()
    for frame in recording.frames(registry.channels_of(kind)):
        bank.update([frame])
        now = (frame.timestamp_ns - recording.timestamp_ns[0]) * 1e-9
        if now < look:
            continue
        look += LOOK
        found = {(each.parameter, *each.methods) for each in partings(bank.results())}
        since = {pair: since.get(pair, now) for pair in found}
        ever |= found
    return since, ever


def parting(kind: str, experiment: str, seeds: int, among: str) -> None:
    for situation in (each for each in SITUATIONS if among in each.title):
        times: dict[Pair, list[float]] = defaultdict(list)
        some = 0
        for seed in range(seeds):
            recording = record(kind, experiment, hide=situation.hide, seed=seed, configure=situation.configure)
            since, ever = course(recording, kind)
            some += bool(ever)
            for pair, begin in since.items():
                times[pair].append(begin)
        print(f"{situation.title}: {experiment}, {seeds} recordings of {recording.duration:.0f} s")
        for (parameter, one, other), begins in sorted(times.items()):
            when = f"{len(begins)} of {seeds}, since {np.median(begins):.1f} s"
            print(f"  {parameter:22} {one:32} {other:32} {when}")
        print(f"  any two at any time: {some} of {seeds}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("what", choices=["cost", "parting"])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--vehicle", default="monocab", choices=EXPERIMENTS, help="for parting")
    parser.add_argument("--situation", default="", help="for parting: only those with this in their title")
    arguments = parser.parse_args()
    if arguments.what == "cost":
        cost()
    else:
        parting(arguments.vehicle, EXPERIMENTS[arguments.vehicle], arguments.seeds, arguments.situation)


if __name__ == "__main__":
    main()
