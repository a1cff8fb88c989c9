"""What the traffic on the buses says that no driver reads: frames of nodes that do not belong to the vehicle, and error
frames. Both are reported once, as events, and end nothing: what they do harm to is monitored for itself."""

from __future__ import annotations

from collections.abc import Callable

from upright.drivers.bus.error_frames import decode
from upright.drivers.cia301.nmt import HEARTBEAT_COB_ID
from upright.drivers.vehicle_io import LARGEST, VehicleIo
from upright.estimators.checks.loss_test import THRESHOLD, LossTest
from upright.telemetry.samples import CanFrame
from upright.vehicles.bounds import Code

MANY = 32
"""Ids of strangers that are told apart; further ones are counted together."""
SERVICES = (0x080, 0x580, HEARTBEAT_COB_ID)
"""What every CANopen node may send beyond its process data: emergency, SDO answer, heartbeat; added to its number."""
REPORTS = (0x180, 0x280, 0x380, 0x480)
"""What it sends as process data, TPDO 1 to 4. A node whose speed is read may send all of them."""
LSS, TIME = 0x7E4, 0x100

OTHERS = "others"
ENDLESS = 1 << 30


class BusWatch:
    """Gets every frame that no driver takes, and every error frame; `event` reports (severity, code, text)."""

    def __init__(self, io: VehicleIo, event: Callable[[str, str, str], None]) -> None:
        nodes = {drive.config.node for drive in io.drives} | {can_id & 0x7F for can_id in io.imu.can_ids[:1]}
        observed = {speed.config.can_id & 0x7F for speed in io.speeds}
        self._known = {service + node for service in SERVICES for node in nodes | observed} | {LSS, TIME}
        self._known |= {report + node for report in REPORTS for node in observed}
        self._event = event
        self._frames: dict[str, int] = {}
        self._errors = LossTest(in_a_row=ENDLESS)
        self._error: CanFrame | None = None
        self._said = False

    def meet(self, frame: CanFrame) -> None:
        """Take a frame that no driver claims."""
        if frame.can_id in self._known and not frame.extended and len(frame.data) <= LARGEST:
            return
        name = f"{frame.can_id:08X}h" if frame.extended else f"{frame.can_id:03X}h"
        if name not in self._frames and len(self._frames) >= MANY:
            name = OTHERS
        count = self._frames[name] = self._frames.get(name, 0) + 1
        if count == 1:
            self._event("warning", Code.FOREIGN_FRAMES, _stranger(name, frame))

    def error(self, frame: CanFrame) -> None:
        """Take an error frame."""
        self._error = frame

    def cycle(self) -> None:
        """A control cycle is over."""
        if self._error is None:
            self._errors.came()
            self._said = self._said and self._errors.log_ratio > 0.0
            return
        self._errors.lost()
        if self._errors.log_ratio > THRESHOLD and not self._said:
            self._said = True
            self._event(
                "warning",
                Code.BUS_ERRORS,
                f"error frames in most control cycles ({decode(self._error).text}): check termination, plugs, bit rate",
            )
        self._error = None

    def statistics(self) -> list[dict[str, int | str]]:
        """The strangers' frames so far, by id, for `upright status`."""
        return [
            {"id": name, "carries": "nothing of this vehicle", "frames": count} for name, count in self._frames.items()
        ]


def _stranger(name: str, frame: CanFrame) -> str:
    if name == OTHERS:
        return f"frames of more than {MANY} ids come from nodes that do not belong to the vehicle"
    kind = "a CAN FD frame" if len(frame.data) > LARGEST else "a frame"
    bus = f" on bus {frame.bus + 1}" if frame.bus else ""
    return (
        f"{kind} with the id {name} and {len(frame.data)} bytes{bus} comes from a node that does not belong to the "
        "vehicle: find out whose it is"
    )
