"""The text of a file: its encoding, by its byte order mark or by what it holds."""

from __future__ import annotations

import codecs
import re

from upright.telemetry.errors import RecordingError

_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_OTHERS = (
    (b"PK\x03\x04", "is an Excel workbook or a zip archive", "Save the sheet as CSV, or unpack it."),
    (b"\xd0\xcf\x11\xe0", "is an Excel workbook", "Save the sheet as CSV."),
    (b"\x1f\x8b", "is compressed", "Unpack it: gunzip FILE."),
    (b"\x89HDF", "is an HDF5 file", "Write the columns as CSV or Parquet."),
    (b"MATLAB 5.0", "is a MAT file", "In MATLAB: writetable(T, 'run.csv')."),
    (b"SQLite format", "is a database", "Write the columns as CSV."),
)
_CONTROL = re.compile(r"[\x00-\x08\x0b\x0e-\x1a\x1c-\x1f]")
"""Characters that are in no text, but for a few that a serial line makes."""
HALF = 0.4
"""Share of zeros among every second byte from which on text is UTF-16 without a mark; ASCII has nearly half."""


def decoded(content: bytes, source: str) -> tuple[str, list[str]]:
    """The text of a file, and what was assumed. Raises RecordingError for content that is no text."""
    said: list[str] = []
    for begin, what, remedy in _OTHERS:
        if content.startswith(begin):
            raise RecordingError(source, "", what, remedy=remedy)
    body, encoding = content, ""
    for mark, name in _MARKS:
        if content.startswith(mark):
            body, encoding = content[len(mark) :], name
            said.append(f"encoding: {name.removesuffix('-le').removesuffix('-be').upper()}, by its byte order mark")
            break
    else:
        encoding = _without_mark(content)
        if encoding:
            said.append(f"encoding: {encoding[:6].upper()}, by its zero bytes")
    if not encoding or encoding == "utf-8":
        rest = body.rstrip(b"\0")
        if len(rest) < len(body):
            said.append(f"{len(body) - len(rest)} zero bytes at the end are left out: the file was not closed")
        body = rest
    text = _text(body, encoding, said)
    if text is None or "\0" in text or len(_CONTROL.findall(text)) > 1 + len(text) // 1000:
        remedy = "Save it as CSV in UTF-8, or give its format by its suffix."
        raise RecordingError(source, "", "is not text", remedy=remedy)
    return text.replace("\r\n", "\n").replace("\r", "\n"), said


def _without_mark(content: bytes) -> str:
    head = content[: 4096 // 2 * 2]
    half = len(head) // 2
    if half < 4:
        return ""
    if head[1::2].count(0) > 2 * HALF * half and head[::2].count(0) == 0:
        return "utf-16-le"
    if head[::2].count(0) > 2 * HALF * half and head[1::2].count(0) == 0:
        return "utf-16-be"
    return ""


def _text(body: bytes, encoding: str, said: list[str]) -> str | None:
    if encoding and encoding != "utf-8":
        return body.decode(encoding, errors="ignore")
    try:
        return body.decode("utf-8")
    except UnicodeDecodeError as error:
        if len(body) - error.start < 4 and "unexpected end" in error.reason:
            return body[: error.start].decode("utf-8")  # cut off inside a character
    try:
        text = body.decode("cp1252")
    except UnicodeDecodeError:
        return None
    said.append("encoding: Windows-1252, since it is not UTF-8")
    return text
