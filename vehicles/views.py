"""What people see of a vehicle, as data: the charts of the dashboard, and what the demo does and draws."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import degrees

LIGHT, DARK = "#9ecae1", "#08519c"
TURN = degrees(1.0)


@dataclass(frozen=True, slots=True)
class Curve:
    """One curve. `look` is measured, setpoint, predicted or innovation; it chooses colour and dash."""

    channel: str
    label: str
    look: str = "measured"


@dataclass(frozen=True, slots=True)
class Chart:
    """Curves of one unit; `factor` converts SI to it. A vehicle without one of its channels has no such chart."""

    id: str
    title: str
    unit: str
    factor: float
    curves: tuple[Curve, ...]


@dataclass(frozen=True, slots=True)
class Panel:
    """Lines over time in one `unit`: `lines` are channel, colour and legend ("" for none), each times `scale`."""

    title: str
    unit: str
    scale: float
    lines: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True, slots=True)
class Story:
    """The demo of one kind of vehicle.

    `experiments` are run if none are named; the last one is diagnosed. `begin`, s: the time before it, while the
    vehicle gets up and its filter settles, carries no information on the vehicle. `settling`: parameters and units that
    the kind's first regression estimates while it runs; if there are none, the last recording is identified afterwards.
    """

    experiments: tuple[str, ...]
    panels: tuple[Panel, ...]
    settling: tuple[tuple[str, str], ...] = ()
    begin: float = 0.0


@dataclass(frozen=True, slots=True)
class Views:
    """The views of one kind of vehicle. `amplitude`: unit of an excitation that is not on a reference angle, which is
    that of the controller's output; `limits`: key under [limits] of its vehicle file to its words and unit."""

    charts: tuple[Chart, ...]
    story: Story
    amplitude: str
    limits: Mapping[str, tuple[str, str]]
