"""Electronic data sheets (CiA 306) of drives: read by canopen, checked against what upright is going to use.

The EDS of another device loads without an error, but its names then refer to the wrong objects. So identity and types
are compared before anything is written.
"""

from __future__ import annotations

import configparser
from pathlib import Path

from canopen import ObjectDictionary, import_od
from canopen.objectdictionary import ODVariable

from drivers.cia402.config import DriveConfig, find_eds
from drivers.cia402.objects import CONTROLWORD, MODE, STATUSWORD, ObjectEntry
from drivers.cia402.sdo import DriveSetupError, MissingObject, SdoDialogue

TYPE_NAMES = {2: "INTEGER8", 3: "INTEGER16", 4: "INTEGER32", 5: "UNSIGNED8", 6: "UNSIGNED16", 7: "UNSIGNED32"}


class EdsError(DriveSetupError):
    """An EDS that cannot be used for this drive. `file` names it."""

    def __init__(
        self, config: DriveConfig, file: Path, message: str, *, entry: ObjectEntry | None = None, remedy: str
    ) -> None:
        super().__init__(config, f"eds {str(file)!r}: {message}", entry=entry, remedy=remedy)
        self.file = file


def load(config: DriveConfig) -> tuple[Path, ObjectDictionary]:
    """The EDS or DCF of `config.eds`, for the drive's node id, with every object that is going to be used.

    Raises:
        DriveConfigError: there is no such file.
        EdsError: the file is not an EDS, lacks an object, or has it with another type.
    """
    file = find_eds(config.eds, drive=config.name)
    remedy = "Use the EDS that the drive's maker supplies for this model and firmware."
    try:
        # Latin-1 reads any byte: makers' files come in several encodings, and only names are affected.
        with file.open(encoding="latin-1") as source:
            if not any(line.strip().lower() == "[deviceinfo]" for line in source):
                raise EdsError(config, file, "is not an electronic data sheet: no [DeviceInfo]", remedy=remedy)
            source.seek(0)
            dictionary = import_od(source, config.node)
    except (OSError, ValueError, KeyError, configparser.Error) as error:
        raise EdsError(config, file, f"cannot be read: {error}", remedy=remedy) from error
    for entry in {CONTROLWORD, STATUSWORD, MODE, *config.mapped_objects}:
        _check_entry(config, file, dictionary, entry)
    return file, dictionary


def _check_entry(config: DriveConfig, file: Path, dictionary: ObjectDictionary, entry: ObjectEntry) -> None:
    found = dictionary.get_variable(entry.index, entry.subindex)
    if not isinstance(found, ODVariable):
        raise EdsError(
            config,
            file,
            "the EDS does not have this object",
            entry=entry,
            remedy="Take it out of rpdo and tpdo in the vehicle file, or name the EDS of this drive.",
        )
    if found.data_type != entry.data_type:
        there = TYPE_NAMES.get(found.data_type or 0, f"type {found.data_type}")
        raise EdsError(
            config,
            file,
            f"the EDS has this object as {there}, not {TYPE_NAMES[entry.data_type]}",
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
                "the EDS has this object, but the drive does not",
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
