"""Recursive prediction error and output error, for use while the vehicle runs: counterparts of the batch methods.

The compiled model's predictor runs over the control cycles, a tenth of a second at a time. After each chunk its
parameters are updated by the Gauss-Newton recursion with exact sensitivities (estimators.recursive.predictor). CAD
values with their standard deviations are the prior. Whether a parameter is identified is decided by the rules of
estimators.fit.result. The recursive output error simulates for a second at a time, each time from a fitted initial
state. Errors in the simulation of an unstable plant grow without bound, so there the time is bounded by the model's
fastest unstable pole at the start values.

Chunks depend on cycles alone, so live, replayed and simulated cycles give the same numbers bit for bit.
Source: Ljung, "System identification", 2nd ed., section 11.5.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from enum import StrEnum

import numpy as np

from upright.estimators.contract import Estimate, EstimationError, ParameterEstimate, Status
from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.estimators.fit.logarithms import is_known_roughly
from upright.estimators.fit.problem import Problem, jacobian, substeps_of, usual_motion
from upright.estimators.fit.random.disturbance import is_of_disturbance
from upright.estimators.recursive.frame_chunks import FrameChunks
from upright.estimators.recursive.predictor import RecursivePredictor, Seen
from upright.models import library
from upright.models.compiler.kernel import Progress, compile_model
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.models.random.disturbance import disturbed, parameters_of
from upright.models.segment import Segment
from upright.telemetry.channels import ChannelTable
from upright.telemetry.samples import Frame

CHUNK = 25
"""Samples that are processed together."""
WINDOW = 1.0
"""Length of a simulation, s, at most."""
GROWTH = 1.5
"""Natural logarithm of the growth of an initial error within a simulation, at most: a compromise. With more, the
disturbances that a simulation does not know grow beyond the motion that tells the parameters; with 1, the 26 samples of
the robot's windows do not determine its parameters."""
SHORTEST_SPAN = 0.4
"""s of free motion before a result is given."""
SMALLEST = 0.1
"""Lower bound of a parameter that must not vanish, as a share of its start value."""
LATEST = 0.05
"""Bound of input delays during the estimation, s, if the model's own bound is tighter."""


class Method(StrEnum):
    """The two forms, by the names under which results are reported."""

    PREDICTION_ERROR = "recursive_prediction_error"
    OUTPUT_ERROR = "recursive_output_error"


class RecursivePredictionError:
    """Estimator of a model's parameters from control cycles.

    `parameters` and `deviations` are the vehicle file's CAD values and their standard deviations; the model uses those
    of its own parameters. `support`: rad, the vehicle is free at a smaller coordinate of its first joint. `memory` (s)
    is the time constant of forgetting. The constructor compiles the model, which takes seconds if it is not in the
    cache (`progress` is called); no later call does. `watch` is called with every chunk of cycles.
    Raises EstimationError if nothing is to be estimated or a channel is missing, ModelError for an invalid model.
    """

    def __init__(
        self,
        model: Model | str,
        *,
        parameters: Mapping[str, float] | None = None,
        deviations: Mapping[str, float] | None = None,
        support: float | None = None,
        channels: ChannelTable,
        method: Method = Method.PREDICTION_ERROR,
        memory: float = math.inf,
        progress: Progress | None = None,
        watch: Callable[[Seen], None] | None = None,
    ) -> None:
        model = library.get(model) if isinstance(model, str) else model
        model = _computable(known_as(model, parameters, deviations))
        shaken = parameters_of(model.base_states)
        if not any(parameter.estimated and parameter.name not in shaken for parameter in model.parameters):
            raise EstimationError(f"model {model.name}", "no parameter is to be estimated", remedy="name at least one.")
        # A simulation that restarts every second has no memory of a disturbance.
        self._model = model = with_recursive_disturbances(model) if method is Method.PREDICTION_ERROR else model
        if not memory > 0.0:
            raise EstimationError("memory", f"{memory:g} s is invalid", remedy="give a positive time constant.")
        self._method = method
        self._memory = memory
        self.watch = watch
        """Is called with every chunk of cycles."""
        self._problem = at_rest(model, 0.01, progress)
        self._window = longest_window(self._problem) if method is Method.OUTPUT_ERROR else None
        self._chunks = FrameChunks(model, channels, support=support, rows=CHUNK, window=self._window or 0.0)
        self.reset()

    @property
    def method(self) -> str:
        return self._method.value

    def reset(self) -> None:
        """Forget all cycles."""
        self._chunks.reset()
        self._predictor: RecursivePredictor | None = None

    def update(self, frame: Frame) -> None:
        """Take one control cycle; those on the support, out of order or with unknown values are skipped."""
        chunk = self._chunks.update(frame)
        if chunk is None:
            return
        if self._predictor is None:
            period = self._chunks.period
            corrected = self._method is Method.PREDICTION_ERROR
            problem = at_rest(self._model, period)
            self._predictor = RecursivePredictor(problem, period, self._memory, corrected=corrected, watch=self.watch)
        self._predictor.take(chunk)

    def result(self) -> Estimate:
        """The model's parameters with standard deviations, which include the uncertainty of held parameters."""
        predictor = self._predictor
        if predictor is None or predictor.span < SHORTEST_SPAN:
            return self._no_result(0.0 if predictor is None else predictor.span)
        estimate = predictor.estimate(self.method)
        estimate = replace(estimate, samples=predictor.rows, span=predictor.span, window=self._window)
        if not predictor.lost:
            return estimate
        lost = f"the predictor lost the vehicle {predictor.lost} times and restarted from the measurement"
        return replace(estimate, reason="; ".join(filter(None, (estimate.reason, lost))))

    def disturbance(self) -> tuple[DisturbanceEstimate, ...]:
        """The random force at each joint, as in the result."""
        return () if self._predictor is None else self._predictor.disturbance()

    def _no_result(self, span: float) -> Estimate:
        came = "the vehicle has hardly left its supports" if self._chunks.cycles else "no control cycle has come in yet"
        reason = f"{span:.1f} s of free motion, {SHORTEST_SPAN:g} s are needed: {came}"
        lacking = Status.TOO_FEW_SAMPLES
        others = is_of_disturbance(self._problem.model)
        unknown = {
            p.name: ParameterEstimate(None, None, p.unit, lacking, 0.0, reason)
            for p in self._problem.parameters
            if p.name not in others
        }
        return Estimate(self.method, unknown, lacking, reason, 0, span)


def at_rest(model: Model, period: float, progress: Progress | None = None) -> Problem:
    """The estimation problem without data: the compiled model, and samples at rest every `period` s, for its poles and
    its noise."""
    kernel = compile_model(model, progress=progress)
    time = period * np.arange(3.0)
    inputs, outputs = len(kernel.inputs), len(kernel.outputs)
    knots = np.ascontiguousarray(np.repeat(time[:, None], inputs, axis=1))
    measured = np.zeros((3, outputs))
    # Identical outputs would share one noise (estimators.fit.innovations); unknown ones are not identical.
    measured[-1] = np.nan
    rest = Segment(time, knots, np.zeros((3, inputs)), measured, "at rest")
    free = tuple(place for place, parameter in enumerate(model.parameters) if parameter.estimated)
    own = tuple(place for place, state in enumerate(model.states) if state.initial_std > 0.0)
    substeps = substeps_of(kernel, kernel.vector(), (rest,), usual_motion(model))
    spread = np.array([model.states[place].initial_std for place in own])
    return Problem(model, kernel, (rest,), free, own, (), substeps, spread)


def longest_window(problem: Problem) -> float:
    """Length of a simulation of the model with its start values, s: an initial error grows by exp(GROWTH) at most."""
    kernel = problem.kernel
    pole = float(np.max(np.linalg.eigvals(jacobian(kernel, kernel.vector(), problem.segments)).real))
    return GROWTH / max(pole, GROWTH / WINDOW)


def known_as(
    model: Model, values: Mapping[str, float] | None = None, deviations: Mapping[str, float] | None = None
) -> Model:
    """`model` with those of `values` and `deviations` that belong to its own parameters."""
    names = {parameter.name for parameter in model.parameters}
    own = {name: value for name, value in (values or {}).items() if name in names}
    spread = {name: std for name, std in (deviations or {}).items() if name in names}
    return model.change(own, deviations=spread)


def with_recursive_disturbances(model: Model) -> Model:
    """`model` with the disturbances of recursive estimation.

    If only the order of magnitude of parameters is known (estimators.fit.logarithms), each disturbance is held at its
    start value: in the first seconds an estimated one would imitate the effect of the parameters, which would then move
    to values for which no filter works (docs/decisions.md).
    """
    its = parameters_of(model.base_states)
    if any(p.estimated and p.name not in its and is_known_roughly(p) for p in model.parameters):
        held = (each.disturbance and replace(each.disturbance, known=True) for each in model.joints)
        joints = tuple(replace(each, disturbance=known) for each, known in zip(model.joints, held, strict=True))
        model = replace(model, joints=joints)
    return disturbed(model, ())


def _computable(model: Model) -> Model:
    """The model with bounds within which it can be computed, unlike with an inertia of zero. During the estimation,
    input delays may exceed their physical bounds: when they were held to those of a bus, the robot's estimates went
    astray."""
    delays = {name for each in model.inputs for name in each.delays}

    def bounded(parameter: Parameter) -> Parameter:
        if parameter.lower == 0.0 < parameter.value and parameter.estimated:
            return replace(parameter, lower=SMALLEST * parameter.value)
        if parameter.name in delays:
            return replace(parameter, lower=min(parameter.lower, -LATEST), upper=max(parameter.upper, LATEST))
        return parameter

    return replace(model, base_parameters=tuple(map(bounded, model.base_parameters)))
