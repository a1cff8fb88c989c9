"""Output error in the frequency domain: fits the amplitude response to the measured one.

    P = sum over frequencies of (|G(jw)| - |G measured|)^2,        G = 1 / (inertia (jw)^2 + friction jw - stiffness)

The paper's (9), by Nelder and Mead's simplex from the model's values. G is the transfer function from the known force
(angular momentum x precession rate + trim torque) to the joint's coordinate; its denominator is the part of the joint's
balance that is linear in the motion. Other terms are neglected and reported with the reason; they do not count as
failed.

A static torque is neglected, too, since no transfer function contains it. The paper attributes the deviations of its
frequency-domain results to that. They arise in the two lowest bins, if the windows are not detrended (`detrend` "none",
the default; the paper does not say): a constant gyro torque without an angle looks like a stiff vehicle. With every bin
from 0 Hz on (`coherence` 0), 40 N m make the inertia 27 % too small and the stiffness 42 % too large in a simulated
sweep, 10 N m still 17 and 20 %. These bins are incoherent, though, so that by default they are left out where they do
harm, and 1 to 4 % remain. (13) makes `frequency_equation_error` nearly immune.

Standard deviations follow from those of the response through the Jacobian, with neighbouring bins correlated, and are
increased if the residual exceeds the noise. Source: Griese et al., section III-C, with the sign of gravity corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from scipy.optimize import minimize

from upright.estimators.contract import Estimate, EstimationError, ParameterEstimate, Status
from upright.estimators.data.segments import DataError
from upright.estimators.fit.result import correlation, inverse, refused, required_std
from upright.estimators.methods.balance import Balance, split
from upright.estimators.methods.frequency_response import (
    DETRENDED,
    OF_BINS,
    Detrend,
    FrequencyResponse,
    force_spectra,
    response,
)
from upright.estimators.methods.least_squares import REQUIRED_SHARE, assembled, size_of
from upright.estimators.numbers import about
from upright.estimators.stopwatch import stopwatch
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

METHOD = "frequency_output_error"
COHERENT = 0.8
"""Least coherence of a frequency that is used."""
EXCITED = 1e-3
"""Least power of the input at a frequency that is used, relative to that of the strongest."""
LINEAR_SHARE = 0.1
"""Largest relative deviation of a linear term from its slope, at the joint's typical motion."""
STEPS = 4000
"""Largest number of evaluations by the simplex."""


@dataclass(frozen=True, slots=True)
class Denominator:
    """1 / G = known + sum_j parameter_j * terms_j; each is (stiffness, friction, inertia), multiplied by 1, s and s^2.

    `names` are the parameters of `terms` (p, 3). `neglected` maps the other parameters to the reason.
    """

    names: tuple[str, ...]
    known: Array
    terms: Array
    neglected: Mapping[str, str]

    def at(self, frequency: Array) -> tuple[ComplexArray, ComplexArray]:
        """known (m,) and terms (m, p) at `frequency` Hz."""
        powers = (2j * np.pi * frequency)[:, None] ** np.arange(3)
        return powers @ self.known, powers @ self.terms.T


@dataclass(frozen=True, slots=True)
class Fit:
    """Parameters (p,) of a Denominator, their covariance (p, p), and whether the search converged."""

    values: Array
    covariance: Array
    converged: bool = True


Solver = Callable[[Denominator, FrequencyResponse, Sequence[Parameter]], Fit]


def frequency_output_error(
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
    """The parameters of the linear part of the balance at `joint`, by default the first.

    `excitation` names a channel for the joint input-output form, "" for the paper's direct one; `detrend` and `window`
    (s) as for `frequency_response`; `band` (Hz) restricts the coherent frequencies that are used. Data that cannot be
    used give an Estimate without values that says why. Raises EstimationError and ModelError as `least_squares`.
    """
    spectral = {"excitation": excitation, "support": support, "window": window, "detrend": detrend}
    return frequency_fit(METHOD, amplitude_fit, split(model, joint, estimate), recordings, band, coherence, **spectral)


def frequency_fit(
    method: str,
    solver: Solver,
    balance: Balance,
    recordings: Sequence[Recording],
    band: tuple[float, float] | None,
    coherence: float,
    **spectral: Any,
) -> Estimate:
    """Estimates the response and fits it by `solver`. `spectral` are arguments of force_spectra."""
    began = stopwatch()
    denominator = denominator_of(balance)
    estimated = [balance.model.parameter(name) for name in denominator.names]
    try:
        spectra = force_spectra(balance, recordings, **spectral)
        reference = 2 if spectral["excitation"] else None
        measured = response(spectra, 0, 1, reference=reference)
        required = REQUIRED_SHARE * balance.joint.force_scale
        used = usable(measured, band, len(estimated), required, coherence)
    except DataError as error:
        return refused(balance.model, method, error, stopwatch() - began)
    fit = solver(denominator, narrowed(measured, used), estimated)
    whole = fit.covariance
    for number in range(len(balance.anchors)):
        changed = response(spectra, 0, 1, reference=reference, change=(2 if reference is None else 3) + number)
        moved = solver(denominator, narrowed(changed, used), estimated).values - fit.values
        whole = whole + np.outer(moved, moved)
    parameters = {p.name: _parameter(place, estimated, fit, whole) for place, p in enumerate(estimated)}
    names, neglected = denominator.names, denominator.neglected
    return assembled(method, balance, names, parameters, whole, spectra.samples, spectra.span, began, neglected)


def usable(
    measured: FrequencyResponse, band: tuple[float, float] | None, parameters: int, required: float, coherence: float
) -> NDArray[np.bool_]:
    """Which frequencies can be used. Raises DataError if they are too few or the RMS force is less than `required`."""
    lowest, highest = band or (0.0, np.inf)
    inside = (measured.frequency >= lowest) & (measured.frequency <= highest) & np.isfinite(measured.magnitude_std)
    # By chance alone some of thousands of frequencies are coherent. Leakage of a constant does not count as strongest.
    inside &= measured.power >= EXCITED * np.max(measured.power[DETRENDED:], initial=0.0)
    used = inside & (measured.coherence >= coherence)
    moved = float(np.sqrt(np.sum(measured.power[used & (measured.frequency > 0.0)])))
    if used.sum() > parameters and moved < required:
        what = f"the force moves by {moved:.3g}, RMS, {required:.3g} are needed"
        raise DataError(Status.TOO_LITTLE_EXCITATION, "frequency response", what, remedy="excite more strongly.")
    if used.sum() < parameters + 1:
        best = f", at best {np.max(measured.coherence[inside]):.2f}" if inside.any() else ""
        what = f"at {used.sum()} frequencies the coherence is {coherence:g} or more{best}; {parameters + 1} are needed"
        remedy = "excite a wider band, more strongly, or record for longer."
        raise DataError(Status.TOO_LITTLE_EXCITATION, "frequency response", what, remedy=remedy)
    return np.asarray(used)


def narrowed(measured: FrequencyResponse, used: NDArray[np.bool_]) -> FrequencyResponse:
    """`measured` at the `used` frequencies."""
    names = ("frequency", "response", "coherence", "magnitude_std", "phase_std", "power")
    return replace(measured, **{name: getattr(measured, name)[used] for name in names})


def denominator_of(balance: Balance) -> Denominator:
    """The linear part of a balance. Raises EstimationError if it contains no estimated parameter."""
    joint = balance.joint
    own = [expression.free_symbols for expression in balance.motion]
    if any(len(symbols) != 1 for symbols in own):
        remedy = "use a time-domain method."
        what = "its coordinate, rate and acceleration do not each come from a single channel"
        raise EstimationError(f"joint {joint.name}", what, remedy=remedy)
    symbols = [next(iter(each)) for each in own]
    gains = [float(e.diff(symbol)) for e, symbol in zip(balance.motion, symbols, strict=True)]
    at_rest = dict.fromkeys(symbols, sympy.Integer(0))
    sizes = (joint.coordinate_scale, joint.rate_scale, 1.0)

    def linear(term: sympy.Expr) -> Array | str:
        found = np.zeros(3)
        if term.free_symbols - set(symbols):
            return "it acts on the force, of which the response determines no more than the scale"
        for place, (symbol, gain, size) in enumerate(zip(symbols, gains, sizes, strict=True)):
            alone = term.xreplace({each: each if each == symbol else sympy.Integer(0) for each in symbols})
            rest = alone.xreplace(at_rest)
            found[place] = float((alone - rest).diff(symbol).xreplace(at_rest).doit()) / gain
            shown = float((alone - rest).xreplace({symbol: sympy.Float(size / gain)}).doit())
            if abs(shown - found[place] * size) > LINEAR_SHARE * abs(found[place] * size):
                return "it is not linear in the motion and is neglected: no transfer function contains it"
        if not found.any():
            return "it does not depend on the motion and is neglected as in the paper: no transfer function contains it"
        return found

    parts = {name: linear(term) for name, term in zip(balance.free, balance.regressors, strict=True)}
    parts |= dict.fromkeys(balance.shifts, "a delay is not part of the balance and is neglected")
    kept = {name: part for name, part in parts.items() if not isinstance(part, str)}
    if not kept:
        remedy = "estimate the inertia, a stiffness or a viscous friction."
        raise EstimationError(
            f"joint {joint.name}", "no estimated parameter is in its transfer function", remedy=remedy
        )
    motion = set(symbols)
    fixed = [each for each in sympy.Add.make_args(-balance.known) if each.free_symbols and each.free_symbols <= motion]
    known = linear(sympy.Add(*fixed)) if fixed else np.zeros(3)
    return Denominator(
        names=tuple(kept),
        known=known if isinstance(known, np.ndarray) else np.zeros(3),
        terms=np.array(list(kept.values())),
        neglected={name: part for name, part in parts.items() if isinstance(part, str)},
    )


def amplitude_fit(denominator: Denominator, measured: FrequencyResponse, parameters: Sequence[Parameter]) -> Fit:
    """The paper's (9)."""
    known, terms = denominator.at(measured.frequency)
    amplitude = np.abs(measured.response)
    size = np.array([size_of(p) for p in parameters])
    start = np.array([p.value for p in parameters]) / size
    lower, upper = (np.array([getattr(p, side) for p in parameters]) for side in ("lower", "upper"))
    power = float(amplitude @ amplitude)

    def misfit(scaled: Array) -> float:
        values = scaled * size
        if np.any(values < lower) or np.any(values > upper):
            return np.inf
        below = np.abs(known + terms @ values)
        return float(np.sum((1.0 / np.maximum(below, 1e-300) - amplitude) ** 2)) / power

    simplex = np.vstack((start, start + 0.1 * np.eye(len(size))))
    options = {"initial_simplex": simplex, "xatol": 1e-7, "fatol": 1e-12, "maxfev": STEPS}
    found = minimize(misfit, start, method="Nelder-Mead", options=options)
    values = found.x * size
    shown = 1.0 / (known + terms @ values)
    jacobian = -np.abs(shown)[:, None] * (terms * shown[:, None]).real
    residual = np.abs(shown) - amplitude
    gain = inverse(jacobian.T @ jacobian) @ jacobian.T
    return Fit(values, gain @ errors(measured, residual, len(size)) @ gain.T, bool(found.success))


def errors(measured: FrequencyResponse, residual: Array | ComplexArray, parameters: int, weight: float = 1.0) -> Array:
    """Covariance (m, m) of the measured amplitude, increased by the factor by which the `residual` exceeds it.

    `weight`: real numbers per residual (2 if it is complex).
    """
    std = measured.magnitude_std
    step = np.min(np.diff(measured.frequency))
    apart = np.abs(np.round((measured.frequency[:, None] - measured.frequency) / step)).astype(int)
    correlated = np.where(apart < len(OF_BINS), np.take(OF_BINS, np.minimum(apart, len(OF_BINS) - 1)), 0.0)
    left = float(np.sum(np.abs(residual) ** 2 / std**2)) / max(weight * len(std) - parameters, 1.0)
    covariance: Array = np.outer(std, std) * correlated * max(left, 1.0)
    return covariance


def _parameter(place: int, parameters: Sequence[Parameter], fit: Fit, whole: Array) -> ParameterEstimate:
    parameter, value = parameters[place], float(fit.values[place])
    std, required = float(np.sqrt(fit.covariance[place, place])), required_std(parameter)
    coverage = 100.0 * min(1.0, required / max(std, 1e-300))

    def unknown(status: Status, reason: str) -> ParameterEstimate:
        return ParameterEstimate(None, None, parameter.unit, status, coverage, reason)

    if not fit.converged:
        return unknown(Status.NOT_CONVERGED, f"the simplex did not converge in {STEPS} steps")
    if not std < required:
        reached = f"the response determines {parameter.name} to ± {about(std, parameter.unit)}"
        reason = f"{reached}, ± {about(required, parameter.unit)} is required"
        related = np.abs(np.delete(correlation(fit.covariance)[place], place))
        if len(related) and np.max(related) > 0.9:
            partner = [p.name for number, p in enumerate(parameters) if number != place][int(np.argmax(related))]
            return unknown(Status.UNIDENTIFIABLE, f"{reason}: {partner} has the same effect on it; hold one of them")
        return unknown(Status.TOO_LITTLE_EXCITATION, f"{reason}: excite a wider band, more strongly, or for longer")
    if not parameter.lower < value < parameter.upper:
        reason = f"the estimate of {parameter.name} is {value:.4g} {parameter.unit}, which is impossible"
        return unknown(Status.AT_BOUND, f"{reason}: check signs and units")
    return ParameterEstimate(value, float(np.sqrt(whole[place, place])), parameter.unit, Status.OK, coverage)
