"""The PDOs of a drive over SDO: mapping, transmission at SYNC and COB-ID, compared with the vehicle file's.

Differences are written if the drive allows it, in the order that CiA 301 requires: PDO off (bit 31 of its COB-ID),
count of mapped objects 0, the objects, the count, PDO on; then everything is read back.
"""

from __future__ import annotations

from dataclasses import dataclass

from canopen import ObjectDictionary

from upright.drivers.cia402 import pdo
from upright.drivers.cia402.objects import ObjectEntry
from upright.drivers.cia402.pdo import PdoCodec
from upright.drivers.cia402.sdo import DriveSetupError, MissingObject, Refused, SdoDialogue, milliseconds

INVALID = 1 << 31
"""Bit of a PDO's COB-ID: the PDO is off."""

NO_REMOTE = 1 << 30
"""Bit of a TPDO's COB-ID: not to be requested by a remote frame. Some drives require it."""

AT_SYNC = 1
"""Transmission type: at every SYNC."""


@dataclass(frozen=True, slots=True)
class PdoEntries:
    """Location of PDO `number` (from 1) of one direction in an object dictionary."""

    kind: str
    number: int
    communication: int
    mapping: int

    @property
    def name(self) -> str:
        return f"{self.kind}{self.number}"

    @property
    def cob_id(self) -> ObjectEntry:
        return ObjectEntry(f"{self.name} COB-ID", self.communication, 1, "I")

    @property
    def transmission_type(self) -> ObjectEntry:
        return ObjectEntry(f"{self.name} transmission type", self.communication, 2, "B")

    @property
    def event_timer(self) -> ObjectEntry:
        return ObjectEntry(f"{self.name} event timer", self.communication, 5, "H")

    @property
    def count(self) -> ObjectEntry:
        return ObjectEntry(f"{self.name} number of mapped objects", self.mapping, 0, "B")

    def mapped(self, place: int) -> ObjectEntry:
        """The mapped object at `place` (from 1)."""
        return ObjectEntry(f"{self.name} mapped object {place}", self.mapping, place, "I")


def rpdo(number: int) -> PdoEntries:
    """Receive PDO `number`: 1400h.., 1600h.."""
    return PdoEntries("RPDO", number, 0x1400 + number - 1, 0x1600 + number - 1)


def tpdo(number: int) -> PdoEntries:
    """Transmit PDO `number`: 1800h.., 1A00h.."""
    return PdoEntries("TPDO", number, 0x1800 + number - 1, 0x1A00 + number - 1)


def configure_pdos(sdo: SdoDialogue, dictionary: ObjectDictionary, rpdo_timeout: float) -> bool:
    """Set up the drive's PDOs as configured, and switch off the others.

    `rpdo_timeout` is in s. Returns whether the drive monitors missing setpoints (1400h:5 and up).

    Raises:
        DriveSetupError: a PDO differs and cannot be changed.
    """
    config = sdo.config
    watches = True
    for number, (cob_id, codec) in enumerate(config.rpdo_codecs.items(), start=1):
        entries = rpdo(number)
        _configure(sdo, entries, cob_id, codec)
        watches &= sdo.set_time(
            entries.event_timer,
            milliseconds(rpdo_timeout),
            without="the drive does not notice missing setpoints while the heartbeat goes on",
        )
    for number, (cob_id, codec) in enumerate(config.tpdo_codecs.items(), start=1):
        _configure(sdo, tpdo(number), cob_id, codec)
    _switch_off_rest(sdo, dictionary)
    return watches


def _configure(sdo: SdoDialogue, entries: PdoEntries, cob_id: int, codec: PdoCodec) -> None:
    found = _read_mapping(sdo, entries)
    found_cob_id = sdo.read(entries.cob_id)
    wanted_cob_id = cob_id | (found_cob_id & NO_REMOTE)
    if found == codec.mapping and found_cob_id == wanted_cob_id and sdo.read(entries.transmission_type) == AT_SYNC:
        return
    try:
        sdo.write(entries.cob_id, found_cob_id | INVALID)
        if found != codec.mapping:
            _write_mapping(sdo, entries, codec)
        _set_transmission(sdo, entries)
        sdo.set(entries.cob_id, wanted_cob_id)
    except DriveSetupError as error:
        raise sdo.refuse(
            f"{entries.name} cannot be changed. It carries {pdo.describe(found)} under {found_cob_id:#x}; the vehicle "
            f"file has {pdo.describe(codec.mapping)} under {cob_id:#x}. {error.reason}",
            entry=error.entry,
            remedy=f"Write {entries.kind.lower()} in the vehicle file as the drive has it, or change the drive.",
        ) from error
    found_after = _read_mapping(sdo, entries)
    if found_after != codec.mapping:
        raise sdo.refuse(
            f"{entries.name} carries {pdo.describe(found_after)} after {pdo.describe(codec.mapping)} was written",
            entry=entries.count,
            remedy=f"Write {entries.kind.lower()} in the vehicle file as the drive has it.",
        )


def _read_mapping(sdo: SdoDialogue, entries: PdoEntries) -> tuple[int, ...]:
    try:
        count = sdo.read(entries.count)
    except MissingObject as error:
        raise sdo.refuse(
            f"the drive has no {entries.name}",
            entry=entries.count,
            remedy=f"Use fewer {entries.kind.lower()} in the vehicle file, with more objects each.",
        ) from error
    return tuple(sdo.read(entries.mapped(place)) for place in range(1, count + 1))


def _write_mapping(sdo: SdoDialogue, entries: PdoEntries, codec: PdoCodec) -> None:
    sdo.write(entries.count, 0)
    for place, mapping in enumerate(codec.mapping, start=1):
        sdo.write(entries.mapped(place), mapping)
    sdo.write(entries.count, len(codec.mapping))
    sdo.changes.append(f"{entries.name}: carries {pdo.describe(codec.mapping)}")


def _set_transmission(sdo: SdoDialogue, entries: PdoEntries) -> None:
    try:
        sdo.set(entries.transmission_type, AT_SYNC)
    except Refused:
        if entries.kind == "TPDO":
            raise  # without it values would not arrive, or not at the SYNC
        found = sdo.read(entries.transmission_type)
        sdo.warnings.append(
            f"{entries.transmission_type} stays {found}: a setpoint acts when it arrives, not at the next SYNC"
        )


def _switch_off_rest(sdo: SdoDialogue, dictionary: ObjectDictionary) -> None:
    """Unused PDOs take bus time, and their timeouts would stop the drive."""
    for direction, used in ((rpdo, len(sdo.config.rpdo)), (tpdo, len(sdo.config.tpdo))):
        for number in range(used + 1, 513):
            entries = direction(number)
            cob_id = sdo.find(entries.cob_id)
            if cob_id is None and entries.communication not in dictionary:
                break  # neither the drive nor its EDS has one more
            if cob_id is None or cob_id & INVALID:
                continue
            try:
                sdo.set(entries.cob_id, cob_id | INVALID)
            except Refused as error:
                sdo.warnings.append(f"{entries.name} is not used and cannot be switched off: {error.reason}")
