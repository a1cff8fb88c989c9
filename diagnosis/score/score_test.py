"""The score test of every candidate effect at once: would a small amount of it reduce the innovations?

All candidates are attached to the model with amplitude zero. One pass of the compiled model gives the derivative of
each whitened innovation with respect to every amplitude, C, and to all that is fitted anyway, N: parameters, noise,
initial states, and what is held but not exactly known, each with its prior. With N projected out of C and of the
innovations z,

    score s = C'z,   information F = C'C,   amplitude F^-1 s,   statistic T = s' F^-1 s ~ chi squared

gives the estimate of each candidate in the linearised model, without a fit. Further passes at other shapes
(frequencies, widths) look for effects that one shape alone would miss. Scores of all candidates and shapes are drawn
together from their joint distribution under "nothing is missing", so `p_value` is corrected for having tried all of
them. Innovations that are not quite white make scores scatter more than F predicts; blocks of the record show by how
much (`inflation`), from the residual after the candidate itself is removed.
Sources: Rao's score test; Westfall and Young, "Resampling-based multiple testing" (1993), for the smallest p-value.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.prepare.candidates import Candidate, at_frequencies
from upright.diagnosis.score.change_points import at_instants
from upright.diagnosis.score.whitened import Whitened, peaks, project
from upright.diagnosis.side_by_side import side_by_side
from upright.diagnosis.trial import tried
from upright.estimators.fit.problem import Problem
from upright.estimators.tails import chi2_sf, normal_isf
from upright.models.effect import Role

Array = NDArray[np.float64]
_Pass = tuple[Problem, int, list[Candidate]]

DETECTABLE = float(normal_isf(0.01) + normal_isf(0.01))
"""Standard errors of an amplitude that is found with 99 % probability at 1 % false alarms."""
DRAWS = 4000
LEAST = 1e-12
"""Share of a candidate's own information that has to remain after the rest is projected out."""


@dataclass(frozen=True, slots=True)
class Score:
    """Result of the score test for one candidate, at the best of its shapes.

    `sizes` and `standard_errors` by amplitude; `shape` by parameter. `gain`: rise of the log-likelihood in the
    linearised model. `detectable`: the minimum detectable first amplitude in this record at the effect's usual shape,
    beyond others that do a part of it. `starts`: amplitudes and shape of all variants, the best first.
    """

    candidate: Candidate
    statistic: float
    p_single: float
    p_value: float
    sizes: Mapping[str, float]
    standard_errors: Mapping[str, float]
    shape: Mapping[str, float]
    inflation: float
    detectable: float
    starts: tuple[Mapping[str, float], ...]

    @property
    def gain(self) -> float:
        return 0.5 * self.statistic


@dataclass(frozen=True, slots=True)
class Pair:
    """Two candidates at once, each of which may hide the other. `p_value` corrected for all pairs, an upper bound;
    `starts`: amplitudes and shape of each."""

    candidates: tuple[Candidate, Candidate]
    p_value: float
    starts: tuple[Mapping[str, float], Mapping[str, float]]


@dataclass(frozen=True, slots=True)
class ScoreTest:
    """`scores` in order, the most significant first; `bases` of what each does to the innovations, orthonormal, by
    name; `pairs` whose amplitudes are physically possible, the most significant first."""

    scores: tuple[Score, ...]
    bases: Mapping[str, Array]
    pairs: tuple[Pair, ...] = ()

    def score(self, name: str) -> Score:
        return next(score for score in self.scores if score.candidate.name == name)

    def similarity(self, one: str, other: str) -> float:
        """Largest canonical correlation between what the two do to the innovations, 0 to 1."""
        singular = np.linalg.svd(self.bases[one].T @ self.bases[other], compute_uv=False)
        return float(np.clip(singular[0], 0.0, 1.0))


def score_test(
    innovations: Whitened,
    attach: Callable[[Sequence[Candidate]], Problem],
    candidates: Sequence[Candidate],
    failed: MutableMapping[str, str] | None = None,
) -> ScoreTest:
    """The score test of `candidates`. `attach` makes the problem of the model with some of them, on the same samples.

    A candidate with which the model diverges at every step size is left out, and so is one that cannot be scored:
    `failed` gives the reason. The candidates of a pass that fails are tried one by one.
    """
    failed = {} if failed is None else failed
    passes: list[_Pass] = []
    groups = [list(each) for each in _groups(at_frequencies(candidates, *peaks(innovations)))]
    while groups:
        group = groups.pop(0)
        name = group[0].name if len(group) == 1 else ""
        made = tried(partial(_passes, group, innovations, attach), name, failed if name else None)
        if made is not None:
            passes += made
        elif not name:
            groups += [[each] for each in group]

    def columns_of(one: _Pass) -> Array | None:
        full, number, looked_at = one
        shape = {name: value for each in looked_at for name, value in each.variants[number].items()}
        amplitudes = [name for each in looked_at for name in each.amplitudes]
        with np.errstate(all="ignore"):
            return tried(partial(innovations.directions, full, amplitudes, shape))

    parts: list[tuple[Candidate, int, Array]] = []
    for (_, number, looked_at), columns in zip(passes, side_by_side(columns_of, passes), strict=True):
        if columns is None:
            continue
        place = 0
        for each in looked_at:
            found = columns[:, place : place + len(each.amplitudes)]
            place += len(each.amplitudes)
            if np.all(np.isfinite(found)):
                parts.append((each, number, found))
    scored = {each.name for each, _, _ in parts}
    unscored = [each.name for each in candidates if each.name not in {*scored, *failed}]
    failed.update(dict.fromkeys(unscored, "its derivatives are not finite"))
    if not parts:
        return ScoreTest((), {})
    columns = np.column_stack([part for _, _, part in parts])
    return _rank(parts, innovations, project(columns, innovations.nuisance))


def _passes(
    group: Sequence[Candidate], innovations: Whitened, attach: Callable[[Sequence[Candidate]], Problem]
) -> list[_Pass]:
    """The passes of `group`, one for each variant number, with all its candidates side by side. Raises ArithmeticError
    if the model with all of them, at amplitude zero, diverges: then one of them has no value there."""
    full = attach(group)
    if len(group) > 1:
        with np.errstate(all="ignore"):
            first = innovations.directions(full, group[0].amplitudes[:1], {})
        if not np.all(np.isfinite(first)):
            raise ArithmeticError("the model diverges with one of these")
    group = [at_instants(each, innovations, full) for each in group]
    most = max(len(candidate.variants) for candidate in group)
    return [(full, number, [each for each in group if number < len(each.variants)]) for number in range(most)]


def _groups(candidates: Sequence[Candidate]) -> Iterator[list[Candidate]]:
    """Candidates that go through one pass: all without memory together; those with states of their own may need finer
    steps."""
    plain = [candidate for candidate in candidates if not candidate.attached.states]
    if plain:
        yield plain
    yield from ([candidate] for candidate in candidates if candidate.attached.states)


@dataclass(frozen=True, slots=True)
class _Entry:
    """One candidate at one shape; `where` its columns are; `square` their information; `drawn` (d,) statistics by
    chance."""

    candidate: Candidate
    number: int
    where: NDArray[np.int64]
    sizes: Array
    square: Array
    inflation: float
    statistic: float
    drawn: Array

    @property
    def picked(self) -> bool:
        return self.number >= len(self.candidate.variants) - self.candidate.picked

    @property
    def shape(self) -> Mapping[str, float]:
        return self.candidate.variants[self.number]

    @property
    def start(self) -> dict[str, float]:
        amplitudes = dict(zip(self.candidate.amplitudes, self.sizes.tolist(), strict=True))
        return {**amplitudes, **self.shape}


def _rank(parts: Sequence[tuple[Candidate, int, Array]], innovations: Whitened, columns: Array) -> ScoreTest:
    residual, blocks = innovations.residual, innovations.blocks
    # Priors scatter as stated: only the scatter of the innovations has to be estimated.
    known = columns.copy()
    known[: len(columns) - innovations.priors] = 0.0
    original = np.concatenate([np.sum(part**2, axis=0) for _, _, part in parts])
    information = columns.T @ columns
    left = np.diag(information) > LEAST * np.maximum(original, 1e-300)
    score = columns.T @ residual
    order = np.argsort(blocks, kind="stable")
    edges = np.flatnonzero(np.diff(blocks[order], prepend=-1))
    normal = _draws(information, left)
    by_name: dict[str, list[_Entry]] = {}
    place = 0
    for candidate, number, part in parts:
        where = np.arange(place, place + part.shape[1])
        place += part.shape[1]
        if not left[where].all():
            continue
        inside, square = columns[:, where], information[np.ix_(where, where)]
        sizes = _signed_sizes(candidate, square, score[where])
        rest = (inside - known[:, where]) * (residual - inside @ sizes)[:, None]
        sums = np.add.reduceat(rest[order], edges, axis=0)
        scatter = sums.T @ sums + known[:, where].T @ known[:, where]
        inflation = max(1.0, float(np.trace(_inverse(square) @ scatter)) / len(where))
        statistic = float(sizes @ square @ sizes) / inflation
        drawn = _statistics(candidate, square, normal[:, where])
        entry = _Entry(candidate, number, where, sizes, square, inflation, statistic, drawn)
        by_name.setdefault(candidate.name, []).append(entry)
    return _score_test(by_name, columns, information, score)


def _draws(information: Array, left: NDArray[np.bool_]) -> Array:
    """Scores as they would be if nothing were missing, (DRAWS, m)."""
    size = np.sqrt(np.where(left, np.diag(information), 1.0))
    values, vectors = np.linalg.eigh(np.where(np.outer(left, left), information, 0.0) / np.outer(size, size))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return np.asarray(np.random.default_rng(1).standard_normal((DRAWS, len(size))) @ root.T * size)


def _signed_sizes(candidate: Candidate, square: Array, score: Array) -> Array:
    """The amplitudes (k,) that explain most of `score` (k,), none of a sign that is physically impossible."""
    return np.asarray(_best_allowed(candidate, square, score[None])[0][0])


def _statistics(candidate: Candidate, square: Array, scores: Array) -> Array:
    """The statistic of many scores (d, k) at once, (d,)."""
    return _best_allowed(candidate, square, scores)[1]


def _best_allowed(candidate: Candidate, square: Array, scores: Array) -> tuple[Array, Array]:
    """Amplitudes (d, k) and statistics (d,): the best over all subsets of amplitudes, the others being zero."""
    lower, upper = _bounds(candidate)
    count, width = scores.shape
    best, most = np.zeros((count, width)), np.zeros(count)
    for chosen in range(1, 2**width):
        where = np.flatnonzero([chosen >> place & 1 for place in range(width)])
        sizes = scores[:, where] @ _inverse(square[np.ix_(where, where)])
        statistic = np.sum(sizes * scores[:, where], axis=1)
        allowed = np.all((sizes >= lower[where]) & (sizes <= upper[where]), axis=1) & (statistic > most)
        most[allowed] = statistic[allowed]
        best[allowed] = 0.0
        best[np.ix_(allowed, where)] = sizes[allowed]
    return best, most


def _bounds(candidate: Candidate) -> tuple[Array, Array]:
    parameters = [p for p in candidate.attached.parameters if p.name in candidate.amplitudes]
    return np.array([p.lower for p in parameters]), np.array([p.upper for p in parameters])


def _detectable(entries: Sequence[_Entry], by_name: Mapping[str, Sequence[_Entry]], information: Array) -> float:
    """The minimum detectable first amplitude at the usual shape, and of an effect that sets in, at the best change
    point.

    A step that shows no more than a constant torque does not count. Beyond others: the one that does most of it counts,
    by what the first amplitude does alone, since all others together may do all that this effect does.
    """
    candidate = entries[0].candidate
    instants = candidate.attached.of_role(Role.INSTANT)
    usual = [each for each in entries if _but(instants, each.shape) == _but(instants, entries[0].shape)]
    beyond = [f"{other}{candidate.name.removeprefix(candidate.effect.name)}" for other in candidate.effect.beyond]
    others = [entry.where for name in beyond for entry in by_name.get(name, ())]
    variances = []
    for each in usual:
        own = each.where[:1] if beyond else each.where
        together = [np.concatenate((own, other)) for other in others] or [own]
        variance = max(_variances(information[np.ix_(where, where)])[0] for where in together)
        variances.append(each.inflation * variance)
    return DETECTABLE * float(np.sqrt(min(variances)))


def _but(names: Collection[str], shape: Mapping[str, float]) -> dict[str, float]:
    return {other: value for other, value in shape.items() if other not in names}


def _score_test(by_name: Mapping[str, Sequence[_Entry]], columns: Array, information: Array, score: Array) -> ScoreTest:
    best = {name: max(entries, key=lambda each: each.statistic) for name, entries in by_name.items()}
    # Each candidate's own distribution first (the best of its shapes), then that of the smallest p-value of all.
    largest = {name: np.max([each.drawn for each in entries], axis=0) for name, entries in by_name.items()}
    single = {name: _p_single(entries, largest[name]) for name, entries in by_name.items()}
    smallest = np.sort(np.min([_tails(each) for each in largest.values()], axis=0)) if by_name else np.ones(1)
    scores = []
    for name, entry in best.items():
        errors = np.sqrt(entry.inflation * _variances(entry.square))
        among = float(np.searchsorted(smallest, single[name], side="right") + 1.0) / (len(smallest) + 1.0)
        # Beyond the resolution of the draws: the bound of Bonferroni.
        p_value = among if single[name] > 2.0 / DRAWS else min(among, len(by_name) * single[name])
        scores.append(
            Score(
                candidate=entry.candidate,
                statistic=entry.statistic,
                p_single=single[name],
                p_value=p_value,
                sizes=dict(zip(entry.candidate.amplitudes, entry.sizes.tolist(), strict=True)),
                standard_errors=dict(zip(entry.candidate.amplitudes, errors.tolist(), strict=True)),
                shape=entry.shape,
                inflation=entry.inflation,
                detectable=_detectable(by_name[name], by_name, information),
                starts=tuple(each.start for each in sorted(by_name[name], key=lambda each: -each.statistic)),
            )
        )
    scores.sort(key=lambda score: (score.p_value, -score.statistic))
    bases = {name: np.linalg.qr(columns[:, entry.where])[0] for name, entry in best.items()}
    return ScoreTest(tuple(scores), bases, _pairs(best, by_name, information, score))


def _pairs(
    best: Mapping[str, _Entry], by_name: Mapping[str, Sequence[_Entry]], information: Array, score: Array
) -> tuple[Pair, ...]:
    """What two candidates, each at the best of its shapes, explain together; only those that may be significant, by
    Bonferroni."""
    found = []
    tries = {name: _tries(entry, by_name) for name, entry in best.items()}
    together = list(combinations(best.values(), 2))
    for widths in {tuple(len(each.where) for each in pair) for pair in together}:
        alike = [pair for pair in together if tuple(len(each.where) for each in pair) == widths]
        where = np.array([np.concatenate((one.where, other.where)) for one, other in alike])
        sizes = (_inverse(information[where[:, :, None], where[:, None, :]]) @ score[where][:, :, None])[:, :, 0]
        inflation = [max(one.inflation, other.inflation) for one, other in alike]
        number = [len(together) * tries[one.candidate.name] * tries[other.candidate.name] for one, other in alike]
        p_values = number * chi2_sf(np.sum(sizes * score[where], axis=1) / inflation, sum(widths))
        for place in np.flatnonzero(p_values < 1.0):
            pair, parts = alike[place], (sizes[place, : widths[0]], sizes[place, widths[0] :])
            if all(_allowed(each.candidate, part) for each, part in zip(pair, parts, strict=True)):
                first, second = (replace(each, sizes=part) for each, part in zip(pair, parts, strict=True))
                candidates, starts = (first.candidate, second.candidate), (first.start, second.start)
                found.append(Pair(candidates, float(p_values[place]), starts))
    return tuple(sorted(found, key=lambda each: each.p_value))


def _tries(entry: _Entry, by_name: Mapping[str, Sequence[_Entry]]) -> int:
    """Number of shapes among which this one was chosen."""
    return len(by_name[entry.candidate.name]) * (entry.candidate.among if entry.picked else 1)


def _allowed(candidate: Candidate, sizes: Array) -> bool:
    lower, upper = _bounds(candidate)
    return bool(np.all((sizes >= lower) & (sizes <= upper)))


def _inverse(square: Array) -> Array:
    """Inverse of each information (..., k, k); directions without information are left at zero."""
    scale = np.sqrt(np.diagonal(square, axis1=-2, axis2=-1))
    unit = scale[..., :, None] * scale[..., None, :]
    return np.asarray(np.linalg.pinv(square / unit, rcond=1e-9, hermitian=True) / unit)


def _variances(square: Array) -> Array:
    """Variances (k,) of amplitudes whose information is `square` (k, k); large if it is nearly singular."""
    scale = np.sqrt(np.diag(square))
    values, vectors = np.linalg.eigh(square / np.outer(scale, scale))
    return np.asarray(np.sum(vectors**2 / np.maximum(values, 1e-9), axis=1) / scale**2)


def _p_single(entries: Sequence[_Entry], largest: Array) -> float:
    """The p-value of one candidate, corrected for all its shapes, including those picked from the data."""
    found = []
    for picked in (False, True):
        of_kind = [each for each in entries if each.picked is picked]
        if of_kind:
            best = max(of_kind, key=lambda each: each.statistic)
            # A picked shape is corrected for the number it was picked from; the distribution of the others contains
            # their tries.
            tail = (
                chi2_sf(best.statistic, len(best.where)) if picked else _tail(largest, best.statistic, len(best.where))
            )
            found.append(min(1.0, (best.candidate.among if picked else 1) * float(tail)))
    return min(1.0, min(found) * len(found))


def _tail(drawn: Array, statistic: float, degrees: int) -> float:
    """The share of `drawn` above `statistic`; beyond them chi squared, with the number of tries that the draws
    indicate."""
    above = int(np.count_nonzero(drawn >= statistic))
    if above >= 10:
        return above / len(drawn)
    far = np.sort(drawn)[-10]
    tries = (10.0 / len(drawn)) / max(float(chi2_sf(far, degrees)), 1e-300)
    return float(min(1.0, tries * chi2_sf(statistic, degrees)))


def _tails(drawn: Array) -> Array:
    """The p-value of each of `drawn` among themselves, (d,)."""
    order = np.sort(drawn)
    return np.asarray((len(drawn) - np.searchsorted(order, drawn, side="left")) / len(drawn))
