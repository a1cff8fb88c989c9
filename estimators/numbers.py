"""Numbers for people: a value and its standard deviation, rounded to two digits of the deviation, with one unit.

    0.0320 ± 0.0012 N m        1.61 ± 0.15 kN m        (2.74 ± 0.32) × 10^-6 kg m^2

Both have a common SI prefix, or a common power of ten where the unit takes no prefix, if they are smaller than 0.01 or
if their last digit would not be significant. The dashboard has the same rule in service/dashboard/static/numbers.js.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

DIGITS = 2
"""Digits of a standard deviation that are shown."""
WITHOUT = 5
"""Digits of a value that has none."""
SMALL = -2
"""Power of ten of the smallest values that are written without a prefix."""
LARGE = 5
"""Power of ten from which a value without a standard deviation gets a prefix."""
MOST = 12
"""Decimals that are shown, at most."""
PREFIXES = {-12: "p", -9: "n", -6: "µ", -3: "m", 3: "k", 6: "M", 9: "G"}
_PREFIXABLE = re.compile(r"(N|m|s|rad|V|A|W|J|Hz|Pa|ohm|H|F)(?![\w^])")
_ONLY_SMALL = frozenset({"s", "rad"})
"""Units without prefixes for multiples."""


def significant(std: float) -> int:
    """Decimals with which a value of this standard deviation is written: two digits of the deviation."""
    place = _place(std)
    return 3 if place is None else min(max(0, -place), MOST)


@dataclass(frozen=True, slots=True)
class Scale:
    """What the numbers of a table's row or column have in common: a power of ten, and the unit to which it belongs.

    `prefixed`: the power is a prefix of the unit, or 0; otherwise `unit` begins with it, as in `10^-6 kg m^2`.
    """

    power: int
    unit: str
    prefixed: bool

    def pair(self, value: float | None, std: float | None = None) -> tuple[str, str]:
        """`value` and `std` as text: "-" for a value that is unknown, nothing for a deviation that is."""
        if value is None or not math.isfinite(value):
            return "-", ""
        place = _place(std)
        if std is None or place is None:
            return _general(value / 10.0**self.power), ""
        decimals = min(max(0, self.power - place), MOST)
        # If the last digit is left of the decimal point, the digits after it are zeros.
        coarse = max(place, self.power - MOST)
        first, second = (f"{_rounded(each, coarse) / 10.0**self.power:.{decimals}f}" for each in (value, std))
        return first, second

    def text(self, value: float | None, std: float | None = None) -> str:
        """`1.61 ± 0.15`, without the unit."""
        first, second = self.pair(value, std)
        return f"{first} ± {second}" if second else first


def plain(unit: str = "1") -> Scale:
    """The unit as it is, for numbers beside others in that unit."""
    return Scale(0, _bare(unit), prefixed=True)


def common(pairs: Iterable[tuple[float | None, float | None]], unit: str = "1") -> Scale:
    """The scale for several values with their standard deviations, None if unknown."""
    known = [(value, std) for value, std in pairs if value is not None and math.isfinite(value)]
    places = [place for _, std in known if (place := _place(std)) is not None]
    sizes = [abs(value) for value, _ in known] + [
        std for _, std in known if std is not None and _place(std) is not None
    ]
    largest = max(sizes, default=0.0)
    if not 0.0 < largest < math.inf:
        return plain(unit)
    place, lead = min(places, default=None), math.floor(math.log10(largest))
    if lead >= SMALL and (place < 1 if place is not None else lead < LARGE):
        return plain(unit)
    power = 3 * math.floor(lead / 3)
    if place is not None and power < place:
        power += 3
    return _scaled(power, unit)


def with_error(value: float, std: float | None = None, unit: str = "1") -> str:
    """`8.10 ± 0.41 N m`: a value with its standard deviation and its unit, "1" if it has none.

    A standard deviation that is not positive and finite is left out."""
    found = common([(value, std)], unit)
    text = found.text(value, std)
    if found.prefixed:
        return f"{text} {found.unit}".rstrip()
    return f"({text}) × {found.unit}" if "±" in text else f"{text} × {found.unit}"


def about(value: float, unit: str = "1") -> str:
    """`130 N m`: a value of which two digits matter."""
    return with_error(float(f"{value:.{DIGITS}g}"), None, unit)


def _scaled(power: int, unit: str) -> Scale:
    if power == 0:
        return plain(unit)
    prefixable = _PREFIXABLE.match(unit)
    if prefixable and power in PREFIXES and not (power > 0 and prefixable[1] in _ONLY_SMALL):
        return Scale(power, PREFIXES[power] + unit, prefixed=True)
    return Scale(power, f"10^{power} {_bare(unit)}".rstrip(), prefixed=False)


def _bare(unit: str) -> str:
    return "" if unit == "1" else unit


def _place(std: float | None) -> int | None:
    """Power of ten of the last digit of a standard deviation that is shown; None if there is no such digit."""
    if std is None or not 0.0 < std < math.inf:
        return None
    return int(f"{std:.{DIGITS - 1}e}".partition("e")[2]) - (DIGITS - 1)


def _rounded(value: float, place: int) -> float:
    return float(np.round(value, -place))


def _general(value: float) -> str:
    return f"{value:.{WITHOUT}g}"
