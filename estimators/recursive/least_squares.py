"""Recursive least squares, plain and with instrumental variables, with standard deviations for coloured residuals.

The equation  output = regressors . parameters + residual  is accumulated in information form: with x = [output,
regressors, instruments], each update adds to the lagged moments

    C_l(t) = forgetting * C_l(t - 1) + x(t) x(t - l)^T,    l = 0 ... lags,

which are all that is stored. The estimate solves the normal equations of C_0; with instruments z it is two-stage
least squares: the regressors are first projected on z, W = P^T z, and W^T output = W^T regressors parameters is solved.
Without instruments W is the regressors themselves. Nothing grows or drifts with time, and the lag-l autocovariance of
the residual follows exactly from C_l for the newest parameters, r_l = [1, -parameters] C_l [1, -parameters]^T.

Filtered noise makes the residuals autocorrelated, so the textbook covariance, which assumes independence, is wrong by
an order of magnitude either way. Instead

    cov(parameters) = B^-1 (sum_l r_l R_l) B^-1,    B = W^T W,    R_l = sum of W(t) W(t - l)^T over both signs of l,

is used, for residuals independent of W. Slow residuals need r_l at lags at which a record says little about it: beyond
the first `order` lags, r_l is that of the autoregressive process with the same first lags, the maximum-entropy
continuation. In a record of only a few times `lags`, the magnitude of a slow disturbance is not identifiable: the
standard deviation is increased as for Student's t, with one degree of freedom for every half of `lags`, so that 1.96 of
it cover 95 % there too. A prior bounds the covariance that forgetting would otherwise let grow.

Bias: noise on a regressor, or a disturbance that enters the regressors by feedback, biases the plain form. Instruments
that are independent of noise and disturbance (the injected excitation, directly and filtered) remove the bias.

Sources: Soederstroem and Stoica, System Identification, chapters 4, 8 and 9; Andrews and Monahan, Econometrica 60
(1992), for covariances by prewhitening; Kulhavy and Zarrop, On a general concept of forgetting, Int. J. Control 58
(1993), for the bounded forgetting.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_toeplitz, toeplitz
from scipy.special import ndtri, stdtrit

from upright.estimators.contract import EstimationError

Array = NDArray[np.float64]

SINGULAR = 1e-9
"""Directions whose eigenvalue of the scaled regressor moments, per sample, is below this count as not excited."""
ROUNDING = 1e-12
"""Residual energy of an exact fit, as a share of the output's."""
WHITE_SHARES = (1e-6, 1e-4, 1e-2)
"""White noise, as a share of the residual's power, that keeps the autoregressive process stable."""
ROUNDS = 3
"""Iterations that restore the part of the disturbance that the fit removed from the residual."""


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior `values` with standard deviations `std`; `residual_std` is that of a sample's residual."""

    values: Array
    std: Array
    residual_std: float


@dataclass(frozen=True, slots=True)
class Solution:
    """The estimate at one instant.

    `values` (n,), `covariance` (n, n), `residual_std` in units of the output, `movement` (n,): RMS of the part of each
    regressor (of its projection on the instruments) that is independent of the others. If it is 0, the data do not
    determine the value, and it must not be shown.
    """

    values: Array
    covariance: Array
    residual_std: float
    movement: Array
    samples: float


class RecursiveLeastSquares:
    """Least squares of one output on `regressors` regressors, sample by sample; with `instruments` > 0 two-stage.

    `lags` is the longest autocorrelation of the residual in samples (0: independent residuals), `order` the number of
    lags at which its autocovariance is estimated from the data. `memory` is the time constant of forgetting in samples,
    infinite for none; a finite one needs a `prior`, which bounds the covariance.
    Raises EstimationError if there are fewer instruments than regressors, or forgetting without a prior.
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
                f"{instruments} are too few for {regressors} regressors",
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
        """Effective number of samples after forgetting."""
        return self._samples

    def solve(self) -> Solution:
        """The estimate from all samples so far. It costs far more than an update: call it only to show the result."""
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
        weights = projection.T @ weights @ projection
        disturbance, meat = self._disturbance_autocovariance(autocovariance, weights, inverse)
        if prior is not None:
            meat += prior_meat
        units = scale[0] / scale[columns]
        return Solution(
            values=values * units,
            covariance=(inverse @ meat @ inverse) * np.outer(units, units) * self._widening() ** 2,
            residual_std=float(scale[0] * np.sqrt(disturbance[0])),
            movement=scale[columns] * np.sqrt(energy / max(self._samples, 1.0)),
            samples=self._samples,
        )

    def _widening(self) -> float:
        """Factor on 95 % intervals if the record is only a few correlation times of the slow disturbance long."""
        slowest = 0.5 * (len(self._moments) - 1)
        if slowest == 0.0:
            return 1.0
        return float(stdtrit(max(1.0, self._samples / slowest), 0.975) / ndtri(0.975))

    def _scaled_prior(self, scale: Array) -> tuple[Array, Array, Array] | None:
        """Contributions of the prior to the information, the right-hand side and the middle of the covariance, in
        scaled units."""
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
        if covariance[0] <= ROUNDING:
            covariance[0] = max(covariance[0], 0.0)
            covariance[1:] = 0.0
        return covariance

    def _disturbance_autocovariance(self, residual: Array, weights: Array, inverse: Array) -> tuple[Array, Array]:
        """Autocovariance of the disturbance (lags + 1,) and the middle of the covariance, sum over l of r_l R_l.

        The fit removes from the residual the part of the disturbance that it can explain, most of all if the
        disturbance is slow and the record short. This part follows from the moments and is restored in a few
        iterations.
        """
        order = min(self._order, len(residual) - 1)
        symmetric = weights + np.swapaxes(weights, 1, 2)
        symmetric[0] *= 0.5
        share = np.einsum("ij,lji->l", inverse, weights)
        both = np.concatenate((share[:0:-1], share))
        disturbance = continue_autocovariance(residual, order)
        meat = positive_meat(disturbance, symmetric)
        for _ in range(ROUNDS if order else 0):
            covariance = inverse @ meat @ inverse
            explained = 2.0 * np.convolve(np.concatenate((disturbance[:0:-1], disturbance)), both, mode="same")
            explained = explained[len(residual) - 1 :] - np.einsum("ij,lji->l", covariance, weights)
            corrected = residual + explained / max(self._samples, 1.0)
            if np.linalg.eigvalsh(toeplitz(corrected[: order + 1]))[0] <= 0.0:
                break  # the record is too short
            disturbance = continue_autocovariance(corrected, order)
            meat = positive_meat(disturbance, symmetric)
        return disturbance, meat


def positive_meat(autocovariance: Array, symmetric: Array) -> Array:
    """Sum of autocovariance times regressor moments over the lags, which must be positive definite.

    If an autocovariance is truncated before it has decayed, it may not be; then a Parzen window is applied.
    """
    meat: Array = np.tensordot(autocovariance, symmetric, axes=1)
    if np.linalg.eigvalsh(meat)[0] > 0.0:
        return meat
    share = np.arange(len(autocovariance)) / len(autocovariance)
    window = np.where(share <= 0.5, 1.0 - 6.0 * share**2 * (1.0 - share), 2.0 * (1.0 - share) ** 3)
    faded: Array = np.tensordot(window * autocovariance, symmetric, axes=1)
    return faded


def continue_autocovariance(autocovariance: Array, order: int) -> Array:
    """The first `order` lags unchanged, the others from the autoregressive process of that order.

    If samples are finely spaced or the residual is hardly more than rounding, the process can be unstable. It is
    therefore computed with white noise added to the residual, the least of WHITE_SHARES with which no lag exceeds
    lag 0.
    """
    continued = autocovariance.copy()
    if order == 0 or continued[0] <= ROUNDING:
        return continued
    for share in WHITE_SHARES:
        column = continued[:order].copy()
        column[0] *= 1.0 + share
        process = solve_toeplitz(column, continued[1 : order + 1])
        for lag in range(order + 1, len(continued)):
            continued[lag] = process @ continued[lag - order : lag][::-1]
            if not abs(continued[lag]) <= continued[0]:
                break
        else:
            return continued
    continued[order + 1 :] = 0.0
    return continued
