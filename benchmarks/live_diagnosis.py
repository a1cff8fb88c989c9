"""Measure the cost of the live diagnosis, its delay until it names an effect, and its false alarms.

`python benchmarks/live_diagnosis.py` prints, for recordings of the virtual vehicle that are fed in cycle by cycle:

- cost: processor time per sample of the diagnosis and of the recursive estimator that it monitors, in one run, the best
  of several;
- false alarms: recordings with nothing missing in which any effect is named at any time, 95 % interval (Wilson), and
  false names per hour of running, 95 % interval (Poisson);
- seconds: an effect sets in during the run. Its amplitude is a multiple of the minimum detectable effect of the 30 s of
  the same excitation after the onset. Printed are the seconds until an effect is named, whether it is the right one,
  first or tied, and when it was first tied with at most one other. With `--rise` the amplitude is a multiple of the
  minimum detectable effect of 30 s from the first sample on: the rise from the support, which is over at the onset,
  shows some effects that are not identifiable later. The number in brackets is the multiple of the other minimum.

`--disturbance RMS,CORRELATION_TIME` (N m, s) disturbs every vehicle; by default there is no disturbance.

No threshold was chosen on the seeds used here: that was done on seeds from 5000 on.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

import numpy as np
from scipy.stats import binomtest, chi2

from upright.diagnosis.live.live import LiveDiagnosis
from upright.diagnosis.live.naming import LiveFinding
from upright.estimators.recursive.predictor import Seen
from upright.service.virtual.run import BOOT_TIME, record
from upright.simulation.monocab.hidden import HIDDEN, LATE, UNLISTED
from upright.simulation.vehicle import START_NS
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.monocab.channels import CHANNELS as MONOCAB
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
REPEATS = 5
ONSET = 30.0
"""Time at which an effect sets in, s after the drives started."""


def live() -> LiveDiagnosis:
    given = VEHICLE.parameters
    return LiveDiagnosis(
        nominal_model("monocab"),
        parameters=given.values,
        deviations=given.deviations,
        support=VEHICLE.support,
        channels=MONOCAB,
    )


def course(
    recording: Recording, diagnosis: LiveDiagnosis, begin: float = 0.0
) -> Iterator[tuple[float, tuple[LiveFinding, ...]]]:
    """The findings and their time (s from the first sample) whenever the named effects change. Samples before `begin`
    are left out."""
    named: tuple[tuple[str, ...], ...] = ()
    for frame in recording.frames(MONOCAB):
        if (frame.timestamp_ns - recording.timestamp_ns[0]) * 1e-9 < begin:
            continue
        diagnosis.update(frame)
        found = diagnosis.result().findings
        names = tuple((each.effect, *each.tied_with) for each in found)
        if names != named:
            yield (frame.timestamp_ns - recording.timestamp_ns[0]) * 1e-9, found
        named = names


def cost(recording: Recording) -> tuple[float, float]:
    """us per sample of the diagnosis and of the recursive estimator: minima, as other processes may be running."""
    own, recursion = zip(*(cost_once(recording) for _ in range(REPEATS)), strict=True)
    return min(own), min(recursion)


def cost_once(recording: Recording) -> tuple[float, float]:
    diagnosis, spent = live(), 0.0
    watch = diagnosis.estimator.watch
    assert watch is not None

    def timed(seen: Seen) -> None:
        nonlocal spent
        begin = time.thread_time()
        watch(seen)
        spent += time.thread_time() - begin

    diagnosis.estimator.watch = timed
    frames = list(recording.frames(MONOCAB))
    begin = time.thread_time()
    for frame in frames:
        diagnosis.update(frame)
    total = time.thread_time() - begin
    return 1e6 * spent / len(frames), 1e6 * (total - spent) / len(frames)


def detectable(excitation: str, begin: float, disturbance: list[str]) -> dict[str, float]:
    """The minimum detectable amplitude of each effect in 30 s of a recording from `begin` on."""
    diagnosis = live()
    clean = record("monocab", excitation, hide=disturbance, seed=1000, duration=begin + 30.0)
    for _ in course(clean, diagnosis, begin):
        pass
    return dict(diagnosis.result().detectable)


def onset_of(recording: Recording) -> float:
    """Time of the onset, s from the first sample on."""
    begin = (int(recording.metadata.get("start_ns", START_NS)) - START_NS) * 1e-9
    return BOOT_TIME + ONSET - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--excitation", action="append", help="may be given several times; default: multisine")
    parser.add_argument("--clean", type=int, default=20, help="recordings with nothing missing per excitation")
    parser.add_argument("--size", type=float, default=3.0, help="of the effects, in minimum detectable ones")
    parser.add_argument("--seeds", type=int, default=1, help="recordings per effect")
    parser.add_argument("--disturbance", default="none", help="RMS,CORRELATION_TIME in N m and s of a random torque")
    parser.add_argument("--rise", action="store_true", help="minimum detectable from the first sample on")
    arguments = parser.parse_args()
    disturbance = [] if arguments.disturbance == "none" else [f"disturbance={arguments.disturbance}"]
    for excitation in arguments.excitation or ["multisine"]:
        clean = record("monocab", excitation, hide=disturbance, seed=1000, duration=60.0)
        own, recursion = cost(clean)
        print(
            f"{excitation}, 60 s: {own:.1f} us per sample, {own / recursion:.2f} of the estimator's {recursion:.1f} us"
        )
        alarms, names, hours = [], 0, 0.0
        for seed in range(arguments.clean):
            recording = record("monocab", excitation, hide=disturbance, seed=seed)
            alarm = {each.effect for _, found in course(recording, live()) for each in found}
            alarms.append(bool(alarm))
            names, hours = names + len(alarm), hours + recording.duration / 3600.0
            if alarm:
                print(f"  seed {seed}: {', '.join(sorted(alarm))}")
        if alarms:
            interval = binomtest(sum(alarms), len(alarms)).proportion_ci(0.95, method="wilson")
            share = f"{100 * interval.low:.0f} to {100 * interval.high:.0f} %"
            least, most = 0.5 * chi2.ppf(0.025, 2 * names) if names else 0.0, 0.5 * chi2.ppf(0.975, 2 * names + 2)
            print(
                f"  false alarms: {sum(alarms)} of {len(alarms)} ({share}); {names} names in {hours:.2f} h of running, "
                f"{names / hours:.1f} per hour ({least / hours:.1f} to {most / hours:.1f})"
            )
        if arguments.seeds < 1:
            continue
        sizes, others = (
            detectable(excitation, begin, disturbance) for begin in ((0.0, ONSET) if arguments.rise else (ONSET, 0.0))
        )
        waits: list[float] = []
        sharp: list[float] = []
        right = wrong = 0
        for name in sorted(LATE - set(UNLISTED)):
            counterpart = "static_torque" if name == "torque_step" else name
            if name == "static_torque" or counterpart not in sizes:
                continue
            level = arguments.size * sizes[counterpart] / abs(HIDDEN[name].size)
            for seed in range(arguments.seeds):
                hide = [*disturbance, f"{name}={level:.4g}@{ONSET:g}"]
                recording = record("monocab", excitation, hide=hide, seed=2000 + seed, duration=50.0)
                begin = onset_of(recording)
                first, text = float("inf"), "nothing"
                correct = alone = float("inf")
                for second, found in course(recording, live()):
                    names = [each.effect for each in found[:1]] + [
                        tied for each in found[:1] for tied in each.tied_with
                    ]
                    if second > begin and names and first == float("inf"):
                        first, text = second - begin, " = ".join(names)
                    if second > begin and name in names:
                        correct = min(correct, second - begin)
                        if len(names) <= 2:
                            alone = min(alone, second - begin)
                waits.append(correct)
                sharp.append(alone)
                right += name in text.split(" = ")
                wrong += text != "nothing" and name not in text.split(" = ")
                beside = (
                    f"{arguments.size * sizes[counterpart] / others[counterpart]:.1f}" if counterpart in others else "-"
                )
                print(
                    f"  {name} {level:.3g} ({beside}): first name after {first:.1f} s: {text}; right name after "
                    f"{correct:.1f} s, tied with at most one after {alone:.1f} s",
                    flush=True,
                )
        print(
            f"  of {len(waits)}: first name right {right} ({100 * right / len(waits):.0f} %), wrong {wrong}; right "
            f"name at some time {int(np.sum(np.isfinite(waits)))}, after {np.median(waits):.1f} s (median)"
        )
        print(f"  within 5 s {sum(wait <= 5.0 for wait in waits)}; tied with at most one: {np.median(sharp):.1f} s")


if __name__ == "__main__":
    main()
