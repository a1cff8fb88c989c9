"""Steps in the logarithms of parameters of which only the order of magnitude is known.

Often only products and quotients of such parameters are identifiable. The good values then lie along a curve, which
straight steps leave at once. In logarithms it is a straight line. The minimum is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.fit.gauss_newton import Minimum, Normal
from upright.estimators.fit.likelihood import Likelihood, Seen
from upright.models.parts import Parameter

Array = NDArray[np.float64]

ROUGHLY = 0.25
"""Only the order of magnitude of a positive parameter is known if its relative standard deviation exceeds this."""
LEAST = 1e-6
"""Lower bound of such a parameter, relative to its start, if its own bound is zero."""


@dataclass(frozen=True, slots=True)
class InLogarithms:
    """A likelihood as a function of unknowns (p + q,), of which those at the mask `places` (p + q,) are the logarithms
    of its own."""

    likelihood: Likelihood
    places: NDArray[np.bool_]

    @classmethod
    def of(cls, likelihood: Likelihood) -> InLogarithms:
        """With logarithms of the parameters that are known roughly."""
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

    def is_finite(self, common: Array, own: Sequence[Array]) -> bool:
        """Whether the predictor exists and does not diverge at `common` (p + q,)."""
        return self.likelihood.is_finite(self.natural(common), own)

    def natural(self, common: Array) -> Array:
        """The unknowns of the likelihood itself."""
        return np.where(self.places, np.exp(np.where(self.places, common, 0.0)), common)

    def inside(self, natural: Array) -> Array:
        """The inverse of `natural`, for values and bounds; zero is replaced by LEAST of the start."""
        least = LEAST * np.abs(self.likelihood.centre)
        return np.where(self.places, np.log(np.where(self.places, np.maximum(natural, least), 1.0)), natural)

    def scale(self, natural: Array) -> Array:
        """Typical magnitudes of the unknowns: 0.5 for a logarithm."""
        return np.where(self.places, 0.5, natural)

    def minimum(self, found: Minimum, lower: Array, upper: Array) -> Minimum:
        """`found` in the unknowns of the likelihood itself, exactly within the bounds (p + q,)."""
        common = np.clip(self.natural(found.common), lower, upper)
        slope = self._slope(common)
        return replace(found, common=common, information=found.information / np.outer(slope, slope))

    def _slope(self, natural: Array) -> Array:
        return np.where(self.places, natural, 1.0)


def is_known_roughly(parameter: Parameter) -> bool:
    """Whether `parameter` is positive and no more than its order of magnitude is known."""
    return parameter.lower >= 0.0 and parameter.value > 0.0 and parameter.std > ROUGHLY * parameter.value
