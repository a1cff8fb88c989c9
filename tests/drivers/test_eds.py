"""Electronic data sheets as makers ship them: each fault is repaired and said, or refused with section and key.

Every fault is put into the shipped upright_servo.eds, one at a time. What matters of the result is the same as that of
the file without it: identity, and index, type and length of every object that is mapped.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from canopen.objectdictionary import ODArray, ODRecord, ODVariable

from upright.drivers.cia301.eds_text import number_of
from upright.drivers.cia402 import eds
from upright.drivers.cia402.config import SHIPPED_EDS, DriveConfig
from upright.drivers.cia402.eds import EdsError

TEXT = (SHIPPED_EDS / "upright_servo.eds").read_text()
DRIVE = DriveConfig(
    name="left",
    role="wheel",
    node=10,
    direction=1,
    axis_per_turn=6.28,
    mode=9,
    increments_per_turn=4096,
    velocity_unit_rpm=1.0,
    rated_torque=1.0,
    rpdo=(("controlword", "target_velocity"),),
    tpdo=(("statusword", "velocity_actual"), ("position_actual", "torque_actual")),
)


def section(name: str) -> str:
    """A section of the shipped sheet."""
    found = re.search(rf"\[{name}\]\n(?:.+\n)+", TEXT)
    assert found is not None
    return found.group(0)


def without(key: str, name: str) -> str:
    return changed(key, None, name)


def changed(key: str, value: str | None, name: str) -> str:
    """The sheet with the value of one key changed, or the key left out."""
    old = section(name)
    line = "" if value is None else f"{key}={value}\n"
    new, count = re.subn(rf"^{key}=.*\n", lambda _: line, old, count=1, flags=re.MULTILINE)
    assert count == 1, key
    return TEXT.replace(old, new)


def added(text: str) -> str:
    return f"{TEXT}\n{text}\n"


def variable(index: str, **keys: str) -> str:
    lines = {
        "ParameterName": "x",
        "ObjectType": "0x7",
        "DataType": "0x0007",
        "AccessType": "rw",
        "PDOMapping": "0",
        **keys,
    }
    return added("\n".join([f"[{index}]", *(f"{key}={value}" for key, value in lines.items())]))


@dataclass(frozen=True)
class Fault:
    """A sheet with one fault. `warning`: pattern of what is said of it, "" for nothing; `refused`: of the refusal."""

    name: str
    content: str | bytes
    warning: str = ""
    refused: str = ""


FAULTS = [
    Fault("none", TEXT),
    Fault("VendorNumber=0x", changed("VendorNumber", "0x", "DeviceInfo"), r"\[DeviceInfo\] VendorNumber: '0x' is no"),
    Fault(
        "VendorNumber empty", changed("VendorNumber", "", "DeviceInfo"), r"\[DeviceInfo\] VendorNumber: '' is no number"
    ),
    Fault("VendorNumber in words", changed("VendorNumber", "see CiA", "DeviceInfo"), r"VendorNumber: 'see CiA' is no"),
    Fault("BaudRate empty", changed("BaudRate_1000", "", "DeviceInfo")),
    Fault("NrOfRXPDO in words", changed("NrOfRXPDO", "four", "DeviceInfo")),
    Fault("PDOMapping empty", changed("PDOMapping", "", "1001")),
    Fault(
        "PDOMapping in words",
        changed("PDOMapping", "optional", "1001"),
        r"\[1001\] PDOMapping: 'optional' is no number",
    ),
    Fault("UTF-16", TEXT.encode("utf-16")),
    Fault("UTF-16 without a mark", TEXT.encode("utf-16-le")),
    Fault("UTF-8 with a mark", TEXT.encode("utf-8-sig")),
    Fault("Windows' code page", TEXT.replace("ProductName=", "ProductName=Für ", 1).encode("cp1252")),
    Fault("CRLF", TEXT.replace("\n", "\r\n")),
    Fault("the line ends of old Macs", TEXT.replace("\n", "\r")),
    Fault("end-of-file of DOS", TEXT.encode() + b"\x1a\0\0"),
    Fault("a key twice, equal", TEXT.replace(section("1001"), section("1001") + "AccessType=ro\n")),
    Fault(
        "a key twice",
        TEXT.replace(section("1001"), section("1001") + "AccessType=rw\n"),
        r"\[1001\] AccessType: is there",
    ),
    Fault("a section twice", added(section("1001")), r"\[1001\] is there twice"),
    Fault("comments of too few lines", added("[Comments]\nLines=5\nLine1=made by hand")),
    Fault("comments of many kinds", "# a\n; b\n// c\n" + TEXT),
    Fault("a comment behind a value", changed("DataType", "0x0006 ; UNSIGNED16", "6041")),
    Fault("a comment behind a section", TEXT.replace("[6041]", "[6041] ; statusword")),
    Fault("DataType missing", without("DataType", "6041"), r"\[6041\] DataType: is missing"),
    Fault("DataType by name", changed("DataType", "UNSIGNED16", "6041")),
    Fault("DataType 0", changed("DataType", "0", "1001"), r"\[1001\] DataType: is '0', which is no type"),
    Fault("DataType of the maker's own", variable("2000", DataType="0x00A0") + "\n[A0sub1]\nDefaultValue=0x6\n"),
    Fault(
        "DataType of the maker's own, missing", variable("2000", DataType="0x00A0"), r"\[2000\] DataType: is '0x00A0'"
    ),
    Fault(
        "the same length, another sign",
        changed("DataType", "0x0003", "6041"),
        r"\[6041\] DataType: is INTEGER16, and UN",
    ),
    Fault(
        "another length",
        changed("DataType", "0x0003", "606C"),
        refused=r"\[606C\] DataType: .* INTEGER16, not INTEGER32",
    ),
    Fault("ObjectType missing", without("ObjectType", "1001")),
    Fault(
        "ObjectType missing of a record",
        without("ObjectType", "1018"),
        r"\[1018\] ObjectType: is '': taken as a record",
    ),
    Fault("ObjectType by name", changed("ObjectType", "RECORD", "1018")),
    Fault("a record as an array", changed("ObjectType", "0x8", "1018")),
    Fault("AccessType missing", without("AccessType", "1001"), r"\[1001\] AccessType: is missing: taken as rw"),
    Fault("AccessType unknown", changed("AccessType", "on1000", "1001"), r"\[1001\] AccessType: is 'on1000'"),
    Fault("ParameterName missing", without("ParameterName", "1001"), r"\[1001\] ParameterName: is missing"),
    Fault("ParameterName missing, needed", without("ParameterName", "6040"), r"\[6040\] ParameterName: is missing"),
    Fault("% in a value", changed("ParameterName", "Rate of 100%(max)s", "1001")),
    Fault("= in a value", changed("ParameterName", "a = b : c", "1001")),
    Fault("DefaultValue out of range", changed("DefaultValue", "0x1FF", "1001")),
    Fault(
        "DefaultValue in words",
        changed("DefaultValue", "see manual", "1001"),
        r"\[1001\] DefaultValue: 'see manual' is no",
    ),
    Fault("LowLimit in words", TEXT.replace(section("1001"), section("1001") + "LowLimit=-\nHighLimit=\n")),
    Fault(
        "a line without a value",
        TEXT.replace(section("1001"), section("1001") + "reserved\n"),
        r"\[1001\] 'reserved' is no",
    ),
    Fault("section in small letters", TEXT.replace("[606C]", "[606c]")),
    Fault("section with blanks", TEXT.replace("[6041]", "[ 6041 ]")),
    Fault("section with 0x", TEXT.replace("[6041]", "[0x6041]")),
    Fault("section without its bracket", TEXT.replace("[6041]", "[6041")),
    Fault("subindices in capitals", re.sub(r"\[1018sub", "[1018SUB", TEXT)),
    Fault("subindices with two digits", re.sub(r"\[1018sub(\d)\]", r"[1018sub0\1]", TEXT)),
    Fault("subindices without their parent", TEXT.replace(section("1018"), ""), r"\[1018\] is missing, though it has"),
    Fault("[DeviceInfo] missing", TEXT.replace("[DeviceInfo]", "[DeviceInformation]"), r"\[DeviceInfo\] is missing"),
    Fault("[DummyUsage] in part", re.sub(r"Dummy000[1-7]=\d\n", "", TEXT)),
    Fault(
        "an object that is needed missing", TEXT.replace("[60FF]", "[61FF]"), r"\[60FF\] \(target_velocity\) is missing"
    ),
    Fault("text behind the last section", added("# end of file\nthe end"), "'the end' is no key with a value"),
    Fault("no data sheet", "hello\n", refused="is not an electronic data sheet: it has no section"),
    Fault("a picture", bytes(range(256)) * 9, refused="is not an electronic data sheet"),
    Fault("empty", "", refused="is not an electronic data sheet"),
]


def loaded(folder: Path, content: str | bytes) -> tuple[eds.ObjectDictionary, list[str]]:
    path = folder / "drive.eds"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    warnings: list[str] = []
    return eds.load(replace(DRIVE, eds=str(path)), warnings)[1], warnings


@pytest.mark.parametrize("fault", [each for each in FAULTS if not each.refused], ids=lambda fault: fault.name)
def test_fault_is_repaired_and_said(fault: Fault, tmp_path: Path) -> None:
    dictionary, warnings = loaded(tmp_path, fault.content)
    if fault.warning:
        (warning,) = warnings
        assert re.search(fault.warning, warning)
    else:
        assert warnings == []
    whole, _ = loaded(tmp_path, TEXT)
    assert set(whole) - set(dictionary) <= {0x60FF}
    for entry in DRIVE.mapped_objects:
        found = dictionary.get_variable(entry.index, entry.subindex)
        assert found is None or found.data_type in (entry.data_type, 0x0F, 0x03)
    identity = dictionary[0x1018]
    assert isinstance(identity, ODRecord | ODArray)
    assert identity[1].default == whole[0x1018][1].default
    if "Vendor" not in fault.name and "Device" not in fault.name:
        assert dictionary.device_information.vendor_number == 0x555052
    assert dictionary.device_information.product_number in (0x402, None)


@pytest.mark.parametrize("fault", [each for each in FAULTS if each.refused], ids=lambda fault: fault.name)
def test_fault_is_refused_with_section_key_and_remedy(fault: Fault, tmp_path: Path) -> None:
    with pytest.raises(EdsError, match=fault.refused) as caught:
        loaded(tmp_path, fault.content)
    assert caught.value.remedy
    assert caught.value.file == tmp_path / "drive.eds"


@pytest.mark.parametrize(
    ("text", "number"),
    [
        ("31", 31), ("0x1F", 31), ("0X1f", 31), ("1Fh", 31), ("16#1F", 31), ("001", 1), ("010", 8), ("008", 8),
        ("-1", -1), ("0x1FL", 31), ("true", 1), ("", None), ("0x", None), ("see manual", None), ("-", None),
        ("$NODEID+0x200", 0x20A), ("0x200+$NODEID", 0x20A), (" $nodeid + 0x200 ", 0x20A), ("$NodeID + 512", 0x20A),
        ("NODEID+200h", 0x20A), ("($NODEID+0x200)", 0x20A), ("$NODEID+0x200+0x40000000", 0x4000020A),
        ("$NODEID | 0x200", 0x20A), ("$NODE_ID+0x200", 0x20A), ("$NODEID", 10), ('"$NODEID+0x200"', 0x20A),
        ("$NODEID*2", None), ("$NODEID+", None), ("9" * 5000, None),
    ],
)  # fmt: skip
def test_numbers_in_every_notation(text: str, number: int | None) -> None:
    assert number_of(text, 10) == number


@pytest.mark.parametrize("formula", ["$NODEID+0x200", "$nodeid + 200h", "0x200+$NODEID ; RPDO1", "$NodeId+512"])
def test_node_id_formula_has_its_value(formula: str, tmp_path: Path) -> None:
    found = loaded(tmp_path, variable("2000", DefaultValue=formula))[0][0x2000]
    assert isinstance(found, ODVariable)
    assert found.default == 0x20A


def test_array_in_short_is_written_out(tmp_path: Path) -> None:
    short = variable("2000", ObjectType="0x8", CompactSubObj="3", DataType="0x0006", DefaultValue="7")
    dictionary, warnings = loaded(
        tmp_path, f"{short}\n[2000Name]\nNrOfEntries=1\n2=second\n[2000Value]\nNrOfEntries=1\n3=0x2A\n"
    )
    assert warnings == []
    array = dictionary[0x2000]
    assert isinstance(array, ODArray)
    assert [array[place].name for place in range(4)] == ["Number of entries", "x1", "second", "x3"]
    assert [array[place].data_type for place in range(4)] == [5, 6, 6, 6]
    assert (array[0].default, array[1].default, array[3].value) == (3, 7, 0x2A)


def test_equal_repairs_are_one_sentence(tmp_path: Path) -> None:
    text = TEXT
    for name in ("1001", "6041", "606C"):
        text = text.replace(section(name), re.sub(r"AccessType=.*\n", "", section(name)))
    _, warnings = loaded(tmp_path, text)
    assert warnings == ["[1001] (and 2 more) AccessType: is missing: taken as rw"]
