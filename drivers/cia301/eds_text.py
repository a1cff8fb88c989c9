"""The text of an electronic data sheet (EDS, DCF; CiA 306) as makers ship it, put right for canopen's reader.

Makers write these files by hand and with many tools: in several encodings, with keys twice, empty, missing or in other
words, numbers in any notation, sections in capitals or without their parent, arrays in short (CompactSubObj). Nothing
of that keeps canopen from reading an object that is all right. Each repair is stated with section and key.
"""

from __future__ import annotations

import codecs
import re
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field

DOMAIN, VAR, ARRAY, RECORD = 0x2, 0x7, 0x8, 0x9
OBJECT_TYPES = {"DOMAIN": DOMAIN, "VAR": VAR, "ARR": ARRAY, "ARRAY": ARRAY, "REC": RECORD, "RECORD": RECORD}
DATA_TYPES = {
    "BOOLEAN": 0x01,
    "INTEGER8": 0x02,
    "INTEGER16": 0x03,
    "INTEGER32": 0x04,
    "UNSIGNED8": 0x05,
    "UNSIGNED16": 0x06,
    "UNSIGNED32": 0x07,
    "REAL32": 0x08,
    "VISIBLE_STRING": 0x09,
    "OCTET_STRING": 0x0A,
    "UNICODE_STRING": 0x0B,
    "DOMAIN": 0x0F,
    "REAL64": 0x11,
    "INTEGER64": 0x15,
    "UNSIGNED64": 0x1B,
}
"""By the names of CiA 301."""

UNKNOWN_TYPE = DATA_TYPES["DOMAIN"]
"""Of an object whose type the sheet does not give: only its bytes are known."""

LAST_TYPE = 0x1B
"""Of the basic data types; the makers' own are above."""

LAST_OF_TYPES = 0x0FFF
"""Indices up to here describe data types."""

UNSIGNED8 = 0x05

INTEGERS = (*range(0x01, 0x08), 0x10, *range(0x12, 0x17), *range(0x18, LAST_TYPE + 1))
ACCESS = ("ro", "wo", "rw", "rwr", "rww", "const")
LAST_SUBINDEX = 0xFE

SECTION = re.compile(r"\[\s*([^\]]*?)\s*\]?\s*(?:[;#].*)?$")
OBJECT = re.compile(
    r"(?:0x)?([0-9a-f]{2,4})h?(?:\s*sub\s*(?:0x)?([0-9a-f]{1,2})h?|\s*(name|value|denotation))?", re.IGNORECASE
)
COMMENT = re.compile(r"\s*(?:;|//|\s#).*$")
NODE_ID = re.compile(r"\$?\bNODE_?ID\b", re.IGNORECASE)
TERM = re.compile(r"\s*([+|-]?)\s*([^\s+|-]+)")

KEYS = (
    *("ParameterName", "ObjectType", "DataType", "AccessType", "DefaultValue", "ParameterValue", "PDOMapping"),
    *("CompactSubObj", "VendorName", "VendorNumber", "ProductName", "ProductNumber", "RevisionNumber"),
)
SPELLINGS = {key.lower(): key for key in KEYS}
"""Keys that are used here, by their spelling in small letters."""


class NoDataSheet(ValueError):
    """The file is not an electronic data sheet."""


@dataclass(slots=True)
class _Object:
    """The sections of one index: its own, and those of its subindices."""

    own: dict[str, str] | None = None
    subs: dict[int, dict[str, str]] = field(default_factory=dict)
    lists: dict[str, dict[str, str]] = field(default_factory=dict)
    """Names and values of an array in short, by "name" and "value"."""


class DataSheet:
    """A data sheet for one node id. `text` is what canopen reads; `warnings` are the repairs, in words.

    Raises:
        NoDataSheet: there is no object in it.
    """

    def __init__(self, data: bytes, node: int) -> None:
        self._node = node
        self._repairs: defaultdict[tuple[str, str], list[str]] = defaultdict(list)
        """Sections by key and what was done."""
        self._device: dict[str, str] = {}
        self._objects: defaultdict[int, _Object] = defaultdict(_Object)
        self._read(_decoded(data))
        if not self._objects:
            raise NoDataSheet("is not an electronic data sheet: it has no section of an object, such as [6041]")
        if not self._device:
            self._repair("DeviceInfo", "", "is missing: vendor and product are not compared")
        self.text = "\n".join([*self._device_lines(), *self._object_lines(), ""])

    @property
    def warnings(self) -> tuple[str, ...]:
        """`[1001] PDOMapping: '' is no number: left out`, with equal ones in one sentence."""
        found = []
        for (key, what), sections in self._repairs.items():
            more = f" (and {len(sections) - 1} more)" if len(sections) > 1 else ""
            found.append(f"[{sections[0]}]{more} {key}{': ' if key else ''}{what}")
        return tuple(found)

    def _repair(self, section: str, key: str, what: str) -> None:
        self._repairs[key, what].append(section)

    # Lines to sections

    def _read(self, text: str) -> None:
        name, section = "", {}
        for line in text.splitlines():
            line = line.strip("\0\x1a\ufeff \t")
            if not line or line[0] in ";#" or line.startswith("//"):
                continue
            header = SECTION.match(line) if line[0] == "[" else None
            if header is not None:
                name = header[1]
                section = self._section(name)
                continue
            key, separator, value = line.partition("=") if "=" in line else line.partition(":")
            key = SPELLINGS.get(key.strip().lower(), key.strip())
            if not separator:
                if name and self._is_used(section):
                    self._repair(name, "", f"{line[:40]!r} is no key with a value: left out")
            elif key in section and section[key] != value.strip():
                self._repair(name, key, "is there twice: the first is taken")
            else:
                section.setdefault(key, value.strip())

    def _section(self, name: str) -> dict[str, str]:
        """Where the keys of a section go. Those that nothing here reads are dropped."""
        if name.lower().replace(" ", "") == "deviceinfo":
            return self._device
        found = OBJECT.fullmatch(name)
        if found is None:
            return {}
        entry = self._objects[int(found[1], 16)]
        if found[2]:
            return entry.subs.setdefault(int(found[2], 16), {})
        if found[3]:
            return entry.lists.setdefault("value" if found[3].lower() == "value" else "name", {})
        if entry.own is not None:
            self._repair(f"{int(found[1], 16):04X}", "", "is there twice: the keys of both are taken")
        entry.own = entry.own if entry.own is not None else {}
        return entry.own

    def _is_used(self, section: dict[str, str]) -> bool:
        return section is self._device or any(
            section is each.own or any(section is sub for sub in each.subs.values()) for each in self._objects.values()
        )

    # Sections to lines

    def _device_lines(self) -> Iterator[str]:
        yield "[DeviceInfo]"
        for key in ("VendorName", "ProductName"):
            yield f"{key}={_one_line(self._device.get(key, ''))}"
        for key in ("VendorNumber", "ProductNumber", "RevisionNumber"):
            if key in self._device and (number := self._number("DeviceInfo", key, self._device[key])) is not None:
                yield f"{key}={number:#x}"

    def _object_lines(self) -> Iterator[str]:
        for index, entry in sorted(self._objects.items(), key=lambda each: each[0]):
            section = f"{index:04X}"
            if index <= LAST_OF_TYPES:
                continue
            own = entry.own
            if own is None:
                if not entry.subs:
                    continue
                self._repair(section, "", "is missing, though it has subindices")
                own = {"ParameterName": section, "ObjectType": f"{RECORD:#x}"}
            kind = self._object_type(section, own, entry)
            yield f"[{section}]"
            yield f"ParameterName={self._name(section, own)}"
            yield f"ObjectType={kind:#x}"
            if kind in (VAR, DOMAIN):
                yield from self._variable(section, own)
                continue
            for subindex, sub in sorted({**self._compact(section, own, entry), **entry.subs}.items()):
                yield f"[{section}sub{subindex:X}]"
                yield f"ParameterName={self._name(f'{section}sub{subindex:X}', sub)}"
                yield "ObjectType=0x7"
                yield from self._variable(f"{section}sub{subindex:X}", sub)

    def _object_type(self, section: str, own: dict[str, str], entry: _Object) -> int:
        text = _bare(own.get("ObjectType", ""))
        kind = OBJECT_TYPES.get(text.upper()) or number_of(text)
        several = bool(entry.subs) or bool(number_of(_bare(own.get("CompactSubObj", ""))))
        if kind in (ARRAY, RECORD) or (kind in (VAR, DOMAIN) and not several):
            return ARRAY if kind == ARRAY else RECORD if kind == RECORD else VAR
        if text or several:
            self._repair(section, "ObjectType", f"is {text!r}: taken as {'a record' if several else 'a variable'}")
        return RECORD if several else VAR

    def _name(self, section: str, keys: dict[str, str]) -> str:
        name = _one_line(keys.get("ParameterName", ""))
        if not name:
            self._repair(section, "ParameterName", "is missing")
        return name or section

    def _variable(self, section: str, keys: dict[str, str]) -> Iterator[str]:
        kind = self._data_type(section, keys)
        yield f"DataType={kind:#06x}"
        yield f"AccessType={self._access(section, keys)}"
        mapping = self._number(section, "PDOMapping", keys["PDOMapping"]) if _bare(keys.get("PDOMapping", "")) else 0
        yield f"PDOMapping={int(bool(mapping))}"
        for key in ("DefaultValue", "ParameterValue"):
            text = keys.get(key, "")
            if kind not in INTEGERS:
                if text:
                    yield f"{key}={_one_line(text)}"
            elif _bare(text) and (value := self._number(section, key, text)) is not None:
                yield f"{key}={value:#x}"

    def _data_type(self, section: str, keys: dict[str, str]) -> int:
        text = _bare(keys.get("DataType", ""))
        kind = DATA_TYPES.get(text.upper().replace(" ", "")) or number_of(text)
        if kind is not None and kind > LAST_TYPE:  # a type of the maker's own, described like an object
            own = self._objects.get(kind)
            kind = number_of(_bare(own.subs.get(1, {}).get("DefaultValue", ""))) if own is not None else None
        if kind is None or not 0 < kind <= LAST_TYPE:
            self._repair(section, "DataType", f"is {text!r}, which is no type: unknown" if text else "is missing")
            return UNKNOWN_TYPE
        return kind

    def _access(self, section: str, keys: dict[str, str]) -> str:
        text = _bare(keys.get("AccessType", "")).lower()
        if text not in ACCESS:
            self._repair(section, "AccessType", f"is {text!r}: taken as rw" if text else "is missing: taken as rw")
            return "rw"
        return text

    def _number(self, section: str, key: str, text: str) -> int | None:
        """A number or a formula with the node id; None, with a warning, if it is neither."""
        value = number_of(_bare(text), self._node)
        if value is None:
            self._repair(section, key, f"{_bare(text)[:40]!r} is no number: left out")
        return value

    def _compact(self, section: str, own: dict[str, str], entry: _Object) -> dict[int, dict[str, str]]:
        """The subindices of an array in short, which all are like its own section."""
        text = _bare(own.get("CompactSubObj", ""))
        count = (self._number(section, "CompactSubObj", text) or 0) if text else 0
        if not count:
            return {}
        name = own.get("ParameterName", section)
        count = min(count, LAST_SUBINDEX)
        first = {"ParameterName": "Number of entries", "DataType": f"{UNSIGNED8:#x}", "AccessType": "ro",
                 "DefaultValue": str(count)}  # fmt: skip
        subs = {0: first}
        for subindex in range(1, count + 1):
            sub = {**own, "ParameterName": entry.lists.get("name", {}).get(str(subindex), f"{name}{subindex}")}
            value = entry.lists.get("value", {}).get(str(subindex))
            subs[subindex] = sub if value is None else {**sub, "ParameterValue": value}
        return subs


def number_of(text: str, node: int = 0) -> int | None:
    """A number in any notation of makers, or a sum of such and `$NODEID`; None if it is none.

    `0x1F`, `1Fh`, `$1F`, `16#1F`, `1F`, or octal with a leading zero, as in CiA 306.
    """
    text = NODE_ID.sub(str(node), text).strip("\"' ()")
    terms = TERM.findall(text)
    if not terms or "".join("".join(term) for term in terms) != re.sub(r"\s", "", text):
        return None
    total = 0
    for sign, word in terms:
        value = _plain(word.strip("()"))
        if value is None:
            return None
        total = total | value if sign == "|" else total - value if sign == "-" else total + value
    return total


def _plain(word: str) -> int | None:
    word = word.rstrip("uUlL") or word
    for pattern, base in (
        (r"0x([0-9a-f]+)", 16),
        (r"\$([0-9a-f]+)", 16),
        (r"16#([0-9a-f]+)", 16),
        (r"([0-9a-f]+)h", 16),
        (r"0b([01]+)", 2),
        (r"0([0-7]+)", 8),
        (r"(\d+)(?:\.0*)?", 10),
        (r"([0-9a-f]*[a-f][0-9a-f]*)", 16),
    ):
        found = re.fullmatch(pattern, word, re.IGNORECASE | re.ASCII)
        if found is not None and len(found[1]) <= 40:
            return int(found[1], base)
    return {"true": 1, "false": 0, "yes": 1, "no": 0}.get(word.lower())


def _bare(text: str) -> str:
    """A value without the comment behind it."""
    return COMMENT.sub("", f" {text}").strip(" \t\"'")


def _one_line(text: str) -> str:
    """A name without the comment behind it, as canopen's reader takes it."""
    return text.split(" ;")[0].replace(";", ",").strip(' "')


def _decoded(data: bytes) -> str:
    """Text in UTF-8, UTF-16 or the code page of Western Windows."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", "replace")
    zeros = data[:200].count(0)
    if 4 * zeros > len(data[:200]):
        return data.decode("utf-16-be" if data[:1] == b"\0" else "utf-16-le", "replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", "replace")
