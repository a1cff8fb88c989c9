"""How often does a bus that loses frames stop a run? `python benchmarks/frame_loss.py --hours 100`

Every frame of the shipped vehicle is lost with the same probability, independently: the frames of an IMU set, which is
the clock of a cycle, SYNC, setpoints, answers and heartbeats. The program counts how often more of them are missing in
a row than the daemon, or a drive, lets pass. Runs of misses are counted, not the vehicle simulated: whether it can be
held meanwhile is measured by `make faults` (`loss_1` and others).
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from upright.service.control import assembly
from upright.vehicles.file import VehicleFile, load

HOUR = 3600.0
Mask = npt.NDArray[np.bool_]


def runs(missed: Mask, longest: int) -> int:
    """How many runs of more than `longest` misses there are."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], missed, [False])).astype(np.int8)))
    return int(np.count_nonzero(edges[1::2] - edges[::2] > longest))


def hour(vehicle: VehicleFile, share: float, draw: np.random.Generator) -> dict[str, int]:
    """The stops of one hour, by what was missing."""
    cycles = round(HOUR * vehicle.control.rate)
    io = assembly.vehicle_io(vehicle)

    def came(frames: int, count: int = cycles) -> Mask:
        """Whether so many frames of a cycle all arrived."""
        return draw.random(count) >= 1.0 - (1.0 - share) ** frames

    missed = vehicle.limits.missed_cycles
    sets = came(len(io.imu.can_ids))
    synced = sets & came(1)
    timeout = int(vehicle.setpoint_timeout / vehicle.period + 0.5)
    control = vehicle.control
    beats = round(HOUR / control.heartbeat_period)
    beat = int(control.heartbeat_timeout / control.heartbeat_period + 1e-9) - 2
    found = {"IMU sets": runs(~sets, missed - 1), "answers": 0, "setpoints": 0, "heartbeats": 0}
    for drive in io.drives:
        found["answers"] += runs(~(synced & came(len(drive.config.tpdo_codecs))), missed - 1)
        found["setpoints"] += runs(~(sets & came(len(drive.config.rpdo_codecs))), timeout - 2)
        # Those of the master as this drive receives them, and its own.
        found["heartbeats"] += sum(runs(~came(1, beats), beat) for _ in range(2))
    return found


def main(arguments: list[str] | None = None) -> Mapping[str, int]:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicle", default="monocab")
    parser.add_argument("--hours", type=int, default=100)
    parser.add_argument("--share", type=float, default=0.01, help="of the frames that are lost (default: 0.01)")
    parser.add_argument("--missed-cycles", type=int, help="in place of the vehicle file's")
    chosen = parser.parse_args(arguments)
    vehicle = load(chosen.vehicle)
    if chosen.missed_cycles:
        limits = vehicle.limits.model_copy(update={"missed_cycles": chosen.missed_cycles})
        vehicle = vehicle.model_copy(update={"limits": limits})
    draw = np.random.default_rng(1)
    total: dict[str, int] = {}
    for _ in range(chosen.hours):
        for name, count in hour(vehicle, chosen.share, draw).items():
            total[name] = total.get(name, 0) + count
    print(f"{chosen.hours} h of {chosen.vehicle}, {100.0 * chosen.share:g} % of the frames lost, ", end="")
    print(f"limits.missed_cycles = {vehicle.limits.missed_cycles}: {sum(total.values())} stops")
    for name, count in total.items():
        print(f"  {name:12s} {count}")
    return total


if __name__ == "__main__":
    main()
