"""What bus and drives tell of themselves: what answers, how the speed loops follow, how they stop without a master."""

from __future__ import annotations

import json
import time
from math import degrees
from typing import Any

import numpy as np

from upright.estimators.identify.table import METHODS, Domain
from upright.service.commission.evidence import Evidence, Found
from upright.service.offline.inputs.replay import load
from upright.service.whole_file import write_whole
from upright.telemetry.candump import CandumpReader
from upright.vehicles import registry
from upright.vehicles.commissioning import Number
from upright.vehicles.experiment.phases import Phase

LISTENING = 2.0
"""s between two looks at the daemon's counts."""
HEARTBEAT, EMERGENCY = 0x700, 0x80


def bus(evidence: Evidence) -> Found:
    """What the daemon found on the bus, and how the bus went for some seconds."""
    before = evidence.ask({"verb": "status"})["status"]
    time.sleep(LISTENING)
    after = evidence.ask({"verb": "status"})["status"]
    cycles = after["cycles"] - before["cycles"]
    missed = after["missed_cycles"] - before["missed_cycles"]
    reports = after["drive_reports"]
    silent = [each.name for each in evidence.vehicle.drive if each.name not in {one["name"] for one in reports}]
    warnings = [f"{each['name']}: {warning}" for each in reports for warning in each["warnings"]]
    unchecked = [each.name for each in evidence.vehicle.drive if not each.vendor_id]
    text = [
        f"{each['name']}: node {each['node']}, vendor {each['vendor_id']:#x}, product {each['product_code']:#x}"
        + (f", serial {each['serial_number']}" if each["serial_number"] else "")
        for each in reports
    ]
    text += [f"{name} does not answer" for name in silent] + warnings + list(after["interlocks"])
    if unchecked:
        text.append(f"Vendor and product of {', '.join(unchecked)} are not checked: the vehicle file gives none.")
    return Found(
        {
            "cycles": Number(value=float(cycles)),
            "missed_percent": Number(value=100.0 * missed / cycles if cycles else None, unit="%"),
            "error_frames": Number(value=float(_errors(after) - _errors(before))),
            "drives_missing": Number(value=float(len(silent))),
            "drive_warnings": Number(value=float(len(warnings))),
            "interlocks": Number(value=float(len(after["interlocks"]))),
        },
        text,
    )


def _errors(status: dict[str, Any]) -> int:
    return sum(int(each.get("error_frames", 0)) for each in status["buses"])


def drives(evidence: Evidence) -> Found:
    """The drives' speed loops, by the methods that identify drives, and how far the vehicle moved on its support."""
    methods = [name for name, each in METHODS.items() if each.domain is Domain.DRIVES]
    words = [word for name in methods for word in ("--method", name)]
    document = evidence.upright(["identify", *map(str, evidence.recordings[:1]), *words])
    numbers = {
        name: Number(value=each["value"], std=each["std"], unit=each["unit"])
        for found in document["methods"].values()
        for name, each in found["parameters"].items()
    }
    recording = load(evidence.recording, evidence.vehicle)
    moving = recording["phase"] == Phase.MOVE
    angle = recording[registry.nominal_model(evidence.vehicle.vehicle.kind).joints[0].coordinate][moving]
    numbers["moved"] = Number(value=degrees(float(np.ptp(angle))) if len(angle) else None, unit="deg")
    result = evidence.at(".json")
    write_whole(result, json.dumps(document, indent=1))
    return Found(numbers, files=[result], result=result)


def silence(evidence: Evidence) -> Found:
    """How soon each drive reported that its master is silent, from the raw frames.

    The time counts from the master's last heartbeat to the drive's emergency message.
    """
    vehicle = evidence.vehicle
    names = {EMERGENCY + each.node: each.name for each in vehicle.drive}
    heartbeat = HEARTBEAT + vehicle.control.master_node
    last: int | None = None
    reacted: dict[str, float] = {}
    text = []
    for frame in CandumpReader(evidence.recording.with_suffix(".log")):
        if frame.can_id == heartbeat and not reacted:
            last = frame.timestamp_ns
        name = names.get(frame.can_id)
        code = int.from_bytes(frame.data[:2], "little") if name and len(frame.data) >= 2 else 0
        if name and code and last is not None and name not in reacted:
            reacted[name] = (frame.timestamp_ns - last) * 1e-9
            text.append(f"{name}: {code:04X}h after {1e3 * reacted[name]:.0f} ms")
    missing = [name for name in names.values() if name not in reacted]
    text += [f"{name}: no emergency message" for name in missing]
    slowest = max(reacted.values()) if reacted and not missing else None
    share = slowest / vehicle.control.heartbeat_timeout if slowest is not None else None
    return Found(
        {
            "drives_not_reacting": Number(value=float(len(missing))),
            "slowest": Number(value=slowest, unit="s"),
            "slowest_of_timeout": Number(value=share),
        },
        text,
    )
