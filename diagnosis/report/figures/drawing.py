"""How the report's figures look: inline SVG whose text is text, in colours that differ in lightness, too.

Before is orange, dashed and hollow, after is blue, solid and filled: colour and style each suffice to distinguish them,
for colour-blind readers and for paper without colour. Drawn without pyplot: no display, no global state.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import wraps
from io import BytesIO, StringIO
from itertools import cycle, islice
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

Array = NDArray[np.float64]

WIDTH = 7.2
"""Inches, about the width of A4 between its margins: text has the stated size on paper."""
NOTEBOOK_DPI = 80
MOST_POINTS = 1500
"""Points of a curve: more than paper or a screen of that width shows."""
STYLE: Any = {
    "svg.fonttype": "none",
    "svg.hashsalt": "upright",
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "axes.titlesize": 8.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.0,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.xmargin": 0.01,
    "grid.color": "0.9",
    "grid.linewidth": 0.5,
}
MEASURED, FLOOR = "0.72", "0.35"


class Picture(Figure):
    """A figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        stream = BytesIO()
        self.savefig(stream, format="png", dpi=NOTEBOOK_DPI)
        return stream.getvalue()


@dataclass(frozen=True, slots=True)
class Look:
    """The look of one model's curves."""

    colour: str
    dash: Any
    marker: str
    filled: bool
    width: float

    @property
    def line(self) -> dict[str, Any]:
        """Keywords of a curve."""
        return {"color": self.colour, "linestyle": self.dash, "linewidth": self.width}

    @property
    def points(self) -> dict[str, Any]:
        """Keywords of markers without a line."""
        face = self.colour if self.filled else "white"
        return {"color": self.colour, "marker": self.marker, "markerfacecolor": face, "linestyle": "none"}


BEFORE = Look("#D55E00", (0, (2.5, 0.8)), "o", False, 1.5)
AFTER = Look("#0072B2", "-", "s", True, 0.9)
OTHERS = (
    Look("#009E73", (0, (5.0, 1.0, 1.0, 1.0)), "^", True, 1.1),
    Look("#CC79A7", (0, (1.0, 1.0)), "D", False, 1.3),
    Look("#56B4E9", (0, (6.0, 1.5)), "v", True, 1.1),
    Look("#000000", (0, (3.0, 1.0, 1.0, 1.0, 1.0, 1.0)), "P", False, 1.0),
)


def looks(count: int) -> tuple[Look, ...]:
    """The looks of `count` models: of one alone, of one before and after, or of more; after the last they repeat."""
    return (AFTER,) if count == 1 else tuple(islice(cycle((BEFORE, AFTER, *OTHERS)), count))


def styled(draw: Callable[..., str]) -> Callable[..., str]:
    """`draw` in the style of the reports."""

    @wraps(draw)
    def drawn(*arguments: object) -> str:
        with mpl.rc_context(STYLE):
            return draw(*arguments)

    return drawn


def svg(figure: Figure, name: str, label: str) -> str:
    """`figure` as an element of a page, read out as `label`. `name` distinguishes its ids from those of others."""
    text = StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    body = text.getvalue()
    body = body[body.index("<svg") :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    body = re.sub(r'\bid="', f'id="{name}-', body)
    body = re.sub(r'href="#', f'href="#{name}-', body)
    body = body.replace("url(#", f"url(#{name}-")
    # If the font that the layout was made for is missing, one of the same width is used.
    body = body.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")
    # A hundredth of a point is finer than any printer.
    body = re.sub(r'\b(?:d|x|y|transform)="[^"]*"', lambda found: re.sub(r"(\d\.\d\d)\d+", r"\1", found[0]), body)
    body = re.sub(r'(<svg [^>]*?)width="[^"]*pt" ?', r"\1", body, count=1)
    body = re.sub(r'(<svg [^>]*?)height="[^"]*pt" ?', r"\1", body, count=1)
    return body.replace("<svg ", f'<svg role="img" aria-label="{label}" ', 1)


def thinned(*columns: Array) -> list[Array]:
    """Every so many points of a curve, the same for all `columns`."""
    step = max(1, -(-len(columns[0]) // MOST_POINTS))
    return [column[::step] for column in columns]


def in_a_row(begins: Sequence[float], ends: Sequence[float]) -> Array:
    """s by which each part of several recordings is shifted to follow the one before, (n,).

    Parts are in order; where time goes back, another recording begins.
    """
    shifts, shift, last = [], 0.0, -np.inf
    for begin, end in zip(begins, ends, strict=True):
        if begin < last:
            shift += last - begin
        shifts.append(shift)
        last = end
    return np.array(shifts)


def separate(axes: Axes, begins: Sequence[float], names: Sequence[str]) -> None:
    """Mark where each recording begins, with its name, if there are several."""
    if len(begins) < 2:
        return
    for begin, name in zip(begins, names, strict=True):
        axes.axvline(begin, color="0.5", linewidth=0.6)
        axes.annotate(
            name, (begin, 1.0), xycoords=("data", "axes fraction"), xytext=(3, -2), textcoords="offset points",
            fontsize=6.5, color="0.3", va="top", parse_math=False, annotation_clip=True,
        )  # fmt: skip
