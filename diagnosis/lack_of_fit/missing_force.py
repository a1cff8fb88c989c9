"""The force that a model lacks at its joints, over time, with its standard deviation: N m or N.

    inertia * rate' = load + effects + missing force

It shows in the predictor's innovations (diagnosis.lack_of_fit.force_probe). Modelled as a random walk, its best
estimate is given by a Kalman filter and a Rauch-Tung-Striebel smoother with steady-state gains, here in the form of
Bryson and Frazier, in which no covariance is inverted. Source: Rauch, Tung and Striebel, AIAA Journal 3 (1965)
1445-1450; Bierman, Factorization methods for discrete sequential estimation (1977), chapter X; the likelihood in the
frequency domain: Whittle, Arkiv foer Matematik 2 (1953) 423-434.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are
from scipy.optimize import brentq, minimize_scalar

from upright.diagnosis.lack_of_fit.floor import Innovations
from upright.diagnosis.lack_of_fit.force_probe import Probe, Response, recurrence
from upright.estimators.contract import EstimationError
from upright.estimators.fit.gauss_newton import Block, eliminate
from upright.estimators.fit.stationary import stationary
from upright.estimators.tails import chi2_sf

Array = NDArray[np.float64]

STEPS = np.logspace(-6.0, 3.0, 46)
"""Steps of the random walk that are tried, s^-1/2, in units of the force that shows in one sample as much as noise."""
OWN = 1e-3
"""Share of the response to a force that no forces at other joints produce, above which the force is distinguishable
from them: derivatives agree to less."""
FADING = 1e-6
"""Share of the variance of a state's error that is added per sample if it does not decay and no noise drives it."""


@dataclass(frozen=True, slots=True)
class MissingForce:
    """The force missing at one joint: by segment `time` (s) and `force`, each (n,), and its steady-state `std`.

    `floor` is the RMS that the estimate has from noise alone if nothing is missing, `p_value` the probability of so
    likely a random force in that case. `step` is that of the random walk, force/sqrt(s).
    """

    joint: str
    unit: str
    time: tuple[Array, ...]
    force: tuple[Array, ...]
    std: float
    floor: float
    step: float
    p_value: float

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(np.concatenate(self.force) ** 2)))


def missing_force(found: Innovations, probed: Probe) -> tuple[MissingForce, ...]:
    """The force missing at each joint, each with its most likely random walk.

    Joints are estimated together. If a model has more of them than degrees of freedom, a record cannot distribute a
    force among them: a joint whose response is a combination of those before it is estimated as if the whole missing
    force acted there.
    """
    if not probed.joints:
        return ()
    floor = found.floor
    # Only outputs whose noise the record shows: a noise that is stated too large would hide what the others show.
    chosen = floor.informative
    whitener = np.linalg.inv(np.linalg.cholesky(floor.covariance[np.ix_(chosen, chosen)]))
    blocks = _with_first(found, probed.response)
    back = np.linalg.cholesky(floor.covariance)
    left = [
        eliminate(block)[0][: part.size].reshape(part.shape) for block, part in zip(blocks, found.errors, strict=True)
    ]
    white = [(part @ back.T)[:, chosen] @ whitener.T for part in left]
    freedom = float(np.min(floor.freedom[chosen]))
    steps, p_values, floors = [], [], []
    for place in range(len(probed.joints)):
        impulse = probed.response.impulse(place, max(map(len, white)))[:, chosen] @ whitener.T
        step, p_value, noise = _likeliest(white, impulse, floor.spacing, freedom)
        steps.append(step)
        p_values.append(p_value)
        floors.append(noise)
    forces, deviations = _by_joint(found, blocks, probed.response, np.array(steps))
    return tuple(
        MissingForce(
            joint=joint.name,
            unit=joint.force_unit,
            time=tuple(segment.time for segment in found.problem.segments),
            force=tuple(part[:, place] for part in forces),
            std=float(deviations[place]),
            floor=floors[place],
            step=float(steps[place]),
            p_value=p_values[place],
        )
        for place, joint in enumerate(probed.joints)
    )


def _likeliest(white: list[Array], impulse: Array, spacing: float, freedom: float) -> tuple[float, float, float]:
    """The step of the random walk, force/sqrt(s), the p-value of its being there at all, and the RMS that the smoothed
    force has from noise alone.

    The step is one standard deviation above the most likely one, which is zero if the record shows nothing: otherwise a
    force that the record could hide would go unreported.
    """
    powers, projected, gains, walks = [], [], [], []
    for part in white:
        count = len(part)
        transfer = np.fft.rfft(impulse, count, axis=0)[1:]
        spectrum = np.fft.rfft(part, axis=0)[1:] / np.sqrt(count)
        size = np.sum(np.abs(transfer) ** 2, axis=1)
        powers.append(np.sum(np.abs(spectrum) ** 2, axis=1))
        projected.append(np.abs(np.sum(np.conj(transfer) * spectrum, axis=1)) ** 2)
        gains.append(size)
        turn = 2.0 * np.pi * np.arange(1, len(size) + 1) / count
        walks.append(spacing / np.abs(1.0 - np.exp(1j * turn)) ** 2)
    power, matched, gain, walk = (np.concatenate(each) for each in (powers, projected, gains, walks))
    outputs, lines = white[0].shape[1], len(power)

    def cost(logarithm: float) -> float:
        """Minus the log-likelihood. Prior knowledge of the noise level counts as so many further lines without a
        force."""
        density = np.exp(2.0 * logarithm) * walk
        growth = 1.0 + density * gain
        rest = float(np.sum(power - density * matched / growth))
        if np.isinf(freedom):
            return float(np.sum(np.log(growth))) + rest
        total = outputs * lines + 0.5 * freedom
        return float(np.sum(np.log(growth)) + total * np.log((rest + 0.5 * freedom) / total))

    unit = 1.0 / np.sqrt(float(np.max(gain)))
    tried = np.log(unit * STEPS)
    costs = [cost(each) for each in tried]
    best = int(np.argmin(costs))
    inside = (float(tried[max(best - 1, 0)]), float(tried[min(best + 1, len(tried) - 1)]))
    peak = float(minimize_scalar(cost, bounds=inside, method="bounded", options={"xatol": 0.02}).x)
    statistic = 2.0 * (cost(-np.inf) - cost(peak))
    p_value = 0.5 * float(chi2_sf(statistic, 1)) if statistic > 0.0 else 1.0
    limit = cost(peak) + 0.5
    past = next((float(each) for each in tried if each > peak and cost(each) > limit), peak)
    step = float(np.exp(brentq(lambda each: cost(each) - limit, peak, past, xtol=0.01) if past > peak else peak))
    density = step**2 * walk
    noise = float(np.sum(density**2 * gain / (1.0 + density * gain) ** 2)) / lines
    return step, p_value, noise**0.5


def _by_joint(
    found: Innovations, blocks: Sequence[Block], response: Response, steps: Array
) -> tuple[list[Array], Array]:
    """`_smoothed` for all joints: those with independent responses together, every other one alone.

    Each alone, too, if the difference between their responses hardly shows, as for the mode of a mass that is sprung at
    one of them.
    """
    together, others = _independent(response)
    forces = [np.zeros((len(part), len(steps))) for part in found.errors]
    deviations = np.zeros(len(steps))
    groups = [together, *([place] for place in others)]
    while groups:
        group = groups.pop()
        few = replace(response, drive=response.drive[:, group], direct=response.direct[:, group])
        own = [replace(each, own=_first_of(each, len(steps), group)) for each in blocks]
        try:
            parts, deviations[group] = _smoothed(found, own, few, steps[group])
        except EstimationError:
            if len(group) == 1:
                raise
            groups += [[place] for place in group]
            continue
        for force, part in zip(forces, parts, strict=True):
            force[:, group] = part
    return forces, deviations


def _independent(response: Response) -> tuple[list[int], list[int]]:
    """Places of joints whose responses are no combination of those before them, and of the rest."""
    shown = np.vstack((response.drive, response.floor.whitener @ response.direct))
    shown = shown / np.linalg.norm(shown, axis=0)
    together: list[int] = []
    for place in range(shown.shape[1]):
        column, before = shown[:, place], shown[:, together]
        if np.linalg.norm(column + before @ _least(before, column)) > OWN:
            together.append(place)
    return together, [place for place in range(shown.shape[1]) if place not in together]


def _first_of(block: Block, joints: int, group: Sequence[int]) -> Array:
    """The own columns of `block`, of those for the first forces only the joints `group`."""
    rest = block.own.shape[1] - joints
    return block.own[:, [*range(rest), *(rest + place for place in group)]]


def _smoothed(
    found: Innovations, blocks: Sequence[Block], response: Response, steps: Array
) -> tuple[list[Array], Array]:
    """Forces by segment, (n, nj), and their standard deviations, (nj,)."""
    floor = response.floor
    states, joints = response.drive.shape
    # Forces in units of their own step: the Riccati solver fails for numbers ten orders of magnitude apart.
    size = steps * np.sqrt(floor.spacing)
    transition = np.block([[floor.predictor, response.drive * size], [np.zeros((joints, states)), np.eye(joints)]])
    output = floor.whitener @ np.hstack((floor.output, response.direct * size))
    driven = np.diag(np.concatenate((np.zeros(states), np.ones(joints))))
    spread = np.concatenate((np.diag(floor.state_covariance), np.zeros(joints)))
    covariance = _settled(transition, output, driven, spread)
    surprise = output @ covariance @ output.T + np.eye(len(output))
    gain = np.asarray(transition @ covariance @ output.T @ np.linalg.inv(surprise))
    closed = transition - gain @ output
    pulled = output.T @ np.linalg.inv(surprise)
    # Each state in units of its own standard deviation, for the same reason.
    own = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    own[own == 0.0] = 1.0
    scaled = closed.T * own[:, None] / own[None, :]
    information = stationary(scaled, (pulled @ output) * np.outer(own, own)) / np.outer(own, own)
    left = covariance - covariance @ information @ covariance

    def filtered(white: Array) -> Array:
        return recurrence(closed, np.vstack((np.zeros(len(closed)), white[:-1] @ gain.T)))

    weights = np.linalg.inv(np.linalg.cholesky(surprise))
    forces = []
    for part, first in _started(found, blocks, lambda white: (white - filtered(white) @ output.T) @ weights.T):
        state = filtered(part)
        surprises = (part - state @ output.T) @ pulled.T
        smooth = state + recurrence(closed.T, surprises[::-1])[::-1] @ covariance
        forces.append(smooth[:, states:] * size + first)
    return forces, np.sqrt(np.maximum(np.diag(left)[states:], 0.0)) * size


def _settled(transition: Array, output: Array, driven: Array, spread: Array) -> Array:
    """The steady-state covariance of the filtered state, for unit noise of `output`.

    It does not exist if a part of the predictor's state does not decay and no noise drives it, such as the state of a
    filter that a record does not have. Then FADING of the prior variances `spread` is added per sample. Raises
    EstimationError if that does not help.
    """
    noise = np.eye(len(output))
    try:
        return np.asarray(solve_discrete_are(transition.T, output.T, driven, noise))
    except np.linalg.LinAlgError:
        pass
    try:
        return np.asarray(solve_discrete_are(transition.T, output.T, driven + FADING * np.diag(spread), noise))
    except np.linalg.LinAlgError as error:
        what = f"cannot be estimated with this predictor ({error})"
        raise EstimationError(
            "missing force", what, remedy="check the noises and filters that the model states."
        ) from error


def _with_first(found: Innovations, response: Response) -> list[Block]:
    """The innovations' blocks, with the response to a constant force at each joint as the last of their own columns."""
    blocks = []
    for block, part in zip(found.blocks(), found.errors, strict=True):
        shown = np.zeros((len(block.residual), response.drive.shape[1]))
        for joint in range(shown.shape[1]):
            constant = np.cumsum(response.impulse(joint, len(part)), axis=0) @ found.floor.whitener.T
            shown[: part.size, joint] = -constant.ravel()
        blocks.append(replace(block, own=np.hstack((block.own, shown))))
    return blocks


def _started(
    found: Innovations, blocks: Sequence[Block], surprises: Callable[[Array], Array]
) -> Iterator[tuple[Array, Array]]:
    """By segment, whitened innovations (n, ny) without the response to the first force (nj,), and that force.

    Initial states and nuisances that were fitted without a force have absorbed a part of it: here they are fitted
    again, together with the first force, which has no prior. `surprises` whitens what a filter that includes the force
    leaves.
    """
    shaped = []
    joints = blocks[0].own.shape[1] - len(found.problem.own)
    for block, part in zip(blocks, found.errors, strict=True):
        columns = np.column_stack((block.residual, block.common, block.own))
        for column in columns.T:
            column[: part.size] = surprises(column[: part.size].reshape(part.shape)).ravel()
        width = block.common.shape[1]
        shaped.append(Block(columns[:, 0], columns[:, 1 : 1 + width], columns[:, 1 + width :]))
    left = [eliminate(block) for block in shaped]
    moved = _least(np.vstack([common for _, common in left]), np.concatenate([residual for residual, _ in left]))
    for block, part, shape in zip(blocks, found.errors, shaped, strict=True):
        begun = _least(shape.own, shape.residual + shape.common @ moved)
        whole = block.residual + block.common @ moved + block.own @ begun
        yield whole[: part.size].reshape(part.shape), begun[len(begun) - joints :]


def _least(matrix: Array, residual: Array) -> Array:
    """x with the least |residual + matrix x|."""
    return np.asarray(-np.linalg.lstsq(matrix, residual, rcond=None)[0], dtype=np.float64)
