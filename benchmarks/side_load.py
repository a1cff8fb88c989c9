"""Figure 4 of the paper: a person sits down, measured and simulated; hidden friction, before and after it is added.

    python benchmarks/side_load.py [--hide NAME ...] [--picture FILE.png] [--hour]

The virtual vehicle differs from the CAD values of its file by 13 to 15 %. In each case it runs the experiments
`multisine` and `side_load`. The model is completed by the diagnosis of the multisine, and both it and the CAD model are
simulated in the closed loop of the side load. "over noise" is the RMS error of that simulation over what noise alone
makes, and "within" is the share of samples at which it is within two standard deviations of that. `--hour` balances the
vehicle for an hour instead, and measures whether the precession angle drifts.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

import numpy as np

from upright.diagnosis.prediction.compare import Comparison, compare
from upright.diagnosis.report.figures.loop import save_closed_loop
from upright.models.model import Model
from upright.service.offline.diagnose import diagnosed
from upright.service.virtual.run import record
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.experiment.load import with_load
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import VehicleFile, load

SEED = 400
"""Of the records. No setting was chosen with it."""
DISTURBED = "disturbance=8,0.3"
"""The random torque of a virtual vehicle that a user starts: N m RMS, s."""
CASES = ((), (DISTURBED,), ("viscous_friction",), ("coulomb_friction",), (DISTURBED, "coulomb_friction"))


def completed(vehicle: VehicleFile, recording: Recording) -> tuple[Model, list[str]]:
    """The model after the diagnosis of `recording`, and the effects that it named."""
    found = diagnosed([recording], vehicle, seconds=float("inf")).found
    assert found.revised is not None, found.reason
    return found.revised, [finding.effect for finding in found.findings]


def compared(vehicle: VehicleFile, hide: tuple[str, ...]) -> tuple[list[Comparison], list[str]]:
    """CAD model and completed model in the loop of the side load, and the effects that were named."""
    model, named = completed(vehicle, record(vehicle, "multisine", hide=hide, seed=SEED))
    recording = record(vehicle, "side_load", hide=hide, seed=SEED + 1)
    models = {"CAD": registry.nominal_model("monocab"), "identified": model}
    loaded = {name: with_load(each, recording) for name, each in models.items()}
    loop = registry.recorded_loop(vehicle, recording)
    return compare(loaded, [recording], support=vehicle.support, loops=[loop]), named


def print_case(hide: tuple[str, ...], found: list[Comparison], named: list[str]) -> None:
    print(f"hidden: {', '.join(hide) or 'nothing'}; named: {', '.join(named) or 'nothing'}")
    for each in found:
        loop = each.closed_loop
        if loop.reason:
            print(f"  {each.name:10}  {loop.reason}")
            continue
        events = each.events
        asked = f"{events['load.torque']:.1f} N m from {events['load.start']:.2f} s within {events['load.rise']:.2f} s"
        print(f"  {each.name:10}  {'adequate' if each.adequate else 'not adequate':12}  load: {asked}")
        for channel, factor, unit in (
            ("roll", 57.2958, "deg"),
            ("precession", 57.2958, "deg"),
            ("trim_position", 1e3, "mm"),
        ):
            measured, simulated = (factor * curve[channel] for curve in (loop.measured, loop.simulated))
            within = float(np.mean(np.abs(measured - simulated) < 2.0 * factor * loop.floor[channel]))
            print(
                f"    {channel:14} largest {np.max(np.abs(measured)):7.3f} measured, {np.max(np.abs(simulated)):7.3f}"
                f" simulated; at the end {measured[-1]:8.3f}, {simulated[-1]:8.3f} {unit}; over noise"
                f" {loop.over_floor(channel):5.2f}, within {100.0 * within:5.1f} %"
            )


def print_hour(vehicle: VehicleFile, hide: tuple[str, ...], seconds: float) -> None:
    """An hour upright, with the full controller and without a load."""
    still = vehicle.experiments["side_load"].model_copy(update={"load": None})
    vehicle = vehicle.model_copy(update={"experiments": {"upright": still}})
    recording = record(vehicle, "upright", hide=hide, seed=SEED, duration=seconds)
    rows = recording["phase"] == Phase.EXCITE
    since, precession = recording.time[rows], np.degrees(recording["precession"][rows])
    late = since > since[0] + 30.0
    slope, offset = np.polyfit(since[late] - since[0], precession[late], 1)
    trim = 1e3 * recording["trim_position"][rows][late]
    roll = np.degrees(np.max(np.abs(recording["roll"][rows][late])))
    print(
        f"{seconds / 60.0:g} min upright, hidden: {', '.join(hide) or 'nothing'}: precession {offset:+.3f} deg"
        f" {3600.0 * slope:+.4f} deg/h, at most {np.max(np.abs(precession[late])):.2f} deg; trim mass"
        f" {np.mean(trim):+.1f} ± {np.std(trim):.1f} mm; roll at most {roll:.3f} deg"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hide", nargs="+", action="append", help="only this case; may be given several times")
    parser.add_argument("--picture", type=Path, help="picture of the last case")
    parser.add_argument("--hour", type=float, nargs="?", const=3600.0, metavar="SECONDS", help="balance for an hour")
    given = parser.parse_args()
    vehicle, began = load("monocab"), time.perf_counter()
    cases = [tuple(each) for each in given.hide] if given.hide else CASES
    if given.hour is not None:
        for hide in cases if given.hide else ((), (DISTURBED,)):
            print_hour(vehicle, hide, given.hour)
        return
    for hide in cases:
        found, named = compared(vehicle, hide)
        print_case(hide, found, named)
    if given.picture is not None:
        save_closed_loop(found, given.picture)
    print(f"{time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main()
