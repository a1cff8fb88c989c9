"""The random disturbance that a fit found at each joint (models.random.disturbance): its RMS and its correlation time.

    std = q sqrt(correlation_time / 2)

where the logarithm of q is one of the estimated noises, and the correlation time one of the parameters. The covariance
of all of them gives the standard deviations (delta method). A fit determines the ratios of the noises; the filter's
corrections of the disturbance determine their common scale (NoiseModel.units). If a record shows no disturbance, an
upper bound of its RMS is reported. For a narrow-band force, if the model has one, frequency and damping ratio are
reported, too.

If a record is only a few correlation times long, the maximum-likelihood estimate of the correlation time is too short:
slow motion is attributed to the mean and to parameters. The rate 1 / correlation_time is too large by 4 / (the record's
length) on average, which is subtracted (Kendall, "Note on bias in the estimation of autocorrelation", 1954; Marriott,
Pope, "Bias in the estimation of autocorrelations", 1954: the first-order coefficient a, estimated together with a mean
from n samples, is too small by (1 + 3 a) / n).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.estimators.disturbance_estimate import DisturbanceEstimate, NarrowBandEstimate
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.maximum_likelihood import Fit
from upright.estimators.fit.result import inverse
from upright.models.model import Model
from upright.models.parts import Joint
from upright.models.random.disturbance import at_joints, narrow_at_joints, parameters_of, power_share
from upright.models.random.part import LEAST_TIMES

Array = NDArray[np.float64]

SHOWN = 0.5
"""Standard deviation of the logarithm of the RMS above which a record does not show a disturbance, but only bounds
it."""
STEP = 1e-3
"""Relative step of a correlation time, and step of the logarithm of a noise, for the derivatives of a unit."""
BOUND = 1.645
"""Standard deviations of that bound: 95 % of records without a disturbance exclude more than it."""
HALVINGS = 20
"""Number of bisections in the search for the bound."""
TOO_FAST = 4.0
"""Bias of the maximum-likelihood rate of a random signal, times the record's length: (1 + 3 a) for a near one."""


@dataclass(frozen=True, slots=True)
class Found:
    """The estimates: parameter `values` (np,) and `logarithms` (q,) of the noise, `covariance` (p + q, p + q) of the
    estimated parameters and the logarithms, and `innovation` (ny, ny), the covariance of the innovations over `rows`
    samples."""

    noise: NoiseModel
    values: Array
    logarithms: Array
    covariance: Array
    innovation: Array
    rows: int

    @classmethod
    def of(cls, fitted: Fit) -> Found:
        noise, size = NoiseModel.of(fitted.problem), len(fitted.problem.free)
        logarithms, covariance = fitted.minimum.common[size:], inverse(fitted.minimum.information)
        return cls(noise, fitted.values, logarithms, covariance, fitted.covariance, fitted.problem.rows)

    @property
    def model(self) -> Model:
        return self.noise.problem.model

    def first_order(self, place: int) -> tuple[float, float, float, float]:
        """RMS and correlation time of the random part at state `place`, without their bias, each with the standard
        deviation of its logarithm, which is 0 if the value was stated in advance."""
        task = self.noise.problem
        state, size = task.model.base_states[place], len(task.free)
        time_place = task.kernel.index(state.correlation_time)
        time, number = float(self.values[time_place]), self.noise.logarithm_of(state.name)
        # Derivatives of the logarithms of both with respect to the unknowns. Stated noise is absolute, with unit 1.
        unit, by_std, by_time = 1.0, np.zeros(len(self.covariance)), np.zeros(len(self.covariance))
        std = state.process_noise * math.sqrt(0.5 * time)
        if number is not None:
            unit, by_std = _unit(self, place, time_place)
            by_std[size + number] += 1.0
            std *= unit * math.exp(float(self.logarithms[number]))
        if time_place in task.free:
            column = task.free.index(time_place)
            # A record has at least LEAST_TIMES correlation times, unless the model itself states fewer.
            share = min(time / (self.rows * self.noise.spacing), 1.0 / LEAST_TIMES)
            longer = 1.0 / (1.0 - TOO_FAST * share)
            by_std[column] += 0.5 * longer / time
            by_time[column] = longer / time
            time *= longer
            std *= math.sqrt(longer)
        error, time_error = (math.sqrt(float(each @ self.covariance @ each)) for each in (by_std, by_time))
        if number is not None:
            error = min(error, float(self.noise.spread[number]))
        return std, error, time, time_error

    def narrow_band(self, place: int, unit: str) -> NarrowBandEstimate | None:
        """Estimate of the narrow-band random part at state `place`, in `unit`; None if its noise was stated in
        advance."""
        task = self.noise.problem
        state, size = task.model.base_states[place], len(task.free)
        time_place, frequency_place = (task.kernel.index(name) for name in (state.correlation_time, state.frequency))
        time, frequency = self.values[time_place], self.values[frequency_place]
        driving_place = next(
            n for n, each in enumerate(task.model.base_states) if each.name == (state.driven_by or state.name)
        )
        driving = task.model.base_states[driving_place]
        number = self.noise.logarithm_of(driving.name)
        if number is None:
            return None
        # Derivatives of the logarithms of RMS, frequency and damping ratio with respect to the unknowns.
        slopes = np.zeros((3, len(self.covariance)))
        grown, slopes[0] = _unit(self, driving_place, time_place)
        grown *= math.exp(float(self.logarithms[number]))
        std = grown * driving.process_noise * math.sqrt(power_share(driving) * time)
        by_frequency, by_time = (task.free.index(each) for each in (frequency_place, time_place))
        slopes[0, size + number] += 1.0
        slopes[0, by_time] += 0.5 / time
        slopes[1:, by_frequency] = (1.0 / frequency, -1.0 / frequency)
        slopes[2, by_time] = -1.0 / time
        estimates = np.array([std, frequency, 1.0 / (2.0 * math.pi * frequency * time)])
        errors = estimates * np.sqrt(np.diag(slopes @ self.covariance @ slopes.T))
        return NarrowBandEstimate(unit, *np.stack((estimates, errors), axis=1).ravel().tolist())


def disturbances(fitted: Fit) -> tuple[DisturbanceEstimate, ...]:
    """The disturbance of each joint that has one, in the model's order."""
    return of_joints(Found.of(fitted))


def of_joints(found: Found) -> tuple[DisturbanceEstimate, ...]:
    """The disturbance of each joint that has one, in the model's order."""
    narrow = {joint.name: found.narrow_band(place, joint.force_unit) for joint, place in narrow_at_joints(found.model)}
    return tuple(_of_joint(found, joint, place, narrow.get(joint.name)) for joint, place in at_joints(found.model))


def _of_joint(found: Found, joint: Joint, place: int, narrow: NarrowBandEstimate | None) -> DisturbanceEstimate:
    std, error, time, time_error = found.first_order(place)
    known = found.noise.logarithm_of(found.model.base_states[place].name) is None
    shown = known or error < SHOWN
    return DisturbanceEstimate(
        joint=joint.name,
        unit=joint.force_unit,
        std=std if shown else _bound(found, place),
        std_error=std * error if shown and not known else None,
        correlation_time=time if shown else None,
        correlation_time_error=time * time_error if shown and time_error > 0.0 else None,
        shown=shown,
        known=known,
        narrow_band=narrow,
    )


def _bound(found: Found, place: int) -> float:
    """95 % upper bound of the RMS of the disturbance at state `place`, for records as long as this one and with the
    correlation time from which the estimation starts.

    If there is no disturbance, a predictor that assumes a larger one has larger innovations than the record shows. The
    estimate is added, converted to that correlation time at the same power at low frequencies.
    """
    noise, values, logarithms = found.noise, found.values, found.logarithms
    model, kernel = noise.problem.model, noise.problem.kernel
    state = model.states[place]
    unit = _unit(found, place, kernel.index(state.correlation_time))[0]
    time = model.parameter(state.correlation_time).value
    number = noise.logarithm_of(state.name)
    assert number is not None
    faded = values[kernel.index(state.correlation_time)] / time
    values, none = values.copy(), logarithms.copy()
    values[kernel.index(state.correlation_time)] = time
    none[number] = low = -noise.widest[number]

    def size(logarithm: float) -> float:
        some = none.copy()
        some[number] = logarithm
        covariance = noise.innovation(values, none, noise.gain(values, some))
        return math.inf if covariance is None else found.rows * float(np.linalg.slogdet(covariance)[1])

    least, high = size(low), float(noise.widest[number])
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if size(middle) < least + BOUND**2 else (low, middle)
    ended = faded * math.exp(logarithms[number] - high)
    return unit * state.process_noise * math.exp(high) * math.sqrt(0.5 * time) * math.hypot(1.0, ended)


def _unit(found: Found, place: int, time: int) -> tuple[float, Array]:
    """Unit of the noise that drives the state at `place`, and the derivatives (p + q,) of its logarithm with respect to
    the estimated parameters, of which only that at `time` has one, and to the logarithms."""
    noise, values, free = found.noise, found.values, found.noise.problem.free
    moves = np.zeros((1 + 2 * (noise.size + 1), noise.size + 1))
    moves[1:] = np.repeat(STEP * np.eye(noise.size + 1), 2, axis=0)
    moves[2::2] *= -1.0
    many = np.repeat(values[None], len(moves), axis=0)
    many[:, time] *= 1.0 + moves[:, 0]
    units = noise.units(many, found.logarithms + moves[:, 1:], found.innovation)[:, place]
    rises = (np.log(units[1::2]) - np.log(units[2::2])) / (2.0 * STEP)
    slopes = np.concatenate((np.zeros(len(free)), rises[1:]))
    if time in free:
        slopes[free.index(time)] = rises[0] / values[time]
    return float(units[0]), slopes


def stated(model: Model, fitted: Fit) -> Model:
    """`model` with its disturbances held as `fitted` estimated them."""
    known = densities(fitted)
    values = dict(zip(fitted.problem.kernel.parameters, fitted.values.tolist(), strict=True))
    its = parameters_of([each for each in model.base_states if each.name in known])
    states = tuple(
        replace(each, process_noise=known[each.name], noise_known=True) if each.name in known else each
        for each in model.base_states
    )
    parameters = tuple(
        replace(each, value=values[each.name], estimated=False, std=0.0) if each.name in its else each
        for each in model.base_parameters
    )
    return replace(model, base_states=states, base_parameters=parameters)


def densities(fitted: Fit) -> Mapping[str, float]:
    """Fitted square root q of the density of the white noise that drives each disturbance, unit/sqrt(s), by state."""
    task, noise = fitted.problem, NoiseModel.of(fitted.problem)
    logarithms = fitted.minimum.common[len(task.free) :]
    shaken = [state for state in task.model.base_states if state.correlation_time]
    if not shaken:
        return {}
    if all(noise.logarithm_of(state.name) is None for state in shaken):
        return {state.name: state.process_noise for state in shaken}
    units = noise.units(fitted.values[None], logarithms[None], fitted.covariance)[0]
    places = {state.name: place for place, state in enumerate(task.model.states)}
    found = {}
    for state in shaken:
        number = noise.logarithm_of(state.name)
        grown = 1.0 if number is None else units[places[state.name]] * math.exp(float(logarithms[number]))
        found[state.name] = state.process_noise * grown
    return found


def is_of_disturbance(model: Model) -> frozenset[str]:
    """Names of the parameters of `model` that belong to a disturbance, and not to the machine."""
    return parameters_of(model.base_states)
