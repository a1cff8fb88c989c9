"""Which parameters the outputs could tell if there were no noise, and which occur only together with others.

The outputs' sensitivities, exact ones from the model's kernel, are stacked over motions from many starting states; what
an unknown starting state explains as well is taken out. A direction in which the parameters can move without any
output moving lies in the null space of what is left. With a gap of many decades between the singular values that are
rounding and those that are not, this is a test of local structural identifiability, for models of any form.

A motion can be generic (`generic_motions`) or that of a record: then it is what this experiment could tell at best.

Source: Jacquez, Greif, Math. Biosci. 77 (1985) 201 (sensitivity rank); Golub, Van Loan, Matrix Computations, section
5.5.7 (subset selection, for what to hold).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import null_space, qr

from estimators.contract import EstimationError
from estimators.fit.problem import FINEST, jacobian
from models.compiler.kernel import Kernel, compile_model
from models.expressions import names_in, parse
from models.model import Model
from models.segment import Segment

Array = NDArray[np.float64]

ROUNDING = 1e-10
"""Share of the largest singular value below which one is rounding: sensitivities are exact to about 1e-13."""
DRAWS = 3
"""Further parameter values, within a fifth of those given, at which the rank is looked at."""
SPREAD = 4.0
"""Generic motions start up to so many typical sizes away from zero, where sines and products show."""
SMALL = 1e-6
"""The same for motions in which nothing shows but what is linear: squares are less than rounding."""


@dataclass(frozen=True, slots=True)
class Motion:
    """An experiment without its readings: inputs in time, and the state (nx,) it starts from."""

    segment: Segment
    initial: Array


@dataclass(frozen=True, slots=True)
class Tie:
    """A way to move parameters that no output shows. `changes` are in percent for +1 % of `parameter` (first there).

    With one entry the parameter has no influence at all. Where it is a `product`, the changes are the same whatever the
    values: the outputs know products and quotients of these parameters only.
    """

    parameter: str
    changes: Mapping[str, float]
    product: bool

    def __str__(self) -> str:
        if len(self.changes) == 1:
            return f"{self.parameter} has no influence on any output"
        moves = ", ".join(f"{name} {change:+.3g} %" for name, change in self.changes.items())
        where = "in products and quotients alone" if self.product else "in sums with others"
        return f"{self.parameter} occurs {where}: no output changes with {moves}"


@dataclass(frozen=True, slots=True)
class Structure:
    """What the outputs can tell about `parameters`, whatever their noise.

    `rank` is how many combinations they tell at the model's values, `generic_rank` at values nearby: where it is
    larger, the values are special, as an effect's size of zero is. `null_space` (np, np - rank) are the directions that
    they do not tell, in multiples of `sizes`. `hold` is what to hold so that all others can be told: those that the
    priors know best. `ties` say the same in words, one for each that is held.
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
        """The smallest singular value that counts over the largest that does not; infinite where all or none count."""
        if self.rank in (0, len(self.parameters)):
            return np.inf
        return float(self.singular_values[self.rank - 1] / max(self.singular_values[self.rank], 1e-300))

    @property
    def free(self) -> tuple[str, ...]:
        """The parameters that can be told when those in `hold` are known."""
        return tuple(name for name in self.parameters if name not in self.hold)

    def tells(self, combination: str) -> bool:
        """Whether the outputs tell the value of `combination`, an expression of parameters such as `mass * height`.

        Raises ModelError where it is none, EstimationError where it has no parameter in it.
        """
        import sympy

        symbols = {name: sympy.Symbol(name, real=True) for name in self.values}
        expression = parse(combination, symbols, "combination")
        here = {symbols[name]: self.values[name] for name in names_in(combination)}
        gradient = np.array([float(expression.diff(symbols[name]).subs(here)) for name in self.parameters]) * self.sizes
        if not np.any(gradient):
            what = "does not depend on a parameter that was looked at"
            raise EstimationError(combination, what, remedy=f"use one of: {', '.join(self.parameters)}.")
        return bool(np.linalg.norm(self.null_space.T @ gradient) < 1e-6 * np.linalg.norm(gradient))


def structure(
    model: Model, motions: Sequence[Motion] | None = None, parameters: Sequence[str] | None = None
) -> Structure:
    """What the outputs of `model` tell in `motions` (generic ones by default) about `parameters`.

    By default these are all that are estimated or not known exactly. Raises ModelError for a name that the model does
    not have, EstimationError where there is nothing to look at or a motion runs away.
    """
    if parameters is None:
        parameters = [each.name for each in model.parameters if each.estimated or each.std > 0.0]
    chosen = [model.parameter(name) for name in parameters]
    if not chosen:
        raise EstimationError("parameters", "there are none to look at", remedy="name those that are not known.")
    kernel = compile_model(model)
    motions = motions if motions is not None else generic_motions(model)
    columns = [kernel.index(each.name) for each in chosen]
    sizes = np.array([abs(each.value) or each.typical for each in chosen])
    singular, null = _null_space(_sensitivities(kernel, kernel.vector(), motions, columns) * sizes)

    source = np.random.default_rng(0)  # any values do: special ones have measure zero
    nearby = []
    for _ in range(DRAWS):
        shift = sizes * source.uniform(-0.2, 0.2, len(chosen))
        moved = np.clip(
            [each.value for each in chosen] + shift, [each.lower for each in chosen], [each.upper for each in chosen]
        )
        values = kernel.vector({each.name: float(value) for each, value in zip(chosen, moved, strict=True)})
        there = np.where(moved == 0.0, sizes, np.abs(moved))
        nearby.append(_null_space(_sensitivities(kernel, values, motions, columns) * there)[1])

    # Products first: what is left of the null space once their parameters are held are the other combinations.
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
    """Motions that hide nothing: random starting states, inputs of random sines, `rows` each, `spacing` s apart.

    `size` is in typical sizes of the model's joints, sensors and actuators; with SMALL it is the linearised model that
    is looked at. `same` are groups of states or of inputs that have one value, as both motors of a vehicle that drives
    straight.
    """
    source = np.random.default_rng(1)  # any motion does, see above
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
    """`model` with what `found` proposes to hold held, and all else that was looked at estimated."""
    kept = {each.name for each in model.parameters if each.estimated} - set(found.parameters)
    return model.change(estimated=kept | set(found.free))


def _sizes(model: Model) -> dict[str, float]:
    """A typical size of each state and input."""
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
    """(m, np) by the parameters, each output in multiples of its movement, starting states projected out."""
    segments = [motion.segment for motion in motions]
    fastest = float(np.max(np.abs(np.linalg.eigvals(jacobian(kernel, values, segments)))))
    substeps = [
        int(np.clip(np.ceil(float(np.median(np.diff(each.time))) * fastest / FINEST), 1, 50)) for each in segments
    ]
    starts = range(len(kernel.parameters), len(kernel.parameters) + len(kernel.states))
    runs = [
        kernel.run(motion.segment, values, motion.initial, active=(*columns, *starts), substeps=steps)
        for motion, steps in zip(motions, substeps, strict=True)
    ]
    if any(run.diverges for run in runs):
        raise EstimationError("motions", "the model runs away in one", remedy="make them shorter.")
    moved = np.std(np.concatenate([run.predicted for run in runs]), axis=0)
    moved[moved == 0.0] = 1.0
    stacked = []
    for run in runs:
        rows = (run.sensitivity / moved[:, None]).reshape(-1, len(columns) + len(kernel.states))
        by_parameter, by_start = rows[:, : len(columns)], rows[:, len(columns) :]
        length = np.linalg.norm(by_start, axis=0)
        basis = np.linalg.qr(by_start[:, length > 0.0] / length[length > 0.0])[0]
        # Twice, since what is left after once may be small beside what was taken out.
        for _ in range(2):
            by_parameter = by_parameter - basis @ (basis.T @ by_parameter)
        stacked.append(by_parameter)
    return np.concatenate(stacked)


def _null_space(sensitivities: Array) -> tuple[Array, Array]:
    """Singular values, and the right singular vectors (np, k) of those that are rounding."""
    triangle = np.linalg.qr(sensitivities, mode="r")
    _, singular, right = np.linalg.svd(triangle)
    rank = int(np.sum(singular > ROUNDING * singular[0])) if singular[0] > 0.0 else 0
    return singular, np.ascontiguousarray(right[rank:].T)


def _common(spaces: Sequence[Array]) -> Array:
    """The directions (np, k) that are in all of `spaces`."""
    size = len(spaces[0])
    outside = sum((np.eye(size) - space @ space.T for space in spaces), np.zeros((size, size)))
    values, vectors = np.linalg.eigh(outside)
    return np.asarray(vectors[:, values < 1e-9])


def _best_known(directions: Array, sizes: Array, deviations: Array) -> list[int]:
    """Parameters, as many as there are directions, whose priors leave the least freedom along them."""
    if not directions.shape[1]:
        return []
    in_deviations = directions * (sizes / deviations)[:, None]
    _, _, order = qr(np.linalg.qr(in_deviations)[0].T, mode="economic", pivoting=True)
    return [int(place) for place in order[: directions.shape[1]]]


def _ties(names: Sequence[str], directions: Array, held: Sequence[int], *, product: bool) -> list[Tie]:
    """`directions` in words: one for each of `held`, in which the others of them rest."""
    apart = directions @ np.linalg.inv(directions[list(held)])
    ties = []
    for column, place in enumerate(held):
        moving = np.flatnonzero(np.abs(apart[:, column]) > 1e-7 * np.max(np.abs(apart[:, column])))
        order = [place, *(int(each) for each in moving if each != place)]
        ties.append(Tie(names[place], {names[each]: float(apart[each, column]) for each in order}, product))
    return ties
