"""Recursive least squares, plain and with instrumental variables, with standard deviations for coloured residuals.

The equation  output = regressors . parameters + residual  is gathered in information form: with x = [output,
regressors, instruments], each update adds to the lagged moments

    C_l(t) = forgetting * C_l(t - 1) + x(t) x(t - l)^T,    l = 0 ... lags,

which is all that is ever kept. The estimate solves the normal equations of C_0; with instruments z it is two-stage
least squares: the regressors are first projected on z, W = P^T z, and W^T output = W^T regressors parameters is solved.
Without instruments W is the regressors themselves. Nothing grows or drifts with time, and the lag-l autocovariance of
the residual follows exactly from C_l for the newest parameters, r_l = [1, -parameters] C_l [1, -parameters]^T.

Filtered noise makes residuals that are alike from one sample to the next, so the textbook covariance, which takes them
for independent, is wrong by an order of magnitude either way. Used instead is

    cov(parameters) = B^-1 (sum_l r_l R_l) B^-1,    B = W^T W,    R_l = sum of W(t) W(t - l)^T over both signs of l,

for residuals independent of W. Slow residuals need r_l at lags at which a record says little about it: beyond the first
`order` lags r_l is that of the autoregressive process which has these, the maximum-entropy continuation.
A prior bounds the covariance where forgetting would let it grow.

Bias: noise on a regressor, or a disturbance that feedback leads back into the regressors, biases the plain form.
Instruments that neither noise nor disturbance reaches (the injected excitation, and what filters make of it) remove it.

Sources: Soederstroem and Stoica, System Identification, chapters 4, 8 and 9; Andrews and Monahan, Econometrica 60
(1992), for covariances by prewhitening; Kulhavy and Zarrop, On a general concept of forgetting, Int. J. Control 58
(1993), for the bounded forgetting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_toeplitz

from estimators.contract import EstimationError

Array = NDArray[np.float64]

SINGULAR = 1e-9
"""Directions of the scaled regressor moments smaller than this share of the largest count as not excited."""


@dataclass(frozen=True, slots=True)
class Prior:
    """What is known beforehand: `values` with standard deviations `std`, in terms of samples of size `residual_std`."""

    values: Array
    std: Array
    residual_std: float


@dataclass(frozen=True, slots=True)
class Solution:
    """The estimate at one moment.

    `values` (n,), `covariance` (n, n), `residual_std` in units of the output, `movement` (n,): RMS of what each
    regressor (its projection on the instruments) does that the others do not. Where it is 0 the data do not determine
    the value, and it must not be shown.
    """

    values: Array
    covariance: Array
    residual_std: float
    movement: Array
    samples: float


class RecursiveLeastSquares:
    """Least squares of one output on `regressors` regressors, sample by sample; with `instruments` > 0 two-stage.

    `lags` is how many samples the residual can stay correlated with itself, `order` for how many of them its
    autocovariance is taken from the data; 0 lags takes residuals for independent. `memory` is the time constant of
    forgetting in samples, infinite for none; a finite one needs a `prior`, which bounds the covariance.
    Raises EstimationError where there are fewer instruments than regressors, or forgetting without a prior.
    """

    def __init__(
        self,
        regressors: int,
        *,
        instruments: int = 0,
        lags: int = 0,
        order: int = 25,
        memory: float = np.inf,
        prior: Prior | None = None,
    ) -> None:
        if 0 < instruments < regressors:
            raise EstimationError(
                "instruments",
                f"{instruments} cannot tell {regressors} regressors apart",
                remedy="give at least as many.",
            )
        if memory < np.inf and prior is None:
            raise EstimationError("forgetting", "its covariance would grow without bound", remedy="give a prior.")
        self.regressors = regressors
        self.instruments = instruments
        self._forgetting = 1.0 - 1.0 / memory
        self._prior = prior
        self._order = order
        size = 1 + regressors + instruments
        self._moments: Array = np.zeros((lags + 1, size, size))
        self._history: Array = np.zeros((lags + 1, size))
        self._samples = 0.0

    def update(self, output: float, regressors: ArrayLike, instruments: ArrayLike = ()) -> None:
        """Take one sample: `regressors` (n,), `instruments` (m,)."""
        history = self._history
        history[1:] = history[:-1]
        newest = history[0]
        newest[0] = output
        newest[1 : 1 + self.regressors] = regressors
        newest[1 + self.regressors :] = instruments
        if self._forgetting < 1.0:
            self._moments *= self._forgetting
            self._samples *= self._forgetting
            history[1:] *= np.sqrt(self._forgetting)  # keeps the lagged moments those of one weighted record
        self._moments += newest[:, None] * history[:, None, :]
        self._samples += 1.0

    def interrupt(self) -> None:
        """The next sample does not follow the last: products across the gap are not formed."""
        self._history[:] = 0.0

    def reset(self) -> None:
        """Forget all samples."""
        self._moments[:] = 0.0
        self._samples = 0.0
        self.interrupt()

    @property
    def samples(self) -> float:
        """Samples that count, after forgetting."""
        return self._samples

    def solve(self) -> Solution:
        """The estimate from all samples so far. Costs far more than an update: ask when it is to be shown."""
        count = self.regressors
        # Columns are scaled to unit RMS: torques, angles and constants differ by orders of magnitude.
        rms = np.sqrt(np.diagonal(self._moments[0]) / max(self._samples, 1.0))
        scale = np.where(rms > 0.0, rms, 1.0)
        moments = self._moments / (scale[:, None] * scale)
        columns = slice(1, 1 + count)
        if self.instruments:
            zz = moments[0, 1 + count :, 1 + count :]
            projection = np.linalg.pinv(zz, rcond=SINGULAR, hermitian=True) @ moments[0, 1 + count :, columns]
            weights = moments[:, 1 + count :, 1 + count :]
            information = projection.T @ zz @ projection
            right = projection.T @ moments[0, 1 + count :, 0]
        else:
            projection = np.eye(count)
            weights = moments[:, columns, columns]
            information = moments[0, columns, columns]
            right = moments[0, columns, 0]
        prior = self._scaled_prior(scale)
        eigenvalues, directions = np.linalg.eigh(information)
        excited = eigenvalues > SINGULAR * self._samples
        inverse_eigenvalues = np.where(excited, 1.0 / np.where(excited, eigenvalues, 1.0), 0.0)
        data_inverse = (directions * inverse_eigenvalues) @ directions.T
        determined = (np.abs(directions[:, ~excited]) < 1e-3).all(axis=1) & (np.diagonal(data_inverse) > 0.0)
        energy = np.where(determined, 1.0 / np.where(determined, np.diagonal(data_inverse), 1.0), 0.0)

        if prior is None:
            inverse = data_inverse
            values = inverse @ right
        else:
            prior_information, prior_right, prior_meat = prior
            inverse = np.linalg.inv(information + prior_information)
            values = inverse @ (right + prior_right)
        autocovariance = self._residual_autocovariance(moments, values)
        meat = self._meat(projection, weights, autocovariance)
        if prior is not None:
            meat += prior_meat
        units = scale[0] / scale[columns]
        return Solution(
            values=values * units,
            covariance=(inverse @ meat @ inverse) * np.outer(units, units),
            residual_std=float(scale[0] * np.sqrt(autocovariance[0])),
            movement=scale[columns] * np.sqrt(energy / max(self._samples, 1.0)),
            samples=self._samples,
        )

    def _scaled_prior(self, scale: Array) -> tuple[Array, Array, Array] | None:
        """Information, right-hand side and the part of the covariance's middle that the prior adds, in scaled units."""
        if self._prior is None:
            return None
        units = scale[1 : 1 + self.regressors] / scale[0]
        std, residual = self._prior.std * units, self._prior.residual_std / scale[0]
        information = np.diag((residual / std) ** 2)
        return information, information @ (self._prior.values * units), information * residual**2

    def _residual_autocovariance(self, moments: Array, values: Array) -> Array:
        """Autocovariance of the residual at lags 0 ... lags, from the moments and the parameters alone."""
        combination = np.concatenate(([1.0], -values))
        used = slice(0, 1 + self.regressors)
        covariance: Array = combination @ moments[:, used, used] @ combination / max(self._samples, 1.0)
        order = min(self._order, len(covariance) - 1)
        if covariance[0] <= 1e-12 or order == 0:  # of the squared output: an exact fit leaves rounding alone
            covariance[0] = max(covariance[0], 0.0)
            covariance[1:] = 0.0
            return covariance
        column = covariance[:order].copy()
        column[0] *= 1.0 + 1e-6  # keeps the process stable where the samples are very finely spaced
        process = solve_toeplitz(column, covariance[1 : order + 1])
        for lag in range(order + 1, len(covariance)):
            covariance[lag] = process @ covariance[lag - order : lag][::-1]
        return covariance

    def _meat(self, projection: Array, weights: Array, autocovariance: Array) -> Array:
        """The middle of the covariance: residual autocovariance times regressor moments, over both signs of the lag."""
        half = projection.T @ np.tensordot(autocovariance[1:], weights[1:], axes=1) @ projection
        meat = autocovariance[0] * (projection.T @ weights[0] @ projection) + half + half.T
        # The fit has taken one degree of freedom a parameter out of the residual's independent ones.
        likeness = float(np.sum((autocovariance[1:] / max(autocovariance[0], 1e-300)) ** 2))
        independent = self._samples / (1.0 + 2.0 * likeness)
        result: Array = meat * (independent / max(independent - self.regressors, 1.0))
        return result
