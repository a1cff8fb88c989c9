"""The random disturbance that a fit found at each joint (models.random.disturbance): its RMS and its correlation time.

    std = q sqrt(correlation_time / 2)

where the logarithm of q is among the noises that are estimated, and the correlation time among the parameters; the
covariance of all of them gives the standard deviations (delta method). A fit tells the ratios of the noises; how large
all are is told by what the filter corrects of the disturbance (NoiseModel.units). Where a record shows none, its RMS is
said to be less than a bound. Of one of a narrow band beside it, where the model has that, frequency and damping ratio
are told.

Of a record of few correlation times the likeliest one is too short: what moves slowly is taken for the mean, and for
parameters. The rate 1 / correlation_time is too large by 4 / (the record's length) on average, which is taken off
(Kendall, "Note on bias in the estimation of autocorrelation", 1954; Marriott, Pope, "Bias in the estimation of
autocorrelations", 1954: the coefficient of first order a, estimated beside a mean from n rows, is too small by
(1 + 3 a) / n).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimators.disturbance_estimate import DisturbanceEstimate, NarrowBandEstimate
from estimators.fit.innovations import NoiseModel
from estimators.fit.maximum_likelihood import Fit
from estimators.fit.result import inverse
from models.model import Model
from models.parts import Joint
from models.random.disturbance import at_joints, narrow_at_joints, parameters_of, power_share
from models.random.part import LEAST_TIMES

Array = NDArray[np.float64]

SHOWN = 0.5
"""Standard deviation of the logarithm of the RMS above which a record shows no disturbance, but bounds it."""
STEP = 1e-3
"""Share of a correlation time, or logarithm of a noise, by which it is moved for a derivative of a unit."""
BOUND = 1.645
"""Standard deviations of that bound: more than it is denied by 95 % of records without any."""
HALVINGS = 20
"""In which it is looked for."""
TOO_FAST = 4.0
"""By how much the likeliest rate of a random signal is too large, in records: (1 + 3 a) of the docstring where a is
near one."""


@dataclass(frozen=True, slots=True)
class Found:
    """What is known of the unknowns: parameter `values` (np,) and `logarithms` (q,) of the noise, `covariance`
    (p + q, p + q) of the estimated parameters and the logarithms, `innovation` (ny, ny) of the innovations of so many
    `rows`."""

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
        """RMS and correlation time of the random part at state `place`, less their bias, each with the standard
        deviation of its logarithm; 0 of what was stated."""
        task = self.noise.problem
        state, size = task.model.base_states[place], len(task.free)
        time_place = task.kernel.index(state.correlation_time)
        time, number = float(self.values[time_place]), self.noise.logarithm_of(state.name)
        # Derivatives of the logarithms of both by the unknowns. What was stated is absolute.
        unit, by_std, by_time = 1.0, np.zeros(len(self.covariance)), np.zeros(len(self.covariance))
        std = state.process_noise * math.sqrt(0.5 * time)
        if number is not None:
            unit, by_std = _unit(self, place, time_place)
            by_std[size + number] += 1.0
            std *= unit * math.exp(float(self.logarithms[number]))
        if time_place in task.free:
            column = task.free.index(time_place)
            # A record has LEAST_TIMES of it at least, or the model says itself that it has fewer.
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
        """Of the random part at state `place`, in `unit`; None of one that was stated, which is told by who did."""
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
        # Derivatives of the logarithms of RMS, frequency and damping ratio by the unknowns.
        slopes = np.zeros((3, len(self.covariance)))
        grown, slopes[0] = _unit(self, driving_place, time_place)
        grown *= math.exp(float(self.logarithms[number]))
        std = grown * driving.process_noise * math.sqrt(power_share(driving) * time)
        by_frequency, by_time = (task.free.index(each) for each in (frequency_place, time_place))
        slopes[0, size + number] += 1.0
        slopes[0, by_time] += 0.5 / time
        slopes[1:, by_frequency] = (1.0 / frequency, -1.0 / frequency)
        slopes[2, by_time] = -1.0 / time
        told = np.array([std, frequency, 1.0 / (2.0 * math.pi * frequency * time)])
        errors = told * np.sqrt(np.diag(slopes @ self.covariance @ slopes.T))
        return NarrowBandEstimate(unit, *np.stack((told, errors), axis=1).ravel().tolist())


def disturbances(fitted: Fit) -> tuple[DisturbanceEstimate, ...]:
    """Of each joint that has one, in the model's order."""
    return told(Found.of(fitted))


def told(found: Found) -> tuple[DisturbanceEstimate, ...]:
    """Of each joint that has one, in the model's order."""
    narrow = {joint.name: found.narrow_band(place, joint.force_unit) for joint, place in narrow_at_joints(found.model)}
    return tuple(_told(found, joint, place, narrow.get(joint.name)) for joint, place in at_joints(found.model))


def _told(found: Found, joint: Joint, place: int, narrow: NarrowBandEstimate | None) -> DisturbanceEstimate:
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
    """What the RMS of the disturbance at state `place` is less than in 95 % of records as long as this, with the
    correlation time from which the estimation starts.

    Where there is none, more of it in the predictor makes the innovations larger than a record shows them. The estimate
    comes on top, as one of that correlation time with the same power at low frequencies.
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
    """Unit of the noise that drives the state at `place`, and the derivatives of its logarithm by the estimated
    parameters, of which that at `time` alone has one, and by the logarithms, (p + q,)."""
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
    """`model` with the disturbances of `fitted` as what is known of them."""
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
    """By state, the fitted root q of the density of the white noise that drives each disturbance, unit/sqrt(s)."""
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
    """Names of the parameters of `model` that are a disturbance's, and not the machine's."""
    return parameters_of(model.base_states)
