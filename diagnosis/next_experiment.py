"""Which experiment would distinguish rival models, and how long it takes.

Each rival in turn is taken as the truth and simulated through the experiment in closed loop, without noise. Every other
rival is fitted to that record. What it still fails to predict, weighted by the innovations' covariance, is half a
squared norm E of innovations: the logarithm of the odds, in nats, that noise would leave on average to the truth. It
grows with time, and scatters by sqrt(2 E). The experiment with the largest E a second is chosen, for the pair of rivals
that it distinguishes worst; experiments under which any rival would come too near to a limit are refused.
Sources: Hunter and Reiner, "Designs for discriminating between two rival models", Technometrics 7 (1965) 307; Atkinson
and Fedorov, Biometrika 62 (1975) 57 (T-optimality).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from upright.diagnosis.prediction.closed_loop import Course, Experiment, simulate
from upright.diagnosis.rivals import NOTHING_MORE, Rival
from upright.estimators.fit.gauss_newton import Block, Minimum, minimise
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.problem import Problem, problem
from upright.models.segment import Segment

Array = NDArray[np.float64]
Progress = Callable[[str, float], None]

ENOUGH = 10.0
"""nats: odds of 1:100 are 4.6; with a mean of 10 and its scatter of 4.5, nine records of ten leave as much."""
SHORTEST, LONGEST = 15.0, 600.0
"""s in all, of experiments that a vehicle file describes in seconds: no diagnosis of a shipped vehicle accepts a
shorter record; rivals that need a longer one are not distinguished by this experiment."""
ITERATIONS = 15
IMITATED = 0.01
"""Ratio of the odds in the two directions below which one rival contains the other: what the richer rival cannot do
without is then what the other fails to predict, and if that is absent, having fewer parameters decides."""
WIDENING = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0)
"""Factors by which a wrong rival may enlarge its process noise."""


@dataclass(frozen=True, slots=True)
class Outlook:
    """What an experiment would show: nats a second by pair of rivals, or why it is `refused`."""

    experiment: Experiment
    rates: Mapping[tuple[str, str], float]
    refused: str = ""


@dataclass(frozen=True, slots=True)
class Suggestion:
    """`seconds` of `experiment`, in runs of its duration, distinguish `separates` at `rate` nats a second.

    `together`: pairs of rivals that no experiment distinguishes in a reasonable time.
    """

    experiment: Experiment
    seconds: float
    separates: tuple[str, ...]
    rate: float
    together: tuple[tuple[str, str], ...] = ()

    @property
    def runs(self) -> int:
        return ceil(self.seconds / self.experiment.duration - 1e-9)

    @property
    def text(self) -> str:
        """In one sentence, without its full stop."""
        several = f" ({self.runs} runs of {self.experiment.duration:g} s)" if self.runs > 1 else ""
        first, *others = self.separates
        record = f"{self.seconds:.0f} s of {self.experiment.name}{several}"
        text = f"{record} separates {first} from {' and '.join(others)}"
        if others == [NOTHING_MORE]:
            text = f"{record} would show {first} at an amplitude that is still too small to show here"
        return "; ".join((text, *(f"nothing here separates {one} from {other}" for one, other in self.together)))

    def to_json(self) -> dict[str, Any]:
        """`suggested_experiment` in `diagnose --json`."""
        return {
            "experiment": self.experiment.name,
            "parameters": dict(self.experiment.parameters),
            "seconds": self.seconds,
            "separates": list(self.separates),
            "expected_log_odds_per_second": self.rate,
            "text": self.text,
        }


@dataclass(frozen=True, slots=True)
class Choice:
    """The `best` experiment, None if no experiment distinguishes any pair in a reasonable time, and the `outlooks` of
    all."""

    best: Suggestion | None
    outlooks: tuple[Outlook, ...]


def suggest(rivals: Sequence[Rival], experiments: Sequence[Experiment], progress: Progress | None = None) -> Choice:
    """The experiment that distinguishes `rivals` soonest. `progress` is called with the current step and the share
    done."""
    report = progress or (lambda text, share: None)
    outlooks = []
    for number, experiment in enumerate(experiments):
        report(f"predicting experiment {experiment.name}", number / (len(experiments) + 1))
        outlooks.append(outlook(rivals, experiment))
    safe = [each for each in outlooks if not each.refused]
    pairs = list(combinations((rival.name for rival in rivals), 2))
    apart = [pair for pair in pairs if any(each.rates[pair] * LONGEST >= ENOUGH for each in safe)]
    if not apart:
        return Choice(None, tuple(outlooks))
    together = tuple(pair for pair in pairs if pair not in apart)
    chosen = max(safe, key=lambda each: min(each.rates[pair] for pair in apart))
    rate = min(chosen.rates[pair] for pair in apart)
    if rate * LONGEST < ENOUGH:
        # No single experiment distinguishes all pairs: then the pair that is distinguished soonest.
        apart = [max(apart, key=lambda pair: max(each.rates[pair] for each in safe))]
        chosen = max(safe, key=lambda each: each.rates[apart[0]])
        rate = chosen.rates[apart[0]]
    report(f"how much of {chosen.experiment.name} is needed", len(experiments) / (len(experiments) + 1))
    names = tuple(rival.name for rival in rivals if any(rival.name in pair for pair in apart))
    shorter = _shortened([rival for rival in rivals if rival.name in names], chosen.experiment, rate, apart)
    experiment, rate = shorter or (chosen.experiment, rate)
    seconds = max(ENOUGH / rate, experiment.duration)
    return Choice(Suggestion(experiment, seconds, names, rate, together), tuple(outlooks))


def outlook(rivals: Sequence[Rival], experiment: Experiment) -> Outlook:
    """What `experiment` would show about `rivals`."""
    courses: dict[str, Course] = {}
    for rival in rivals:
        courses[rival.name] = course = simulate(rival.model, experiment)
        if course.broken:
            return Outlook(experiment, {}, f"with {rival.name} in the vehicle, {course.broken}")
    rates = {}
    for one, other in combinations(rivals, 2):
        less, more = sorted(
            (
                expected_log_odds(one, courses[one.name].rows, other),
                expected_log_odds(other, courses[other.name].rows, one),
            )
        )
        rates[one.name, other.name] = (more if less < IMITATED * more else less) / experiment.duration
    return Outlook(experiment, rates)


def expected_log_odds(truth: Rival, rows: Segment, other: Rival) -> float:
    """nats by which `truth` is more likely than `other` on average, once `other` is fitted to `rows` that `truth`
    generated.

    A fit of `other` also takes for noise what it fails to predict: its process noise and its innovations become larger.
    So here it may choose by how much, and the least odds count.
    """
    task = problem(other.model, (), rows=[rows])
    noise, values = NoiseModel.of(task), task.kernel.vector()
    start, best, least = task.start, np.inf, 0.0
    nominal = truth.logarithms(noise)
    for factor in WIDENING:
        logarithms = nominal.copy()
        logarithms[sorted(set(noise.process_place))] += np.log(factor)
        gain = noise.gain(values, logarithms)
        if gain is None:
            break
        covariance = truth.covariance(noise, values, nominal, gain)
        if factor == 1.0:
            least = float(np.linalg.slogdet(covariance)[1])
        weights = np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
        minimum = _fit(task, start, weights, gain)
        if minimum is None:
            continue
        start = minimum.common
        white = minimum.blocks[0].residual[: rows.measured.size].reshape(len(rows), -1)
        widened = np.linalg.slogdet(np.eye(len(covariance)) + white.T @ white / len(white))[1]
        nats = 0.5 * len(white) * (float(np.linalg.slogdet(covariance)[1]) + float(widened) - least)
        if nats > best:
            break
        best = nats
    return best if np.isfinite(best) else 0.0


def _fit(task: Problem, start: Array, weights: Array, gain: Array) -> Minimum | None:
    # The priors are what is known without any record: the new one decides by itself.
    deviations = np.array([parameter.std for parameter in task.parameters])
    weight = np.where(deviations > 0.0, 1.0 / np.where(deviations > 0.0, deviations, 1.0), 0.0)

    def evaluate(common: Array, own: Sequence[Array]) -> list[Block] | None:
        blocks = task.evaluate(common, own[:-1], weights=weights, gain=gain)
        if blocks is None:
            return None
        return [*blocks, Block((common - task.start) * weight, np.diag(weight), np.zeros((len(weight), 0)))]

    lower, upper = task.bounds
    return minimise(
        evaluate,
        start,
        [*task.own_start, np.zeros(0)],
        scale=task.scale,
        lower=lower,
        upper=upper,
        iterations=ITERATIONS,
        tolerance=1e-3,
        enough=0.05,
    )


def _shortened(
    rivals: Sequence[Rival], experiment: Experiment, rate: float, apart: Sequence[tuple[str, str]]
) -> tuple[Experiment, float] | None:
    """The experiment in the time that is needed, and its rate, if less than the whole duration is enough."""
    for seconds in (ENOUGH / rate, 1.5 * ENOUGH / rate):
        seconds = float(ceil(max(seconds, SHORTEST)))
        shorter = experiment.shorter(seconds) if seconds < experiment.duration else None
        if shorter is None:
            return None
        predicted = outlook(rivals, shorter)
        if not predicted.refused:
            least = min(predicted.rates[pair] for pair in apart)
            if least * shorter.duration >= ENOUGH:
                return shorter, least
    return None
