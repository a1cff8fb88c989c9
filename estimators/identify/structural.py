"""Structural identifiability: which parameters the outputs determine without noise, and which only in combinations.

The outputs' exact sensitivities, from the model's kernel, are stacked over motions from many initial states. The part
that an unknown initial state explains as well is projected out. A direction in which the parameters can change without
a change of any output lies in the null space of the remainder. With a gap of many decades between the singular values
that are rounding and those that are not, this is a test of local structural identifiability, for models of any form.

A motion can be generic (`generic_motions`) or that of a record: then the result is the best case for this experiment.

Source: Jacquez, Greif, Math. Biosci. 77 (1985) 201 (sensitivity rank); Golub, Van Loan, Matrix Computations, section
5.5.7 (subset selection, for what to hold).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, qr

from upright.estimators.contract import EstimationError
from upright.estimators.fit.problem import jacobian, steps_within
from upright.models.compiler.kernel import Kernel, compile_model
from upright.models.model import Model
from upright.models.segment import Segment
from upright.models.text.expressions import names_in, parse

Array = NDArray[np.float64]

ROUNDING = 1e-10
"""Share of the largest singular value below which one counts as rounding: sensitivities are exact to about 1e-13."""
DRAWS = 3
"""Number of further parameter values, within a fifth of those given, at which the rank is computed."""
SPREAD = 4.0
"""Generic motions start up to this many typical magnitudes away from zero, where sines and products have an effect."""
SMALL = 1e-6
"""The same for motions in which only linear terms have an effect: squares are below rounding."""


@dataclass(frozen=True, slots=True)
class Motion:
    """An experiment without measurements: inputs in time, and the initial state (nx,)."""

    segment: Segment
    initial: Array


@dataclass(frozen=True, slots=True)
class Tie:
    """A change of parameters without effect on any output. `changes` are in percent for +1 % of `parameter`, which is
    the first entry.

    With one entry the parameter has no influence at all. If it is a `product`, the changes are the same for all values:
    the outputs depend on products and quotients of these parameters only.
    """

    parameter: str
    changes: Mapping[str, float]
    product: bool

    def __str__(self) -> str:
        if len(self.changes) == 1:
            return f"{self.parameter} has no influence on any output"
        moves = ", ".join(f"{name} {change:+.3g} %" for name, change in self.changes.items())
        where = "only in products and quotients" if self.product else "only in sums with others"
        return f"{self.parameter} occurs {where}: no output changes with {moves}"


@dataclass(frozen=True, slots=True)
class Structure:
    """Identifiability of `parameters` from the outputs, whatever their noise.

    `rank` is the number of identifiable combinations at the model's values, `generic_rank` that at nearby values: if it
    is larger, the values are special, such as an effect's amplitude of zero. `null_space` (np, np - rank) are the
    directions that are not identifiable, in multiples of `sizes`. `hold` are the parameters to hold so that all others
    are identifiable: those with the most precise priors. `ties` say the same in words, one for each of `hold`.
    """

    parameters: tuple[str, ...]
    sizes: Array
    values: Mapping[str, float]
    rank: int
    generic_rank: int
    singular_values: Array
    null_space: Array
    hold: tuple[str, ...]
    ties: tuple[Tie, ...]

    @property
    def gap(self) -> float:
        """The smallest singular value that counts over the largest that does not; infinite if all or none count."""
        if self.rank in (0, len(self.parameters)):
            return np.inf
        return float(self.singular_values[self.rank - 1] / max(self.singular_values[self.rank], 1e-300))

    @property
    def free(self) -> tuple[str, ...]:
        """The parameters that are identifiable if those in `hold` are known."""
        return tuple(name for name in self.parameters if name not in self.hold)

    def identifies(self, combination: str) -> bool:
        """Whether `combination`, an expression of parameters such as `mass * height`, is identifiable from the outputs.

        Raises ModelError if it is not an expression, EstimationError if it depends on none of the parameters.
        """
        import sympy

        symbols = {name: sympy.Symbol(name, real=True) for name in self.values}
        expression = parse(combination, symbols, "combination")
        here = {symbols[name]: self.values[name] for name in names_in(combination)}
        gradient = np.array([float(expression.diff(symbols[name]).subs(here)) for name in self.parameters]) * self.sizes
        if not np.any(gradient):
            what = "depends on none of the examined parameters"
            raise EstimationError(combination, what, remedy=f"use one of: {', '.join(self.parameters)}.")
        return bool(np.linalg.norm(self.null_space.T @ gradient) < 1e-6 * np.linalg.norm(gradient))


def structure(
    model: Model, motions: Sequence[Motion] | None = None, parameters: Sequence[str] | None = None
) -> Structure:
    """Identifiability of `parameters` from the outputs of `model` in `motions` (by default generic ones).

    By default these are all parameters that are estimated or not known exactly. Raises ModelError for an unknown name,
    EstimationError if there are no parameters or the model diverges in a motion.
    """
    if parameters is None:
        parameters = [each.name for each in model.parameters if each.estimated or each.std > 0.0]
    chosen = [model.parameter(name) for name in parameters]
    if not chosen:
        raise EstimationError("parameters", "there are none to examine", remedy="name those that are not known.")
    kernel = compile_model(model)
    motions = motions if motions is not None else generic_motions(model)
    columns = [kernel.index(each.name) for each in chosen]
    sizes = np.array([abs(each.value) or each.typical for each in chosen])
    singular, null = _null_space(_sensitivities(kernel, kernel.vector(), motions, columns) * sizes)

    source = np.random.default_rng(0)  # any values will do: special ones have measure zero
    nearby = []
    for _ in range(DRAWS):
        shift = sizes * source.uniform(-0.2, 0.2, len(chosen))
        moved = np.clip(
            [each.value for each in chosen] + shift, [each.lower for each in chosen], [each.upper for each in chosen]
        )
        values = kernel.vector({each.name: float(value) for each, value in zip(chosen, moved, strict=True)})
        there = np.where(moved == 0.0, sizes, np.abs(moved))
        nearby.append(_null_space(_sensitivities(kernel, values, motions, columns) * there)[1])

    # Products first: with their parameters held, the remaining null space contains the other combinations.
    deviations = np.array([each.typical for each in chosen])
    products = _common([null, *nearby])
    factors = _best_known(products, sizes, deviations)
    sums = null @ null_space(null[factors]) if factors else null
    summands = _best_known(sums, sizes, deviations)
    ties = _ties(parameters, products, factors, product=True) + _ties(parameters, sums, summands, product=False)
    return Structure(
        parameters=tuple(parameters),
        sizes=sizes,
        values=model.values,
        rank=len(chosen) - null.shape[1],
        generic_rank=len(chosen) - min(each.shape[1] for each in (null, *nearby)),
        singular_values=singular,
        null_space=null,
        hold=tuple(parameters[place] for place in sorted((*factors, *summands))),
        ties=tuple(ties),
    )


def generic_motions(
    model: Model,
    *,
    same: Sequence[Sequence[str]] = (),
    size: float = SPREAD,
    motions: int = 12,
    rows: int = 100,
    spacing: float = 5e-3,
) -> tuple[Motion, ...]:
    """Motions that excite everything: random initial states, inputs of random sines, `rows` samples each, `spacing` s
    apart.

    `size` is in typical magnitudes of the model's joints, sensors and actuators; with SMALL the linearised model is
    examined. `same` are groups of states or of inputs with the same value, as both motors of a vehicle that drives
    straight.
    """
    source = np.random.default_rng(1)  # any motion will do, see above
    sizes = _sizes(model)
    states, inputs = [state.name for state in model.states], [each.name for each in model.inputs]
    time: Array = spacing * np.arange(rows, dtype=np.float64)
    found = []
    for _ in range(motions):
        initial = size * source.uniform(-1.0, 1.0, len(states)) * [sizes[name] for name in states]
        frequencies, phases = source.uniform(0.5, 10.0, (3, len(inputs))), source.uniform(0.0, 6.3, (3, len(inputs)))
        waves = np.sin(2.0 * np.pi * frequencies * time[:, None, None] + phases).sum(axis=1)
        driven = size / SPREAD * waves * np.array([sizes[name] for name in inputs])
        for group in same:
            for names, values in ((states, initial), (inputs, driven)):
                first, *others = [names.index(name) for name in group if name in names] or [0]
                values[..., others] = values[..., [first]]
        knots = np.repeat(time[:, None], len(inputs), axis=1)
        unknown = np.full((rows, len(model.outputs)), np.nan)
        segment = Segment(time, knots, np.array(driven, dtype=np.float64), unknown, source="generic motion")
        found.append(Motion(segment, initial))
    return tuple(found)


def reduced(model: Model, found: Structure) -> Model:
    """`model` with the parameters that `found` proposes to hold held, and the other examined ones estimated."""
    kept = {each.name for each in model.parameters if each.estimated} - set(found.parameters)
    return model.change(estimated=kept | set(found.free))


def _sizes(model: Model) -> dict[str, float]:
    """A typical magnitude of each state and input."""
    sizes = {state.name: state.initial_std or 1.0 for state in model.states}
    sizes |= {each.name: 1.0 if each.usual is None else each.usual for each in model.inputs}
    known: dict[str, float] = {}
    for sensor in model.sensors:
        known |= {sensor.angle: sensor.angle_scale, sensor.rate: sensor.rate_scale}
    for joint in model.joints:
        known |= {joint.coordinate: joint.coordinate_scale, joint.rate: joint.rate_scale}
    known |= {name: actuator.command_scale for actuator in model.actuators for name in actuator.commands}
    return sizes | {name: size for name, size in known.items() if name in sizes}


def _sensitivities(kernel: Kernel, values: Array, motions: Sequence[Motion], columns: Sequence[int]) -> Array:
    """Sensitivities (m, np) to the parameters, each output in multiples of its standard deviation, with initial states
    projected out."""
    segments = [motion.segment for motion in motions]
    matrix = jacobian(kernel, values, segments)
    substeps = [steps_within(float(np.median(np.diff(each.time))), matrix) for each in segments]
    starts = range(len(kernel.parameters), len(kernel.parameters) + len(kernel.states))
    runs = [
        kernel.run(motion.segment, values, motion.initial, active=(*columns, *starts), substeps=steps)
        for motion, steps in zip(motions, substeps, strict=True)
    ]
    if any(run.diverges for run in runs):
        raise EstimationError("motions", "the model diverges in one of them", remedy="make them shorter.")
    moved = np.std(np.concatenate([run.predicted for run in runs]), axis=0)
    moved[moved == 0.0] = 1.0
    stacked = []
    for run in runs:
        rows = (run.sensitivity / moved[:, None]).reshape(-1, len(columns) + len(kernel.states))
        by_parameter, by_start = rows[:, : len(columns)], rows[:, len(columns) :]
        length = np.linalg.norm(by_start, axis=0)
        basis = np.linalg.qr(by_start[:, length > 0.0] / length[length > 0.0])[0]
        # Twice, since the remainder of the first projection may be small compared with the projected part.
        for _ in range(2):
            by_parameter = by_parameter - basis @ (basis.T @ by_parameter)
        stacked.append(by_parameter)
    return np.concatenate(stacked)


def _null_space(sensitivities: Array) -> tuple[Array, Array]:
    """Singular values, and the right singular vectors (np, k) of those that count as rounding."""
    triangle = np.linalg.qr(sensitivities, mode="r")
    _, singular, right = np.linalg.svd(triangle)
    rank = int(np.sum(singular > ROUNDING * singular[0])) if singular[0] > 0.0 else 0
    return singular, np.ascontiguousarray(right[rank:].T)


def _common(spaces: Sequence[Array]) -> Array:
    """The intersection (np, k) of all `spaces`."""
    size = len(spaces[0])
    outside = sum((np.eye(size) - space @ space.T for space in spaces), np.zeros((size, size)))
    values, vectors = np.linalg.eigh(outside)
    return np.asarray(vectors[:, values < 1e-9])


def _best_known(directions: Array, sizes: Array, deviations: Array) -> list[int]:
    """Indices of as many parameters as there are directions: those whose priors restrict the directions most."""
    if not directions.shape[1]:
        return []
    in_deviations = directions * (sizes / deviations)[:, None]
    _, _, order = qr(np.linalg.qr(in_deviations)[0].T, mode="economic", pivoting=True)
    return [int(place) for place in order[: directions.shape[1]]]


def _ties(names: Sequence[str], directions: Array, held: Sequence[int], *, product: bool) -> list[Tie]:
    """`directions` as ties: one for each of `held`, in which the others of `held` do not change."""
    apart = directions @ np.linalg.inv(directions[list(held)])
    ties = []
    for column, place in enumerate(held):
        moving = np.flatnonzero(np.abs(apart[:, column]) > 1e-7 * np.max(np.abs(apart[:, column])))
        order = [place, *(int(each) for each in moving if each != place)]
        ties.append(Tie(names[place], {names[each]: float(apart[each, column]) for each in order}, product))
    return ties
