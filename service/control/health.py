"""Health of the control process, to be displayed: its rate, missed cycles, and the bus load. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from upright.service.control import assembly
from upright.vehicles.sections import VehicleFile


class HealthReports:
    """Reports on a vehicle's control loop, each for the time since the previous one."""

    def __init__(self, vehicle: VehicleFile) -> None:
        self._bitrate = vehicle.bus.bitrate
        self._frame_bits = _mean_frame_bits(vehicle)
        self._before: tuple[float, int, Mapping[str, int]] | None = None

    def report(self, now: float, cycles: int, missed: int, buses: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """`now` s of a monotonic clock, `cycles` and `missed` so far, statistics of `buses`.

        The load is calculated from frames per second and the average frame length of this vehicle with worst-case bit
        stuffing. Load and rate are None in the first report and after a bus was reopened.
        """
        frames = {each["address"]: each["received"] + each["sent"] for each in buses}
        rate: float | None = None
        load: dict[str, float | None] = dict.fromkeys(frames)
        if self._before is not None and now > self._before[0]:
            then, cycles_then, frames_then = self._before
            rate = round((cycles - cycles_then) / (now - then), 2)
            for address, count in frames.items():
                if 0 <= frames_then.get(address, count + 1) <= count:
                    bits = (count - frames_then[address]) * self._frame_bits / (now - then)
                    load[address] = round(100.0 * bits / self._bitrate, 2)
        self._before = now, cycles, frames
        return {
            "cycles": cycles,
            "missed_cycles": missed,
            "rate": rate,
            "buses": [
                {
                    "address": each["address"],
                    "load_percent": load[each["address"]],
                    "dropped": each["receive_dropped"] + each["transmit_dropped"],
                    "error_frames": each["error_frames"],
                }
                for each in buses
            ],
        }


def _mean_frame_bits(vehicle: VehicleFile) -> float:
    """Average length of a frame of this vehicle in bits, from its nominal load."""
    control = vehicle.control
    pdos = sum(len(drive.rpdo) + len(drive.tpdo) for drive in vehicle.drive)
    frames = control.rate * (1 + len(assembly.imu_config(vehicle).can_ids) + pdos) + 1.0 / control.heartbeat_period
    return sum(assembly.bus_load(vehicle).values()) / 100.0 * vehicle.bus.bitrate / frames
