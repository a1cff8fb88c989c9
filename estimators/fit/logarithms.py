"""Steps in logarithms of the parameters that are known by their order of magnitude alone.

What a record tells are often products and quotients of such numbers. In the numbers themselves the good values then lie
along a curve, which straight steps leave at once; in their logarithms it is a straight line. The minimum is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.fit.gauss_newton import Minimum, Normal
from estimators.fit.likelihood import Likelihood, Seen
from models.parts import Parameter

Array = NDArray[np.float64]

ROUGHLY = 0.25
"""Share of its value that a positive parameter's standard deviation has where only its size is known."""
LEAST = 1e-6
"""Share of its start below which such a parameter is not sought where its bound is zero."""


@dataclass(frozen=True, slots=True)
class InLogarithms:
    """A likelihood in unknowns (p + q,) of which those of `places` (p + q,) are the logarithms of what it takes."""

    likelihood: Likelihood
    places: NDArray[np.bool_]

    @classmethod
    def of(cls, likelihood: Likelihood) -> InLogarithms:
        """Of those parameters of the likelihood's problem that are known roughly."""
        roughly = [is_known_roughly(parameter) for parameter in likelihood.task.parameters]
        return cls(likelihood, np.array(roughly + [False] * likelihood.noise.size))

    def __call__(self, common: Array, own: Sequence[Array]) -> Seen | None:
        natural = self.natural(common)
        seen = self.likelihood(natural, own)
        if seen is None:
            return None
        slope = self._slope(natural)
        normals = []
        for normal in seen.normals:
            factor = np.concatenate((slope, np.ones(len(normal.vector) - len(slope))))
            normals.append(Normal(factor[:, None] * normal.matrix * factor, factor * normal.vector))
        return replace(seen, normals=tuple(normals))

    def natural(self, common: Array) -> Array:
        """What the likelihood takes."""
        return np.where(self.places, np.exp(np.where(self.places, common, 0.0)), common)

    def inside(self, natural: Array) -> Array:
        """The opposite of `natural`, for values and bounds; zero is as good as LEAST of the start."""
        least = LEAST * np.abs(self.likelihood.centre)
        return np.where(self.places, np.log(np.where(self.places, np.maximum(natural, least), 1.0)), natural)

    def scale(self, natural: Array) -> Array:
        """Typical sizes of the unknowns: a logarithm is changed by a half at a time."""
        return np.where(self.places, 0.5, natural)

    def minimum(self, found: Minimum, lower: Array, upper: Array) -> Minimum:
        """`found` in the likelihood's unknowns, within bounds (p + q,) to the last bit."""
        common = np.clip(self.natural(found.common), lower, upper)
        slope = self._slope(common)
        return replace(found, common=common, information=found.information / np.outer(slope, slope))

    def _slope(self, natural: Array) -> Array:
        return np.where(self.places, natural, 1.0)


def is_known_roughly(parameter: Parameter) -> bool:
    """Whether it is a positive number of which no more than the size is known."""
    return parameter.lower >= 0.0 and parameter.value > 0.0 and parameter.std > ROUGHLY * parameter.value
