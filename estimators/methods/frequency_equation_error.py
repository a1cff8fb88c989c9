"""Equation error in the frequency domain: the balance itself, on the measured response, by weighted least squares.

    G = n0 / (d2 s^2 + d1 s + 1):        e = G measured (d2 s^2 + d1 s + 1) - n0,        P = sum w |e|^2

with n0 = 1 / stiffness term, d2 = inertia / stiffness term and w = (|G| / std |G|)^2: the paper's (10) to (13). If the
joint has no stiffness to divide by, or a part of the balance is known, e = G measured / G - 1 is used instead. Real and
imaginary part have the same weight, and no start value is needed. A static torque is neglected here, too; with these
weights it does little harm, see `frequency_output_error`.

Source: Griese et al., section III-D, with the sign of gravity corrected; Pintelon and Schoukens, System Identification:
A Frequency Domain Approach, section 9.3 (the estimate is biased if the response is noisy).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from upright.estimators.contract import Estimate
from upright.estimators.fit.result import inverse
from upright.estimators.methods.balance import split
from upright.estimators.methods.frequency_output_error import COHERENT, Denominator, Fit, errors, frequency_fit
from upright.estimators.methods.frequency_response import Detrend, FrequencyResponse
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

METHOD = "frequency_equation_error"


def frequency_equation_error(
    model: Model | str,
    recordings: Sequence[Recording],
    *,
    estimate: Iterable[str] | None = None,
    support: float | None = None,
    excitation: str = "",
    detrend: Detrend | str = Detrend.NONE,
    window: float | None = None,
    band: tuple[float, float] | None = None,
    coherence: float = COHERENT,
    joint: str = "",
) -> Estimate:
    """As `frequency_output_error`, but minimising the equation error."""
    spectral = {"excitation": excitation, "support": support, "window": window, "detrend": detrend}
    return frequency_fit(METHOD, equation_fit, split(model, joint, estimate), recordings, band, coherence, **spectral)


def equation_fit(denominator: Denominator, measured: FrequencyResponse, parameters: Sequence[Parameter]) -> Fit:
    """The paper's (12) with the weights (13), and the resulting parameters."""
    known, terms = denominator.at(measured.frequency)
    found = measured.response
    weight = np.abs(found) / measured.magnitude_std
    stiffness = [place for place, term in enumerate(denominator.terms) if term[0] and not term[1:].any()]
    normalised = len(stiffness) == 1 and np.count_nonzero(denominator.terms[:, 0]) == 1 and not denominator.known.any()
    regressors = terms * found[:, None]
    if normalised:
        # G (d + 1) = n0: the stiffness term is divided out, its column is -1 for n0.
        regressors[:, stiffness[0]] = -1.0
        target = -found
    else:
        target = 1.0 - known * found
    rows = _real(regressors * weight[:, None])
    solved = np.asarray(np.linalg.lstsq(rows, _real(target * weight), rcond=None)[0], dtype=np.float64)
    change = np.eye(len(solved))
    values = solved.copy()
    if normalised:
        place = stiffness[0]
        level = denominator.terms[place, 0]
        inertial = solved / solved[place]
        values[:] = inertial
        values[place] = 1.0 / (level * solved[place])
        # d values / d solved
        change = np.eye(len(solved)) / solved[place]
        change[:, place] = -inertial / solved[place]
        change[place] = 0.0
        change[place, place] = -values[place] / solved[place]
    residual = regressors @ solved - target
    # An error of G enters the equation as denominator * error: ratio of the noise of e to that of G.
    spread = np.abs(known + terms @ values) * (abs(solved[stiffness[0]]) if normalised else 1.0)
    scaled = np.where(spread > 0.0, residual / np.maximum(spread, 1e-300), 0.0)
    covariance = errors(measured, scaled, len(solved), 2.0)
    gain = inverse(rows.T @ rows) @ rows.T
    noise = np.outer(weight * spread, weight * spread) * covariance
    part = gain[:, 0::2] @ noise @ gain[:, 0::2].T + gain[:, 1::2] @ noise @ gain[:, 1::2].T
    return Fit(values, change @ part @ change.T)


def _real(values: NDArray[np.complex128]) -> Array:
    """(m, ...) complex as (2 m, ...) real: real and imaginary parts alternate."""
    parts: Array = np.stack((values.real, values.imag), axis=1)
    return parts.reshape(2 * len(values), *values.shape[1:])
