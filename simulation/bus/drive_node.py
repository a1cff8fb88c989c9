"""A drive as a CANopen slave (CiA 301): NMT, SDO server, PDOs, SYNC, EMCY, heartbeat both ways.

SDO and NMT run on canopen's LocalNode over an object dictionary from an EDS. What LocalNode lacks is here: PDOs on
SYNC and on event, the heartbeat consumer (1016h), RPDO deadlines (1400h:5) and the reactions to them (6007h, 1029h).
All times are simulated, in s.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial

import canopen
from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoAbortedError

from upright.simulation.bus.drive_application import DriveApplication
from upright.simulation.bus.node_network import NodeNetwork, Send
from upright.simulation.bus.object_dictionary import (
    MAPPING,
    RPDO,
    TPDO,
    check_mapping,
    load_dictionary,
    read_number,
    read_pdo,
    write_default_pdos,
)
from upright.simulation.bus.objects import ERROR_REGISTER, MAX_PDOS, MODE, Pdo
from upright.simulation.bus.power_state import PowerState
from upright.simulation.bus.sdo_server import SlowServer
from upright.simulation.config import DriveNode

COMMUNICATION_ERROR = 0x10
HEARTBEAT_LOST, RPDO_LATE, PDO_TOO_SHORT, LEFT_OPERATIONAL = 0x8130, 0x8250, 0x8210, 0x8100
RESET_NODE, RESET_COMMUNICATION = 129, 130
COMMUNICATION_AREA = range(0x1000, 0x2000)
ERROR_HISTORY = 0x1003
UNKNOWN_COMMAND = 0x0504_0001
"""SDO abort code: client or server command specifier not valid."""
SYNC_LOST = 1.0
"""s without a SYNC after which the drive is no longer synchronous."""


class VirtualDrive:
    """One drive on the bus. `receive` takes frames, `tick` lets time pass; frames leave through `send`."""

    def __init__(self, config: DriveNode, servo: DriveApplication, send: Send, clock: Callable[[], float]) -> None:
        self.config = config
        self.servo = servo
        self.connected = True
        """False: cable unplugged, nothing is sent or received."""
        self.heartbeat_enabled = True
        self._emit = send
        self._clock = clock
        self._network = NodeNetwork(self._send, clock)
        self._node = canopen.LocalNode(config.node, load_dictionary(config))
        self._network[config.node] = self._node
        self._node.add_read_callback(self._on_read)  # type: ignore[no-untyped-call]
        self._node.add_write_callback(self._on_write)  # type: ignore[no-untyped-call]
        self._handlers: dict[int, Callable[[bytes], None]] = {}
        self._rpdos: list[Pdo] = []
        self._tpdos: list[Pdo] = []
        self._consumers: dict[int, tuple[float, float | None]] = {}
        """Monitored node to its heartbeat timeout and the time at which it is overdue; None until it was heard."""
        self._stale = False
        self._last_sync = 0.0
        self._booted = 0.0
        self._answers = 0
        self._server = SlowServer(config.habits, self._answer_sdo)

    @property
    def state(self) -> PowerState:
        return self.servo.state

    @property
    def nmt_state(self) -> str:
        """As canopen calls it: OPERATIONAL, PRE-OPERATIONAL, STOPPED."""
        return str(self._node.nmt.state)

    def boot(self) -> None:
        """Switch on: defaults everywhere, boot-up message, then Pre-operational."""
        self._booted = self._clock()
        self.servo.restart(self._booted)
        self._node.data_store.clear()
        self._start_communication()
        self._server.boot(self._booted)

    def receive(self, can_id: int, data: bytes) -> None:
        """Take one frame from the bus."""
        handler = self._handlers.get(can_id)
        if handler is not None and self.connected:
            handler(data)
            if self._stale:
                self._configure()

    def tick(self) -> None:
        """Let time pass: states, deadlines, heartbeat, event-timed PDOs. Call it once per control period."""
        now = self._clock()
        if self.connected:
            self._server.tick(now)
            if self._stale:
                self._configure()
        for node, (timeout, due) in self._consumers.items():
            if due is not None and now >= due:
                self._consumers[node] = (timeout, None)
                self._connection_lost(HEARTBEAT_LOST)
        for rpdo in self._rpdos:
            if rpdo.due is not None and now >= rpdo.due:
                rpdo.due = None
                self._connection_lost(RPDO_LATE)
        self.servo.update(now)
        if self.heartbeat_enabled:
            self._network.send_due(now)
        if self.servo.remote:
            self._send_events(now)

    def fail(self, code: int, register: int) -> None:
        """A fault inside the drive: power off, Fault, EMCY."""
        self.servo.fail(code, register, self._clock(), under_power=False)
        self._send_emergency(code)

    def _start_communication(self) -> None:
        """Communication objects to their defaults, boot-up message, Pre-operational."""
        node, config = self._node, self.config
        for index in [index for index in node.data_store if index in COMMUNICATION_AREA]:
            del node.data_store[index]
        for subindex, value in ((1, config.vendor_id), (2, config.product_code), (3, config.revision)):
            if value:
                node.data_store.setdefault(0x1018, {})[subindex] = struct.pack("<I", value)
        write_default_pdos(node, config)
        for (index, subindex), initial in config.habits.initial.items():
            node.data_store.setdefault(index, {})[subindex] = initial
        self._consumers.clear()
        self._configure()
        node.nmt.stop_heartbeat()  # type: ignore[no-untyped-call]
        node.nmt.state = "INITIALISING"
        node.nmt.state = "PRE-OPERATIONAL"
        self._follow_nmt()

    def _configure(self) -> None:
        """Read the object dictionary again after it was written."""
        self._stale = False
        read = partial(read_number, self._node)
        parameters = self.servo.parameters
        parameters.quick_stop_option = read(0x605A, 0, 2)
        parameters.shutdown_option = read(0x605B, 0, 0)
        parameters.disable_option = read(0x605C, 0, 1)
        parameters.fault_reaction = read(0x605E, 0, 2)
        parameters.maximum_rpm = read(0x6046, 2, 3000)
        parameters.acceleration = read(0x6048, 1, 30_000) / max(1, read(0x6048, 2, 1))
        parameters.deceleration = read(0x6049, 1, 30_000) / max(1, read(0x6049, 2, 1))
        parameters.quick_stop = read(0x604A, 1, 30_000) / max(1, read(0x604A, 2, 1))
        self._abort_option = read(0x6007, 0, 1)
        self._error_behaviour = read(0x1029, 1, 0)
        self._emergency_id = read(0x1014, 0, 0x80 + self.config.node) & 0x7FF
        self._rpdos = [pdo for i in range(MAX_PDOS) if (pdo := read_pdo(self._node, RPDO + i, self._rpdos))]
        self._tpdos = [pdo for i in range(MAX_PDOS) if (pdo := read_pdo(self._node, TPDO + i, self._tpdos))]
        watched = [read(0x1016, subindex, 0) for subindex in range(1, read(0x1016, 0, 0) + 1)]
        self._consumers = {
            node: ((entry & 0xFFFF) * 1e-3, self._consumers.get(node, (0.0, None))[1])
            for entry in watched
            if (node := entry >> 16 & 0x7F) and entry & 0xFFFF
        }
        self._handlers = {
            0x000: self._on_nmt,
            read(0x1005, 0, 0x80) & 0x7FF: self._on_sync,
            0x600 + self.config.node: self._on_sdo,
        }
        self._handlers |= {0x700 + node: partial(self._on_heartbeat, node) for node in self._consumers}
        self._handlers |= {pdo.cob_id: partial(self._on_rpdo, pdo) for pdo in self._rpdos}

    def _on_nmt(self, data: bytes) -> None:
        if len(data) != 2 or data[1] not in (0, self.config.node):
            return
        if data[0] == RESET_NODE:
            self.boot()
        elif data[0] == RESET_COMMUNICATION:
            self._start_communication()
        else:
            self._network.notify(0, bytearray(data), self._clock())
            self._follow_nmt()

    def _follow_nmt(self) -> None:
        operational = self.nmt_state == "OPERATIONAL"
        left = self.servo.remote and not operational
        self.servo.remote = operational
        if left:
            for pdo in self._rpdos:
                pdo.due = pdo.data = None
            if self.state is PowerState.OPERATION_ENABLED:
                self._connection_lost(LEFT_OPERATIONAL)

    def _on_sdo(self, data: bytes) -> None:
        if len(data) == 8 and self.nmt_state != "STOPPED":
            self._server.take(bytes(data), self._clock())

    def _answer_sdo(self, data: bytes) -> None:
        try:
            self._network.notify(0x600 + self.config.node, bytearray(data), self._clock())
        except struct.error:  # canopen's server cannot abort a segment that belongs to no transfer
            self._send(0x580 + self.config.node, struct.pack("<BHBI", 0x80, 0, 0, UNKNOWN_COMMAND))

    def _on_read(self, index: int, subindex: int, od: ODVariable) -> int | None:
        self.servo.sample()
        if step := self.config.habits.rounded.get((index, subindex)):
            stored = self._node.data_store.get(index, {}).get(subindex)
            return None if stored is None else -(-int.from_bytes(stored, "little") // step) * step
        return self.servo.image.get(index << 8 | subindex)

    def _on_write(self, index: int, subindex: int, od: ODVariable, data: bytes) -> None:
        if index - MAPPING in (*range(RPDO, RPDO + MAX_PDOS), *range(TPDO, TPDO + MAX_PDOS)):
            check_mapping(self._node, index, subindex, int.from_bytes(data, "little"))
        since_boot = self._clock() - self._booted
        if code := self.config.habits.refusal(index, subindex, int.from_bytes(data, "little"), since_boot):
            raise SdoAbortedError(code)
        key = index << 8 | subindex
        if key in self.servo.image:
            value = int(od.decode_raw(bytes(data)))
            if key == MODE and value not in self.servo.modes:
                raise SdoAbortedError(0x0609_0030)
            self._write(key, value)
            self.servo.update(self._clock())
        else:
            self._stale = True

    def _on_rpdo(self, pdo: Pdo, data: bytes) -> None:
        if not self.servo.remote:
            return
        if len(data) < pdo.codec.size:
            self._send_emergency(PDO_TOO_SHORT, COMMUNICATION_ERROR)
            return
        if pdo.timer:
            pdo.due = self._clock() + pdo.timer
        if pdo.synchronous:
            pdo.data = data
        else:
            self._apply(pdo, data)

    def _apply(self, pdo: Pdo, data: bytes) -> None:
        for key, value in zip(pdo.keys, pdo.codec.unpack_from(data), strict=True):
            self._write(key, value)
        self.servo.update(self._clock())

    def _write(self, key: int, value: int) -> None:
        if self.servo.write(key, value, self._clock()):
            self._send_emergency(0)

    def _on_sync(self, data: bytes) -> None:
        if not self.servo.remote:
            return
        self._last_sync = self._clock()
        self.servo.synchronous = True
        for pdo in self._rpdos:
            if pdo.data is not None:
                waiting, pdo.data = pdo.data, None
                self._apply(pdo, waiting)
        self.servo.sample()
        image = self.servo.image
        for pdo in self._tpdos:
            if pdo.synchronous:
                pdo.syncs += 1
                if pdo.syncs >= pdo.type:
                    pdo.syncs = 0
                    self._send(pdo.cob_id, pdo.codec.pack(*[image.get(key, 0) for key in pdo.keys]))

    def _send_events(self, now: float) -> None:
        """Event-driven TPDOs: on a change, and when their event timer runs out."""
        if now - self._last_sync > SYNC_LOST:
            self.servo.synchronous = False
        events = [pdo for pdo in self._tpdos if not pdo.synchronous]
        if not events:
            return
        self.servo.sample()
        for pdo in events:
            data = pdo.codec.pack(*[self.servo.image.get(key, 0) for key in pdo.keys])
            if data != pdo.data or (pdo.due is not None and now >= pdo.due):
                pdo.data = data
                pdo.due = now + pdo.timer if pdo.timer else None
                self._send(pdo.cob_id, data)

    def _on_heartbeat(self, node: int, data: bytes) -> None:
        timeout = self._consumers[node][0]
        self._consumers[node] = (timeout, self._clock() + timeout)

    def _connection_lost(self, code: int) -> None:
        """The master is gone: the reaction of 6007h (0 none, 1 fault, 2 disable voltage, 3 quick stop), then 1029h."""
        if self._abort_option:
            self.servo.fail(code, COMMUNICATION_ERROR, self._clock(), under_power=self._abort_option != 2)
        self._send_emergency(code, COMMUNICATION_ERROR)
        if self.servo.remote and self._error_behaviour != 1:
            self._node.nmt.state = "STOPPED" if self._error_behaviour == 2 else "PRE-OPERATIONAL"
            self._follow_nmt()

    def _send_emergency(self, code: int, register: int = 0) -> None:
        if code:
            history = self._node.data_store.setdefault(ERROR_HISTORY, {})
            history[1] = struct.pack("<I", code)
            history[0] = b"\x01"
        if self.nmt_state != "STOPPED":
            self._send(self._emergency_id, struct.pack("<HB5x", code, self.servo.image[ERROR_REGISTER] | register))

    def _send(self, can_id: int, data: bytes) -> None:
        if can_id == 0x580 + self.config.node:
            self._answers += 1
            lost = self.config.habits.lost_answer
            if lost and self._answers % lost == 0:
                return
        if self.connected:
            self._emit(can_id, data)
