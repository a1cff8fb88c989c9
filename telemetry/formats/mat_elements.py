"""The elements of a MAT file of versions 5 to 7, walked through before scipy reads it.

scipy takes the types of numbers on trust, and calls itself for a cell in a cell: a damaged file, or a very deep one,
would end the interpreter. The order of elements is that of "MAT-File Format" (MathWorks), chapter 1: a tag of 8 bytes
with type and size, then the data, padded to 8 bytes; data of up to 4 bytes may be inside of the tag.
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

HEAD = 128
"""Bytes before the first element of a file, the last two of which state the byte order; 8 in a workspace of objects."""
MATRIX, PACKED, INT32, UINT32 = 14, 15, 5, 6
NUMBERS = frozenset((1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 16, 17, 18))
"""Types of elements that hold numbers or characters."""
CELL, STRUCT, OBJECT, CHARACTERS, SPARSE, FUNCTION, OPAQUE = 1, 2, 3, 4, 5, 16, 17
NUMERIC = range(6, 16)
"""Classes of arrays."""
COMPLEX = 0x800
DEEPEST = 100
"""Cells and structs inside of each other: far more than data need, and far fewer than end scipy (200,000 did)."""
CHUNK = 1 << 16
"""Bytes that are read at a time; the sizes of an array take far less."""


def check(path: Path) -> None:
    """Raises ValueError or zlib.error if the file is damaged, OSError."""
    with path.open("rb") as file:
        _check(file, "<" if file.read(HEAD).endswith(b"IM") else ">")


def check_workspace(content: bytes) -> None:
    """The same for the workspace in which a file keeps its objects."""
    file = io.BytesIO(content)
    _check(file, "<" if file.read(8)[2:4] == b"IM" else ">")


def _check(file: BinaryIO, order: str) -> None:
    while tag := file.read(8):
        kind, size = _unpacked(f"{order}II", tag)
        end = file.tell() + size
        if kind == PACKED:
            whole = io.BufferedReader(_Inflated(file, size), CHUNK)
            _Elements(whole, order).matrix(0)
        elif kind == MATRIX:
            _Elements(file, order).array(0)
        else:
            raise ValueError(f"an element of type {kind} where a variable should be")
        file.seek(end)


@dataclass(slots=True)
class _Elements:
    """The elements of a stream from its place on, in the byte `order` of struct."""

    stream: BinaryIO
    order: str

    def matrix(self, depth: int) -> None:
        """An array with its tag; an empty one is a tag alone."""
        kind, size = _unpacked(f"{self.order}II", self._read(8))
        if kind != MATRIX:
            raise ValueError(f"an element of type {kind} where an array should be")
        if size:
            self.array(depth)

    def array(self, depth: int) -> None:
        """An array after its tag."""
        if depth > DEEPEST:
            raise ValueError(f"more than {DEEPEST} cells or structs inside of each other")
        flags = _unpacked(f"{self.order}8xI4x", self._read(16))[0]
        kind, count = flags & 0xFF, 1
        if kind != OPAQUE:
            count = math.prod(max(0, each) for each in self._integers())
            self._skip_data()  # the name
        if kind in NUMERIC or kind == SPARSE:
            for _ in range((1 if kind in NUMERIC else 3) + bool(flags & COMPLEX)):
                self._numbers()
        elif kind == CHARACTERS:
            self._skip_data()
        elif kind == CELL:
            self._matrices(count, depth)
        elif kind in (STRUCT, OBJECT):
            self._fields(count, depth, named=kind == OBJECT)
        elif kind == FUNCTION:
            self.matrix(depth + 1)
        elif kind == OPAQUE:
            for _ in range(3):  # name, system of types, class
                self._skip_data()
            self.matrix(depth + 1)
        else:
            raise ValueError(f"an array of class {kind}")

    def _fields(self, count: int, depth: int, *, named: bool) -> None:
        if named:
            self._skip_data()
        (length, *more) = self._integers()
        if length < 1 or more:
            raise ValueError("a struct whose names have no length")
        _, size, inside = self._tag()
        self._pass_by(size, inside)
        self._matrices(count * (size // length), depth)

    def _matrices(self, count: int, depth: int) -> None:
        for _ in range(count):
            self.matrix(depth + 1)

    def _numbers(self) -> None:
        kind, size, inside = self._tag()
        if kind not in NUMBERS:
            raise ValueError(f"numbers of type {kind}")
        self._pass_by(size, inside)

    def _integers(self) -> tuple[int, ...]:
        kind, size, inside = self._tag()
        if kind not in (INT32, UINT32) or size > CHUNK:
            raise ValueError(f"sizes of type {kind}")
        data = inside[:size] if inside else self._read(size + -size % 8)[:size]
        return _unpacked(f"{self.order}{size // 4}i", data[: size // 4 * 4])

    def _skip_data(self) -> None:
        _, size, inside = self._tag()
        self._pass_by(size, inside)

    def _tag(self) -> tuple[int, int, bytes]:
        """Type and size of an element, and its data if they are inside of the tag."""
        tag = self._read(8)
        kind, size = _unpacked(f"{self.order}II", tag)
        if kind >> 16:
            return kind & 0xFFFF, kind >> 16, tag[4:]
        return kind, size, b""

    def _pass_by(self, size: int, inside: bytes) -> None:
        if not inside:
            self._skip(size + -size % 8)

    def _skip(self, size: int) -> None:
        if self.stream.seekable():
            self.stream.seek(size, io.SEEK_CUR)
            return
        while size > 0 and (data := self.stream.read(min(size, CHUNK))):
            size -= len(data)

    def _read(self, size: int) -> bytes:
        data = self.stream.read(size)
        if len(data) < size:
            raise ValueError("it ends in the middle of an element")
        return data


class _Inflated(io.RawIOBase):
    """What zlib has packed into the next `size` bytes of a file."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size
        self._inflate = zlib.decompressobj()

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        while True:
            packed = self._inflate.unconsumed_tail
            if not packed:
                packed = self._file.read(min(self._left, CHUNK))
                self._left -= len(packed)
            data = self._inflate.decompress(packed, len(buffer)) if packed else b""
            if data or not packed or self._inflate.eof:
                buffer[: len(data)] = data
                return len(data)


def _unpacked(form: str, data: bytes) -> tuple[int, ...]:
    try:
        return struct.unpack(form, data)
    except struct.error as error:
        raise ValueError("it ends in the middle of an element") from error
