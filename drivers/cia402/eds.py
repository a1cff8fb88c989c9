"""Electronic data sheets (CiA 306) of drives: put right (`eds_text`), read by canopen, compared with what is needed.

The EDS of another device loads without an error, but its names then refer to the wrong objects. So identity and types
are compared before anything is written. What the sheet leaves open the drive is asked (`check_device`); what it
contradicts is refused.
"""

from __future__ import annotations

import configparser
import io
from pathlib import Path

from canopen import ObjectDictionary
from canopen.objectdictionary import ODVariable
from canopen.objectdictionary.eds import import_eds

from upright.drivers.cia301.eds_text import DATA_TYPES, UNKNOWN_TYPE, DataSheet, NoDataSheet
from upright.drivers.cia402.config import DriveConfig, find_eds
from upright.drivers.cia402.objects import CONTROLWORD, MODE, STATUSWORD, ObjectEntry
from upright.drivers.cia402.sdo import DriveSetupError, MissingObject, SdoDialogue

TYPE_NAMES = {number: name for name, number in DATA_TYPES.items()}
SIZES = {0x01: 1, 0x02: 1, 0x03: 2, 0x04: 4, 0x05: 1, 0x06: 2, 0x07: 4}
"""Data type number to bytes, of the types that upright maps."""


class EdsError(DriveSetupError):
    """An EDS that cannot be used for this drive. `file` names it."""

    def __init__(
        self, config: DriveConfig, file: Path, message: str, *, entry: ObjectEntry | None = None, remedy: str
    ) -> None:
        super().__init__(config, f"eds {str(file)!r}: {message}", entry=entry, remedy=remedy)
        self.file = file


def load(config: DriveConfig, warnings: list[str] | None = None) -> tuple[Path, ObjectDictionary]:
    """The EDS or DCF of `config.eds`, for the drive's node id, and what is wrong in it but does no harm in `warnings`.

    Raises:
        DriveConfigError: there is no such file.
        EdsError: the file is not an EDS, or has an object that is needed with another length.
    """
    file = find_eds(config.eds, drive=config.name)
    remedy = "Use the EDS that the drive's maker supplies for this model and firmware."
    found: list[str] = [] if warnings is None else warnings
    try:
        sheet = DataSheet(file.read_bytes(), config.node)
        dictionary = import_eds(io.StringIO(sheet.text), config.node)  # type: ignore[no-untyped-call]
    except NoDataSheet as error:
        raise EdsError(config, file, str(error), remedy=remedy) from error
    except OSError as error:
        raise EdsError(config, file, f"cannot be read: {error.strerror}", remedy=remedy) from error
    except (ValueError, KeyError, configparser.Error) as error:
        raise EdsError(config, file, f"cannot be read: {error}", remedy=remedy) from error
    found.extend(sheet.warnings)
    for entry in dict.fromkeys((CONTROLWORD, STATUSWORD, MODE, *config.mapped_objects)):
        _check_entry(config, file, dictionary, entry, found)
    return file, dictionary


def _check_entry(
    config: DriveConfig, file: Path, dictionary: ObjectDictionary, entry: ObjectEntry, warnings: list[str]
) -> None:
    section = f"{entry.index:04X}" + (f"sub{entry.subindex:X}" if entry.subindex else "")
    expected = TYPE_NAMES[entry.data_type]
    variable = dictionary.get_variable(entry.index, entry.subindex)
    if not isinstance(variable, ODVariable):
        warnings.append(f"[{section}] ({entry.name}) is missing: the drive is asked for it at set-up")
        return
    found = variable.data_type or UNKNOWN_TYPE
    if found == entry.data_type or found == UNKNOWN_TYPE:
        return
    there = TYPE_NAMES.get(found, f"type {found:#x}")
    if SIZES.get(found) == entry.size:
        warnings.append(f"[{section}] DataType: is {there}, and {expected} in CiA 402, as which it is used")
        return
    raise EdsError(
        config,
        file,
        f"[{section}] DataType: has this object as {there}, not {expected}",
        entry=entry,
        remedy="Name the EDS of this drive, or map another object.",
    )


def check_device(sdo: SdoDialogue, file: Path) -> None:
    """Check that the drive has every object that is going to be mapped, with the length stated in the EDS.

    Raises:
        EdsError: an object is missing.
        DriveSetupError: an object has another length.
    """
    for entry in sdo.config.mapped_objects:
        try:
            sdo.read(entry)
        except MissingObject as error:
            raise EdsError(
                sdo.config,
                file,
                "the drive does not have this object",
                entry=entry,
                remedy="Name the EDS of this drive and its firmware, or map another object.",
            ) from error


def check_identity(
    config: DriveConfig, file: Path, dictionary: ObjectDictionary, vendor_id: int, product_code: int
) -> None:
    """Compare the EDS with the identity (1018h) of the drive; what the EDS leaves open (absent or 0) is not checked.

    Raises:
        EdsError: the EDS is that of another device.
    """
    information = dictionary.device_information
    for key, in_eds, in_drive in (
        ("VendorNumber", information.vendor_number, vendor_id),
        ("ProductNumber", information.product_number, product_code),
    ):
        if in_eds and in_eds != in_drive:
            raise EdsError(
                config,
                file,
                f"[DeviceInfo] {key} is {in_eds:#x}, but the drive reports {in_drive:#x} (1018h): it belongs to "
                "another device",
                remedy="Name the EDS of this drive under eds in the vehicle file.",
            )
