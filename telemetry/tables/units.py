"""Units as people write them, and their factors to SI."""

from __future__ import annotations

import re
from dataclasses import dataclass
from math import pi

GRAVITY = 9.80665
"""m/s^2, standard gravity."""


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit: a value in it times `factor` is in `si`."""

    si: str
    factor: float


_SPELLINGS: dict[tuple[str, float], str] = {
    ("s", 1.0): "s sec secs second seconds sekunde sekunden",
    ("s", 1e-3): "ms msec msecs millis millisec millisecond milliseconds",
    ("s", 1e-6): "us µs usec usecs micros microsec microsecond microseconds",
    ("s", 1e-9): "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds",
    ("s", 60.0): "min mins minute minutes",
    ("s", 3600.0): "h hr hrs hour hours",
    ("s", 86400.0): "d day days",
    ("rad", 1.0): "rad rads radian radians",
    ("rad", 1e-3): "mrad",
    ("rad", pi / 180.0): "deg degs degree degrees ° grad°",
    ("rad", 2.0 * pi): "rev revs revolution revolutions turn turns",
    ("rad/s", 1.0): "rad/s rads/s rad/sec radps rad_s rad.s-1 rads-1 rad*s-1",
    ("rad/s", pi / 180.0): "deg/s degs/s deg/sec degree/s degrees/s degps dps deg_s °/s °/sec",
    ("rad/s", 2.0 * pi / 60.0): "rpm u/min 1/min min-1 rev/min r/min",
    ("rad/s", 2.0 * pi): "rev/s rps turns/s",
    ("rad/s^2", 1.0): "rad/s2 rad/s^2 rad/s/s",
    ("rad/s^2", pi / 180.0): "deg/s2 deg/s^2 deg/s/s °/s2 °/s^2",
    ("m", 1.0): "m meter meters metre metres",
    ("m", 1e-3): "mm millimeter millimeters millimetre millimetres",
    ("m", 1e-2): "cm centimeter centimeters centimetre centimetres",
    ("m", 1e-6): "um µm micron microns",
    ("m", 1e3): "km",
    ("m", 0.0254): "in inch inches",
    ("m", 0.3048): "ft foot feet",
    ("m/s", 1.0): "m/s m/sec mps m_s m.s-1 ms-1",
    ("m/s", 1e-3): "mm/s mm/sec mm_s",
    ("m/s", 1e-2): "cm/s cm/sec cm_s",
    ("m/s", 1.0 / 3.6): "km/h kmh kph",
    ("m/s^2", 1.0): "m/s2 m/s^2 m/s/s m/sec^2 mps2",
    ("m/s^2", GRAVITY): "g",
    ("m/s^2", 1e-3 * GRAVITY): "mg",
    ("V", 1.0): "v volt volts",
    ("V", 1e-3): "mv millivolt millivolts",
    ("V", 1e3): "kv",
    ("V", 1e-6): "uv µv",
    ("A", 1.0): "a amp amps ampere amperes",
    ("A", 1e-3): "ma milliamp milliamps milliampere",
    ("N", 1.0): "n newton newtons",
    ("N", 1e3): "kn",
    ("N", 1e-3): "mn",
    ("N m", 1.0): "nm n.m n*m newtonmeter newton-meter newtonmetre n-m",
    ("N m", 1e-3): "mnm mn.m mn*m",
    ("N m", 1e-2): "ncm n.cm n*cm",
    ("N m", 1e3): "knm kn.m kn*m",
    ("kg", 1.0): "kg kilogram kilograms",
    ("Hz", 1.0): "hz hertz",
    ("Hz", 1e3): "khz",
    ("W", 1.0): "w watt watts",
    ("W", 1e-3): "mw",
    ("K", 1.0): "k kelvin",
    ("Pa", 1.0): "pa pascal",
    ("Pa", 1e3): "kpa",
    ("Pa", 1e5): "bar",
    ("Pa", 1e2): "mbar hpa",
    ("1", 1.0): "1 - none unitless dimensionless",
    ("1", 0.01): "% percent pct",
}
_UNITS = {word: Unit(si, factor) for (si, factor), words in _SPELLINGS.items() for word in words.split()}
_BIG = {"MV": "V", "MN": "N", "MW": "W", "Mg": "kg"}
"""Spellings in which the case decides: a mega is no milli."""
UNKNOWN = (
    "°c",
    "degc",
    "celsius",
    "°f",
    "degf",
    "count",
    "counts",
    "lsb",
    "digits",
    "ticks",
    "db",
    "wb",
    "a.u.",
    "pwm",
)
"""Units that are known to be units, but are not converted."""
_SUFFIXES_TEXT = (
    "ms msec us µs usec ns nsec millis micros deg degs degree degrees rad rads mrad rpm dps degps radps"
    " rad_s deg_s mm cm um mm_s m_s cm_s kmh mps mv ma nm mnm sec secs seconds volts amps"
)
SUFFIXES = frozenset(_SUFFIXES_TEXT.split())
"""Units that a name may end with after an underscore; those of one letter are rather a part of the name."""

_ENCLOSED = re.compile(r"^(?P<name>.*?)\s*[\[({<](?P<unit>[^\[\](){}<>]*)[\])}>]\s*$")
_DIVIDED = re.compile(r"\s*[/,]\s*|\s+in\s+")
_SPACED = re.compile(r"\s+|\s*:\s*")


def unit_of(text: str) -> Unit | None:
    """The unit that `text` spells, None if it is not known."""
    text = text.strip().strip("[](){}").strip()
    if text in _BIG:
        return None
    word = (
        text.lower()
        .replace("μ", "µ")
        .replace("²", "2")
        .replace("·", "*")
        .replace("⋅", "*")
        .replace("\N{DOT ABOVE}", "")
    )
    word = re.sub(r"\s*([*/^.])\s*", r"\1", word)
    return _UNITS.get(word) or _UNITS.get(word.replace(" ", "")) or _UNITS.get(word.replace("**", "^"))


def is_unit(text: str) -> bool:
    """Whether `text` is a unit, though perhaps one that is not converted."""
    return unit_of(text) is not None or text.strip().strip("[](){}").strip().lower() in UNKNOWN


def name_and_unit(text: str) -> tuple[str, str]:
    """A heading as its name and its unit, "" if none: `angle [deg]`, `angle/°`, `angle in deg`, `angle_deg`."""
    text = text.strip()
    if (found := _ENCLOSED.match(text)) and found["name"]:
        unit = found["unit"].strip()
        return (found["name"], unit) if is_unit(unit) and unit != "1" else (text, "")
    if not text.startswith("/"):  # a path, as of a topic
        for between in (*_DIVIDED.finditer(text), *_SPACED.finditer(text)):
            name, unit = text[: between.start()].strip(), text[between.end() :].strip()
            spaced = between.re is _SPACED
            if name and is_unit(unit) and unit != "1" and (not spaced or unit.lower() in SUFFIXES or "/" in unit):
                return name, unit
    for parts in (2, 1):
        pieces = text.rsplit("_", parts)
        if len(pieces) == parts + 1 and pieces[0] and "_".join(pieces[1:]).lower() in SUFFIXES:
            return pieces[0], "_".join(pieces[1:])
    return text, ""
