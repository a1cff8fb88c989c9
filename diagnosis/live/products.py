"""All that is kept of a second of data: the products of its columns, from which any span of seconds can be refitted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Products:
    """The products of the columns of each second, the last ones separately and earlier ones summed, in `kept` parts.

    Columns (n, `width`) are the nuisances first, then those of effects, the innovations last. `prior` (p,) is one over
    the variances of the p nuisances, `mean` (p,) their expected values.
    """

    def __init__(self, prior: Array, mean: Array, width: int, kept: int) -> None:
        self.prior, self.mean = prior, mean
        self._blocks: Array = np.zeros((kept + 1, width, width))
        self._starts: list[int] = []
        self._running: Array = np.zeros((width, width))
        self.seconds = 0
        """Complete seconds."""
        self.rows = 0
        """Numbers gathered."""

    def add(self, columns: Array) -> None:
        """Further rows (n, width) of the current second."""
        self._running += columns.T @ columns
        self.rows += len(columns)

    def end_second(self, held: Iterable[int] = ()) -> None:
        """The current second is over. The seconds `held`, and those before them, stay separate from earlier ones."""
        self._blocks[len(self._starts)] = self._running
        self._starts.append(self.seconds)
        self._running[:] = 0.0
        self.seconds += 1
        if len(self._starts) == len(self._blocks):
            apart = {second - late for second in held for late in (0, 1)}
            one = next((i for i in range(1, len(self._starts)) if self._starts[i] not in apart), 1)
            self._blocks[one - 1] += self._blocks[one]
            self._blocks[one:-1] = self._blocks[one + 1 :]
            del self._starts[one]

    def forget(self, columns: Sequence[int]) -> None:
        """Clear these columns, which have another meaning from now on."""
        for block in (self._blocks, self._running[None]):
            block[:, columns, :] = 0.0
            block[:, :, columns] = 0.0

    def latest(self) -> tuple[Array, NDArray[np.int64]]:
        """Products of each part (n, width, width), and the second at which it begins (n,)."""
        return self._blocks[: len(self._starts)], np.array(self._starts)
