"""The object dictionary of a virtual drive: read from an EDS, its PDO mapping set, checked and read back (CiA 301)."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import canopen
from canopen.objectdictionary import ODVariable
from canopen.sdo.exceptions import SdoAbortedError

from upright.simulation.bus.objects import MAX_PDO_BYTES, MAX_PDOS, STRUCT_CODES, Pdo, keys_by_name
from upright.simulation.config import DriveNode
from upright.telemetry.errors import UprightError

NOT_IN_USE = 0x8000_0000
RPDO, TPDO = 0x1400, 0x1800
MAPPING = 0x200
"""From a PDO's communication object to its mapping object."""

NOT_MAPPABLE, TOO_LONG, WRONG_STATE = 0x0604_0041, 0x0604_0042, 0x0800_0022


class SimulationError(UprightError):
    """The virtual vehicle cannot be built as described."""


def load_dictionary(config: DriveNode) -> canopen.ObjectDictionary:
    """The object dictionary of a drive. Raises SimulationError, naming the drive and its EDS."""
    path = Path(config.eds)
    problem = "does not exist"
    if path.is_file():
        try:
            dictionary = canopen.import_od(str(path), config.node)
        except (KeyError, ValueError, OSError) as error:
            problem = f"cannot be read: {error}"
        else:
            assert isinstance(dictionary, canopen.ObjectDictionary)
            if 0x1400 in dictionary:
                return dictionary
            problem = "describes no PDO: it is not that of a drive"
    raise SimulationError(
        f"the EDS {str(path)!r} of drive {config.name!r} {problem}.",
        remedy="Name another in the vehicle file, or use one that is shipped, such as upright_servo.eds.",
    )


def read_number(node: canopen.LocalNode, index: int, subindex: int, default: int) -> int:
    """An integer object, `default` if the dictionary does not have it."""
    variable = node.object_dictionary.get_variable(index, subindex)
    if variable is None:
        return default
    try:
        return int(variable.decode_raw(node.get_data(index, subindex)))
    except SdoAbortedError:
        return default


def write_default_pdos(node: canopen.LocalNode, config: DriveNode) -> None:
    """Give the node the power-on PDOs of `config`. Raises SimulationError if the EDS lacks what they need."""
    for first, pdos in ((RPDO, config.rpdo), (TPDO, config.tpdo)):
        for place in range(MAX_PDOS):
            if place < len(pdos):
                _write_pdo(node, config, first, place, pdos[place])
            elif first + place in node.object_dictionary:
                _write_pdo(node, config, first, place, None)


def _write_pdo(node: canopen.LocalNode, config: DriveNode, first: int, place: int, names: Sequence[str] | None) -> None:
    index = first + place
    keys = keys_by_name(config.mode, config.target_velocity_fine_index)
    unknown = [name for name in names or () if name not in keys]
    if unknown or index not in node.object_dictionary:
        what = f"object {unknown[0]!r}" if unknown else f"PDO {index:04X}h"
        raise SimulationError(
            f"drive {config.name!r} has no {what}.", remedy=f"Map at most {MAX_PDOS} PDOs of {', '.join(keys)}."
        )
    entries = []
    for name in names or ():
        variable = _variable(node, keys[name])
        if variable is None:
            raise SimulationError(
                f"the EDS of drive {config.name!r} has no object {keys[name] >> 8:04X}h ({name}).",
                remedy="Leave it out of the vehicle file's PDOs, or name an EDS that has it.",
            )
        entries.append(_entry(variable))
    cob_id = (0x100 if first == TPDO else 0x200) + 0x100 * place + (0x80 if first == TPDO else 0) + config.node
    communication = node.data_store.setdefault(index, {})
    communication[1] = struct.pack("<I", cob_id if names is not None else cob_id | NOT_IN_USE)
    communication[2] = b"\x01"
    mapping = {0: bytes([len(entries)])}
    mapping |= {number: struct.pack("<I", entry) for number, entry in enumerate(entries, start=1)}
    node.data_store[index + MAPPING] = mapping


def read_pdo(node: canopen.LocalNode, index: int, before: Sequence[Pdo]) -> Pdo | None:
    """The PDO with communication object `index`, None if not in use; keeps the data of the same PDO in `before`."""
    cob_id = read_number(node, index, 1, NOT_IN_USE)
    if cob_id & NOT_IN_USE:
        return None
    count = read_number(node, index + MAPPING, 0, 0)
    entries = [read_number(node, index + MAPPING, place, 0) for place in range(1, count + 1)]
    keys = tuple(entry >> 8 for entry in entries)
    types = [variable.data_type for key in keys if (variable := _variable(node, key)) is not None]
    pdo = Pdo(
        cob_id=cob_id & 0x7FF,
        type=read_number(node, index, 2, 1),
        timer=read_number(node, index, 5, 0) * 1e-3,
        keys=keys,
        codec=struct.Struct("<" + "".join(STRUCT_CODES[kind] for kind in types if kind is not None)),
    )
    if same := next((other for other in before if other.cob_id == pdo.cob_id and other.keys == keys), None):
        pdo.data, pdo.due = same.data, same.due if pdo.timer else None
    return pdo


def check_mapping(node: canopen.LocalNode, index: int, subindex: int, value: int) -> None:
    """Refuse an impossible mapping, as a drive does. Raises SdoAbortedError with the code of CiA 301."""
    if subindex == 0:
        entries = [read_number(node, index, place, 0) for place in range(1, value + 1)]
        if 0 in entries:
            raise SdoAbortedError(NOT_MAPPABLE)
        if sum(entry & 0xFF for entry in entries) > 8 * MAX_PDO_BYTES:
            raise SdoAbortedError(TOO_LONG)
        return
    if read_number(node, index, 0, 0):
        raise SdoAbortedError(WRONG_STATE)
    variable = _variable(node, value >> 8)
    if value and (variable is None or not variable.pdo_mappable or _entry(variable) != value):
        raise SdoAbortedError(NOT_MAPPABLE)
    if variable is not None and variable.data_type not in STRUCT_CODES:
        raise SdoAbortedError(NOT_MAPPABLE)


def _variable(node: canopen.LocalNode, key: int) -> ODVariable | None:
    return node.object_dictionary.get_variable(key >> 8, key & 0xFF)


def _entry(variable: ODVariable) -> int:
    return int(variable.index << 16 | variable.subindex << 8 | len(variable))
