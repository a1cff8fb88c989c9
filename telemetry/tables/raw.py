"""A table as it is in its file: columns of numbers under the names of their headings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Column:
    """A column: its `heading` as in the file, its `name` without unit, the `unit` that the file states ("" for none).

    `values` float64 (n,), NaN where not known. `exact` int64 (n,) if they are whole numbers. `kind` is "number",
    "date" or "time of day" (both in ns), or "yes or no".
    """

    heading: str
    name: str
    unit: str
    values: NDArray[np.float64]
    exact: NDArray[np.int64] | None = None
    kind: str = "number"


@dataclass(frozen=True, slots=True)
class RawTable:
    """The columns of a file. `texts` are columns of text by heading: they are no channels, but may name them.

    `lines` int64 (n,) are the rows' lines in the file; `metadata` is what the file knows of itself, `said` what was
    assumed, `truncated` what could not be read of a file that was cut off.
    """

    source: str
    columns: tuple[Column, ...]
    lines: NDArray[np.int64]
    texts: dict[str, tuple[str, ...]] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    said: tuple[str, ...] = ()
    truncated: str = ""

    def __len__(self) -> int:
        return len(self.lines)
