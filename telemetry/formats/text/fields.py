"""Fields of text as numbers: decimal marks, thousands, holes in every spelling, units beside the number, dates."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from math import nan

import numpy as np
from numpy.typing import NDArray

from upright.telemetry.tables.units import is_unit

_HOLES_TEXT = (
    "|nan|-nan|+nan|nan(ind)|-nan(ind)|1.#qnan|-1.#qnan|1.#ind|-1.#ind|1.#inf|-1.#inf|na|n/a|#n/a|<na>"
    "|null|(null)|nil|none|nat|-|--|---|----|—|–|?|??|.|..|*|**|***|****|missing|undefined|undef|void"
    "|error|err|bad|invalid|overflow|ol|over|#div/0!|#value!|#ref!|#num!|#name?|#null!|9.91e37|+9.91e37"
    "|9.91e+37|+9.91e+37|\\n|n.a.|k.a.|unknown"
)
HOLES = frozenset(_HOLES_TEXT.split("|"))
"""Spellings of a value that is not known, in lower case."""
YES, NO = frozenset(["true", "yes", "on", "ja", "wahr"]), frozenset(["false", "no", "off", "nein", "falsch"])
SENTINELS = (9.91e37, -999.0, -9999.0, -99999.0, 9999.0, 99999.0, 1e30, -1e30, 9.9e37, -9.9e37)
"""Numbers that loggers write for a value that is not known."""
BEYOND = 10.0
"""Ratio of such a number to the largest other value from which on it is one of these."""
HALF = 0.5
"""Share of fields that must be numbers in a column of numbers."""

_NUMBER = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eEdD][+-]?\d+)?$")
_BESIDE = re.compile(
    r"(?P<number>[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)\s*(?P<unit>[^\d\s.,;eE+-]\S*|[eE]\D\S*)$"
)
_CLOCK = r"(?P<hour>\d{1,3}):(?P<minute>\d{2})(?::(?P<second>\d{2})(?:[.,:](?P<part>\d{1,9}))?)?"
_ZONE = r"\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}:?\d{2}|[+-]\d{2})?"
_HALF_DAY = r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?"
_DATES = (
    r"(?P<year>\d{4})[-/.](?P<month>\d{1,2})[-/.](?P<day>\d{1,2})",
    r"(?P<day>\d{1,2})\.(?P<month>\d{1,2})\.(?P<year>\d{2,4})",
    r"(?P<month>\d{1,2})/(?P<day>\d{1,2})/(?P<year>\d{2,4})",
    r"(?P<day>\d{1,2})-(?P<word>[A-Za-z]{3})-(?P<year>\d{2,4})",
    r"(?P<year>\d{4})(?P<month>\d{2})(?P<day>\d{2})",
)
_STAMPS = tuple(re.compile(rf"{each}(?:[T ,_]+\s*{_CLOCK}{_HALF_DAY}{_ZONE})?$") for each in _DATES)
_TIME_OF_DAY = re.compile(rf"(?:(?P<days>\d+) days? )?{_CLOCK}{_HALF_DAY}{_ZONE}$")
_MINUTES = re.compile(r"(?P<minute>\d{1,3}):(?P<second>\d{2})[.,](?P<part>\d{1,9})$")
_MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
_EPOCH = date(1970, 1, 1).toordinal()


@dataclass(frozen=True, slots=True)
class Decimal:
    """How numbers are written: the decimal `mark`, and what groups thousands ("" for nothing)."""

    mark: str = "."
    group: str = ""

    def pointed(self, fields: Sequence[str]) -> Sequence[str]:
        """All `fields` with a decimal point and without groups, by the fastest way."""
        if self == Decimal():
            return fields
        text = "\n".join(field.replace("\n", " ") for field in fields)
        return text.replace(self.group or "\0", "").replace(self.mark, ".").split("\n")

    def plain(self, text: str) -> str:
        """`text` as Python writes numbers."""
        text = text.strip().strip("\"'").replace("\N{MINUS SIGN}", "-").replace("\xa0", " ").replace("\u202f", " ")
        if self.group:
            text = text.replace(self.group, "")
        if self.mark != ".":
            text = text.replace(self.mark, ".")
        return re.sub(r"(?<=\d)[ '’](?=\d{3}(?:\D|$))", "", text)


@dataclass(frozen=True, slots=True)
class Numbers:
    """A column of numbers: `values` (n,), NaN where not known; `exact` int64 (n,) if all are whole numbers or dates.

    `kind` is "number", "date" or "time of day" (both in ns), "yes or no", or "text". `unit` is written beside each.
    `odd` are the fields that could not be read, with their rows, and `sentinels` the number of those like -9999.
    """

    values: NDArray[np.float64]
    kind: str = "number"
    unit: str = ""
    exact: NDArray[np.int64] | None = None
    odd: tuple[tuple[int, str], ...] = ()
    sentinels: int = 0


def is_hole(text: str) -> bool:
    """Whether a field is a spelling of a value that is not known."""
    return text.strip().lower() in HOLES


def is_number(text: str, decimal: Decimal) -> bool:
    """Whether a field is a number, with or without its unit, a date or a truth value."""
    plain = decimal.plain(text)
    if _NUMBER.match(plain):
        return True
    if plain.lower() in ("inf", "+inf", "-inf", "infinity", "-infinity"):
        return True
    found = _BESIDE.match(plain)
    return bool(found and is_unit(found["unit"])) or stamp_ns(text) is not None


def decimal_of(fields: Sequence[str], separator: str) -> Decimal:
    """How `fields` write their numbers."""
    comma = [each.strip() for each in fields if "," in each]
    if not comma:
        several = any(re.fullmatch(r"[+-]?\d{1,3}(\.\d{3}){2,}", each.strip()) for each in fields)
        return Decimal(",", ".") if several else Decimal()
    both = [each for each in comma if "." in each and re.fullmatch(r"[+-]?[\d.,]+", each)]
    if both:
        last = Counter("," if each.rfind(",") > each.rfind(".") else "." for each in both)
        return Decimal(",", ".") if last[","] > last["."] else Decimal(".", ",")
    plain = [each for each in comma if re.fullmatch(r"[+-]?\d+(,\d+)+([eE][+-]?\d+)?", each)]
    grouped = [each for each in plain if re.fullmatch(r"[+-]?[1-9]\d{0,2}(,\d{3})+", each)]
    dotted = any("." in each for each in fields if re.fullmatch(r"[+-]?\d*\.\d+", each.strip()))
    if plain and len(grouped) == len(plain) and (dotted or separator == ","):
        return Decimal(".", ",")
    return Decimal(".", ",") if dotted and not plain else Decimal("," if plain else ".")


def numbers(fields: Sequence[str], decimal: Decimal) -> Numbers:
    """A column of text as numbers. `kind` is "text" if less than half of what it holds are numbers."""
    texts = decimal.pointed(fields)
    found = _quickly(texts)
    if found is not None:
        return found
    values = np.full(len(fields), nan)
    units: Counter[str] = Counter()
    odd: list[tuple[int, str]] = []
    truth = holes = 0
    for row, (text, field) in enumerate(zip(texts, fields, strict=True)):
        if (plain := _float(text)) is not None:
            values[row] = plain
            holes += plain != plain
            continue
        if is_hole(field):
            holes += 1
            continue
        value, unit = _value(field.strip(), decimal)
        if value is None:
            odd.append((row, field.strip()))
            continue
        if unit == "yes or no":
            truth += 1
        elif unit:
            units[unit] += 1
        values[row] = value
    filled = len(fields) - holes
    if filled == 0:
        return Numbers(values, kind="text")
    if len(odd) > HALF * filled:
        return _dates(fields, len(odd)) or Numbers(values, kind="text", odd=tuple(odd))
    kind = "yes or no" if truth > HALF * filled else "number"
    unit = units.most_common(1)[0][0] if sum(units.values()) > HALF * filled else ""
    return Numbers(values, kind, unit, _exact(texts) if not (odd or holes) else None, tuple(odd), _sentinels(values))


def stamp_ns(text: str) -> int | None:
    """A date, or a time of day, as ns; None if `text` is none."""
    text = text.strip()
    for pattern in (*_STAMPS, _TIME_OF_DAY, _MINUTES):
        found = pattern.match(text)
        if found:
            try:
                return _ns(found.groupdict())
            except (ValueError, OverflowError):
                return None
    return None


def _quickly(texts: Sequence[str]) -> Numbers | None:
    """Plain numbers only, by the fastest way."""
    if any("_" in each for each in texts):
        return None
    try:
        values = np.array(list(map(float, texts)), dtype=np.float64)
    except ValueError:
        return None
    return Numbers(values, exact=_exact(texts), sentinels=_sentinels(values))


def _float(text: str) -> float | None:
    try:
        return float(text) if "_" not in text else None
    except ValueError:
        return None


def _exact(texts: Sequence[str]) -> NDArray[np.int64] | None:
    """Whole numbers as they are: a float has no ns of this century."""
    if not texts or not texts[0].strip().lstrip("+-").isdigit():
        return None
    try:
        return np.array(list(map(int, texts)), dtype=np.int64)
    except (ValueError, OverflowError):
        return None


def _value(text: str, decimal: Decimal) -> tuple[float | None, str]:
    plain = decimal.plain(text)
    if _NUMBER.match(plain):
        return float(plain.replace("d", "e").replace("D", "e")), ""
    word = plain.lower()
    if word in YES or word in NO:
        return float(word in YES), "yes or no"
    if word.lstrip("+-") in ("inf", "infinity"):
        return float(word), ""
    found = _BESIDE.match(plain)
    if found and is_unit(found["unit"]):
        return float(found["number"]), found["unit"]
    return None, ""


def _sentinels(values: NDArray[np.float64]) -> int:
    """Numbers far beyond all others that stand for unknown values are made NaN, in place. Their count."""
    count = 0
    for mark in SENTINELS:
        at = values == mark
        if not at.any() or at.all():
            continue
        others = np.abs(values[~at & np.isfinite(values)])
        if len(others) and abs(mark) > BEYOND * float(np.max(others)):
            values[at] = nan
            count += int(np.count_nonzero(at))
    return count


def _dates(fields: Sequence[str], most: int) -> Numbers | None:
    """A column of dates or of times of day."""
    stamps, odd = np.zeros(len(fields), dtype=np.int64), []
    for row, field in enumerate(fields):
        found = stamp_ns(field)
        if found is not None:
            stamps[row] = found
        elif is_hole(field):
            odd.append(row)
        else:
            odd.append(row)
            if len(odd) > max(HALF * len(fields), 20):
                return None
    if len(odd) > HALF * len(fields):
        return None
    values = stamps.astype(np.float64)
    values[odd] = nan
    first = next(each for row, each in enumerate(fields) if row not in set(odd))
    kind = "date" if any(pattern.match(first.strip()) for pattern in _STAMPS) else "time of day"
    unread = tuple((row, fields[row].strip()) for row in odd if not is_hole(fields[row]))
    return Numbers(values, kind, "ns", None if odd else stamps, unread)


def _ns(parts: dict[str, str | None]) -> int:
    day = 0
    if parts.get("year"):
        year = int(parts["year"] or 0)
        month = _MONTHS.index((parts.get("word") or "").lower()) + 1 if parts.get("word") else int(parts["month"] or 0)
        number = int(parts["day"] or 0)
        if month > 12 >= number:
            month, number = number, month
        day = date(year + 2000 if year < 100 else year, month, number).toordinal() - _EPOCH
    hour = int(parts.get("hour") or 0)
    half = (parts.get("half") or "").lower().replace(".", "")
    if half:
        hour = hour % 12 + (12 if half == "pm" else 0)
    seconds = 60 * (60 * hour + int(parts.get("minute") or 0)) + int(parts.get("second") or 0)
    part = (parts.get("part") or "").ljust(9, "0")
    day += int(parts.get("days") or 0)
    return (86_400 * day + seconds - _offset(parts.get("zone"))) * 1_000_000_000 + int(part or 0)


def _offset(zone: str | None) -> int:
    """s east of Greenwich."""
    if not zone or zone in ("Z", "UTC", "GMT"):
        return 0
    digits = zone[1:].replace(":", "").ljust(4, "0")
    return (1 if zone[0] == "+" else -1) * 60 * (60 * int(digits[:2]) + int(digits[2:]))
