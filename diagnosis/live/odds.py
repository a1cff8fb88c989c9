"""How likely is each effect, for any onset? The odds of effects against none, from the products of seconds.

The log-likelihood ratio of each effect at each second at which it may have set in, with its amplitudes in the second
before left free (`diagnosis.live.onset`), is relative to the same nuisances alone. So effects can be compared although
the most likely onset of each is a different second. All onsets have the same prior, so their likelihoods are averaged:

    odds = tries^-1 mean over onsets of exp(gain / 2 - chance) n^(-(k - 1) / 2)

for k amplitudes and n numbers since the onset, where gain is twice the rise of the log-likelihood; the last factor is
the price of further parameters by the Bayes information criterion. Odds of one effect against none exceed x with a
probability of about 1 / x if nothing is missing.

Sources: Kass and Raftery, "Bayes factors", Journal of the American Statistical Association 90 (1995) 773-795;
Ville's inequality for a likelihood ratio that is evaluated again and again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.evidence import STRONG
from upright.diagnosis.live.onset import BEGINNING, LEAST, Amplitudes, Fitted, Onset, examine, with_known
from upright.diagnosis.live.products import Products

Array = NDArray[np.float64]

SHORTEST = 3
"""Parts before an onset that are needed to know the usual energy."""
YOUNGEST = 1
"""Latest onset that is considered, s ago."""
TIED = 0.9
"""Share of the best logarithm of odds from which on an effect is tied with it: their directions correlate by 0.95."""


@dataclass(frozen=True, slots=True)
class Weighed:
    """An effect at its most likely `onset`, with the natural logarithm of its odds against none, for any onset.

    `explained` is the share that it explains of the energy since the onset in excess of the usual energy before, in the
    seconds in which the effect acts; 1 if the excess may be noise. `tied`: it may as well be the most likely one.
    """

    onset: Onset
    log_odds: float
    explained: float
    tied: bool = True


def weigh(
    products: Products, effects: Sequence[Amplitudes], known: Sequence[Onset], tries: Mapping[str, int], least: float
) -> tuple[list[Weighed], dict[str, float]]:
    """The effects beside the `known` that are tied with the most likely of them, which comes first, and perhaps more;
    none if no logarithm of odds reaches `least`.

    `tries`: number of shapes among which that of an effect was picked. The second result is the standard error of the
    first amplitude of every effect that is distinguishable from the nuisances.
    """
    blocks, starts = products.latest()
    nuisances = len(products.prior)
    further = sum(len(each.effect.columns) * (1 + (each.second != BEGINNING)) for each in known)
    prior = np.concatenate((products.prior, np.zeros(further)))
    expected = prior * np.concatenate((products.mean, np.zeros(further)))
    blocks = with_known(blocks, starts, nuisances, known)
    fitted = Fitted.of(blocks, prior, expected)
    taken = {each.effect.name for each in known}
    left = [effect for effect in effects if effect.name not in taken]
    late = 1 + np.flatnonzero((np.diff(starts) == 1) & (starts[1:] <= products.seconds - YOUNGEST))
    windows = np.concatenate(([0], late))
    gains = _gains(left, fitted, nuisances, windows)
    counts = np.array([len(effect.columns) for effect in left])
    energies = blocks[:, -1, -1] / np.diff(np.append(starts, products.seconds))
    # An output that is known better than any model is has next to no energy, and does not count.
    numbers = float(np.median(energies)) * (products.seconds - starts[windows])
    # Free amplitudes in the second before raise twice the log-likelihood by their number, by chance alone.
    price = np.where(windows == 0, 0.0, 0.5)[:, None] * counts + 0.5 * np.log(numbers)[:, None] * (counts - 1)
    price += np.log(len(windows)) + np.log([float(tries.get(effect.name, 1)) for effect in left])
    odds = np.logaddexp.reduce(0.5 * gains - price, axis=0)
    stds = fitted.errors(np.array([effect.columns[0] - nuisances for effect in left], dtype=np.int64)).tolist()
    errors = {effect.name: error for effect, error in zip(left, stds, strict=True) if math.isfinite(error)}
    found: list[Weighed] = []
    if odds.max(initial=-math.inf) < least:
        return found, errors
    best, places = -math.inf, list[int]()
    for place in np.argsort(-odds).tolist():
        if odds[place] < tied_from(best):
            break
        effect = left[place]
        likeliest = int(np.argmax(0.5 * gains[:, place] - price[:, place]))
        window = int(windows[likeliest])
        where = [len(prior) + column - nuisances for column in effect.columns]
        second = BEGINNING if window == 0 else int(starts[window])
        onset = examine(effect, blocks, prior, expected, where, window, second)
        if onset is None:
            continue
        likely = _averaged(gains[:, place] / onset.inflation, price[:, place])
        # Known effects have already taken their share of the energies.
        acts = blocks[:, where[0], where[0]] > 0.0
        share = 1.0 if known else _explained(float(gains[likeliest, place]), energies, window, acts)
        found.append(Weighed(onset, likely, share))
        places.append(place)
        best = max(best, likely)
    # Two nearly identical effects scatter identically: only the likelihood distinguishes them.
    scatter = min((each.onset.inflation for each in found if each.log_odds == best), default=1.0)
    for number, (each, place) in enumerate(zip(found, places, strict=True)):
        beside = _averaged(gains[:, place] / min(scatter, each.onset.inflation), price[:, place])
        found[number] = replace(each, tied=beside > tied_from(best))
    return sorted(found, key=lambda each: -each.log_odds), errors


def _averaged(gains: Array, price: Array) -> float:
    """The logarithm of the mean over onsets; their number is contained in the `price` (w,)."""
    return float(np.logaddexp.reduce(0.5 * gains - price))


def tied_from(highest: float) -> float:
    """The logarithm of odds from which on an effect is tied with one that has the `highest`."""
    return min(highest - STRONG, TIED * highest)


def _explained(gain: float, energies: Array, window: int, acts: NDArray[np.bool_]) -> float:
    """`gain` as a share of the energy since `window`, where the effect `acts` (b,), in excess of the usual energy
    before and three standard deviations of noise. `energies` (b,) are per second."""
    if window < SHORTEST:
        return 1.0
    usual, seconds = float(np.median(energies[:window])), int(np.count_nonzero(acts[window:]))
    noise = 3.0 * math.sqrt(2.0 * usual * seconds)
    more = float(np.sum(energies[window:][acts[window:]])) - usual * seconds - noise
    return min(1.0, gain / more) if more > 0.0 else 1.0


def _gains(effects: Sequence[Amplitudes], fitted: Fitted, nuisances: int, windows: NDArray[np.int64]) -> Array:
    """Twice the rise of the log-likelihood by each effect at each window, (w, e), including the part before it.

    Amplitudes outside their bounds give no rise; of several, of which not all are inside, only the best one counts."""
    columns = np.array([place - nuisances for effect in effects for place in effect.columns])
    lower = np.array([bound for effect in effects for bound in effect.lower])
    upper = np.array([bound for effect in effects for bound in effect.upper])
    counts = np.array([len(effect.columns) for effect in effects])
    firsts = np.cumsum(counts) - counts
    found = np.maximum.reduceat(_alone(columns, lower, upper, fitted, windows), firsts, axis=1)
    for count in sorted(set(counts.tolist()) - {1}):
        these = np.flatnonzero(counts == count)
        own = firsts[these][:, None] + np.arange(count)
        together, inside = _together(columns[own], lower[own], upper[own], fitted, windows)
        found[:, these] = np.where(inside, together, found[:, these])
    found[1:, [not effect.anytime for effect in effects]] = 0.0
    return found


def _alone(where: NDArray[np.int64], lower: Array, upper: Array, fitted: Fitted, windows: NDArray[np.int64]) -> Array:
    """`_gains` of single columns (c,), all at once, (w, c).

    One amplitude holds from the part before a window on, and a change of it from the window on."""
    own = np.diagonal(fitted.own, axis1=1, axis2=2)[:, where]
    information, score = fitted.information[:, where], fitted.score[:, where]
    identifiable = information > LEAST * np.maximum(own, 1e-300)
    gains = np.zeros((len(windows), len(where)))
    size = score[0] / np.where(identifiable[0], information[0], 1.0)
    gains[0] = np.where(identifiable[0] & (size >= lower) & (size <= upper), size * score[0], 0.0)
    after, part = windows[1:], windows[1:] - 1
    both = own[after] - np.einsum("bpm,bpm->bm", fitted.cross[part][:, :, where], fitted.turned[after][:, :, where])
    determinant = information[part] * information[after] - both * both
    clear = identifiable[part] & identifiable[after] & (determinant > LEAST * information[part] * information[after])
    safe = np.where(clear, determinant, 1.0)
    early = (information[after] * score[part] - both * score[after]) / safe
    change = (information[part] * score[after] - both * score[part]) / safe
    size = early + change
    inside = clear & (size >= lower) & (size <= upper)
    gains[1:] = np.where(inside, early * score[part] + change * score[after], 0.0)
    return gains


def _together(
    where: NDArray[np.int64], lower: Array, upper: Array, fitted: Fitted, windows: NDArray[np.int64]
) -> tuple[Array, NDArray[np.bool_]]:
    """`_gains` of the columns (e, k) of effects together, (w, e), and whether their amplitudes are within bounds."""
    count, size = where.shape
    cross, turned, score = fitted.cross[:, :, where], fitted.turned[:, :, where], fitted.score[:, where]
    own = fitted.own[:, where[:, :, None], where[:, None, :]]

    def left(one: NDArray[np.int64], other: NDArray[np.int64]) -> Array:
        return np.asarray(own[other] - np.einsum("wpek,wpel->wekl", cross[one], turned[other]))

    after, part = windows[1:], windows[1:] - 1
    square = np.empty((len(after), count, 2 * size, 2 * size))
    square[..., :size, :size], square[..., size:, size:] = left(part, part), left(after, after)
    square[..., :size, size:] = both = left(part, after)
    square[..., size:, :size] = np.swapaxes(both, -1, -2)
    first, begins = _solved(left(windows[:1], windows[:1]), score[:1])
    later, changes = _solved(square, np.concatenate((score[part], score[after]), axis=-1))
    sizes = np.concatenate((begins, changes[..., :size] + changes[..., size:]))
    return np.concatenate((first, later)), np.all((sizes >= lower) & (sizes <= upper), axis=-1)


def _solved(information: Array, score: Array) -> tuple[Array, Array]:
    """Twice the rise of the log-likelihood by amplitudes (..., k) without bounds, (...), and these amplitudes."""
    scale = np.sqrt(np.maximum(np.diagonal(information, axis1=-2, axis2=-1), 1e-300))
    unit = information / (scale[..., :, None] * scale[..., None, :]) + 1e-9 * np.eye(scale.shape[-1])
    scaled = score / scale
    solved = np.linalg.solve(unit, scaled[..., None])[..., 0]
    return np.sum(solved * scaled, axis=-1), solved / scale
