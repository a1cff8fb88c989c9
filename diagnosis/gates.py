"""What decides about effects that were fitted, one more each in the same model: their numbers alone, through gates.

Each of GATES has one threshold and refuses with one reason. What passes all of them is asked once more as a whole,
because what chance may have made is the likeliest of all that were looked at (LEVEL); then comes the simplest of the
likeliest, as long as data that its fit has not seen do not refuse it; then what the record does not tell from it.

No fit is asked anything here, so that a table of these numbers can be decided about again (benchmarks/decisions.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from diagnosis.evidence import LEVEL, SIGNIFICANT, by_chance, likelier
from models.effect import Effect

DOUBT = 0.05
"""p-value of the likelihood ratio below which an effect of more parameters is tied with a simpler one that is named."""
CHECKED = 3
"""Effects, the likeliest first, that are tried on held-out data before none is named."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """What held-out data say of one effect more.

    `gain`: rise of the log likelihood, nats; `std`: standard deviation of the part of it that the fit did not predict;
    `known`: rise of the log prior of the parameters, nats. `closed_percent`: share of the excess error energy (over
    that of the sensors' noise, one horizon ahead) that the effect removes, with its standard deviation `closed_std`;
    None where there is no excess. `closing_percent`: what it would remove if it were right, and add if there were none
    of it. `struck`: parts of the model collide.
    """

    gain: float
    std: float
    closed_percent: float | None
    closed_std: float | None = None
    closing_percent: float | None = None
    known: float = 0.0
    impacts: bool = False

    @property
    def stands(self) -> bool:
        """Whether the log likelihood rises by more than its standard deviation, and no error clearly grows.

        The error ahead does not count where the effect changes it by less than it scatters, because other errors of the
        model, which add up on the way, would decide. Nor does it count where parts collide: how well the motion after
        an impact is predicted depends on the filter that the impacts of one record have made.
        """
        return (self.impacts or not self._grows) and self.gain + self.known >= self.std

    @property
    def _grows(self) -> bool:
        if self.closed_percent is None or self.closed_std is None or self.closing_percent is None:
            return False
        return self.closing_percent > self.closed_std and self.closed_percent <= -SIGNIFICANT * self.closed_std


@dataclass(frozen=True, slots=True)
class Tried:
    """One effect more in a model, in the numbers that decide about it.

    `log_likelihood` above that of the model without it (nats), with `parameters` more, fitted to `rows` samples;
    `usual`: these two by its usual formula, where a finer one is likelier. `converged`: its fit did; `inside_bounds`:
    no amplitude ends at a bound; `t_ratio`: the largest of its amplitudes'. `p_value` of it or of what is easily
    confused with it, with all effects looked at. `among`: instants of which its own was picked. `held_out`: what data
    say that its fit has not seen, None where they say nothing. `in_usual_shape`: the log likelihood with its shape held
    at the usual one, None where nobody asked. `refused`: why it is not named; empty where it passed all that it was
    asked.
    """

    name: str
    effect: Effect
    log_likelihood: float
    parameters: int
    rows: int
    converged: bool
    inside_bounds: bool
    t_ratio: float
    usual: tuple[float, int] | None = None
    p_value: float = 1.0
    among: int = 1
    held_out: HeldOut | None = None
    in_usual_shape: float | None = None
    refused: str = ""

    @property
    def cost(self) -> float:
        """What its parameters have to gain (Schwarz), nats."""
        return 0.5 * self.parameters * math.log(self.rows)

    @property
    def evidence(self) -> float:
        """Logarithm of the posterior odds for it, against the model without."""
        return self.log_likelihood - self.cost


Gate = Callable[[Tried, int], str]
"""An effect, as one of so many that were tried, to the reason for which it is refused, empty where it passes."""


def converges(tried: Tried, tries: int) -> str:
    """Where a fit does not converge, nothing is known of its likelihood."""
    return "" if tried.converged else "its fit does not converge"


def is_inside_its_bounds(tried: Tried, tries: int) -> str:
    """What physics stops short of what the record asks for stands in for another cause."""
    return "" if tried.inside_bounds else "its amplitude ends at a bound"


def is_significant(tried: Tried, tries: int) -> str:
    """An amplitude that may as well be zero leaves all that was gained to the other parameters."""
    if tried.t_ratio > SIGNIFICANT:
        return ""
    return f"its t-ratio is {tried.t_ratio:.2g}, and more than {SIGNIFICANT:g} is needed"


def is_beyond_chance(tried: Tried, tries: int) -> str:
    """Chance alone makes the best of many gain something."""
    gain, parameters = tried.usual or (tried.log_likelihood, tried.parameters)
    chance = tries * by_chance(gain, parameters)
    return "" if chance < LEVEL else f"chance explains as much in {100.0 * min(1.0, chance):.2g} % of records"


GATES: tuple[Gate, ...] = (converges, is_inside_its_bounds, is_significant, is_beyond_chance)


def gated(tried: Tried, tries: int) -> Tried:
    """`tried` with the reason of the first gate that refuses it."""
    return replace(tried, refused=next(filter(None, (gate(tried, tries) for gate in GATES)), ""))


@dataclass(frozen=True, slots=True)
class Round:
    """One effect more was looked for `beside` the effects of a model, as one of so many `tries`: all that were fitted,
    which is `named`, empty for none, and what it is `tied_with`."""

    beside: tuple[str, ...]
    tries: int
    tried: tuple[Tried, ...]
    p_value: float
    named: str = ""
    tied_with: tuple[str, ...] = ()

    @property
    def finding(self) -> Tried | None:
        """The one that is named."""
        return next((each for each in self.tried if each.name == self.named), None)

    @property
    def passed(self) -> list[Tried]:
        """Those that no gate refused, nor held-out data, the one with most evidence first."""
        return sorted((each for each in self.tried if not each.refused), key=lambda each: -each.evidence)


def decide(
    asked: Round,
    on_held_out: Callable[[Tried], Tried],
    in_usual_shape: Callable[[Tried], float | None],
) -> Round:
    """`asked`, whose effects went through GATES, with the one that is named and its ties.

    `on_held_out` gives an effect with what held-out data say of it, or with why it is refused; `in_usual_shape` the log
    likelihood of one whose shape is held.
    """
    if asked.p_value >= LEVEL:
        return asked
    known, doubted = {each.name: each for each in asked.tried}, False
    for _ in range(CHECKED):
        now = replace(asked, tried=tuple(known.values()))
        if not now.passed:
            break
        best = on_held_out(simplest(now.passed))
        # What explains the same as a refused effect is not named without a check of its own.
        stands = best.held_out.stands if best.held_out is not None else not doubted
        if not best.refused and not stands:
            why = "does not hold on held-out data" if best.held_out else "cannot be tried on held-out data"
            best = replace(best, refused=why)
        known[best.name] = best
        if not best.refused:
            now = replace(asked, tried=tuple(known.values()), named=best.name)
            return tie(now, in_usual_shape)
        doubted = True
    return replace(asked, tried=tuple(known.values()))


def simplest(passed: Sequence[Tried]) -> Tried:
    """The first of `passed`, or one with fewer parameters that explains almost as much.

    Between formulas that are exact, the one with more parameters where the record asks for them.
    """
    best = passed[0]
    asked = [
        each
        for each in passed
        if each.parameters > best.parameters and exact(each, best) and needless(each, best) < LEVEL
    ]
    if asked:
        return asked[0]
    simple = [each for each in passed if each.cost < best.cost and as_much(each, best)]
    return min(simple, key=lambda each: (each.cost, -each.log_likelihood)) if simple else best


def tie(named: Round, in_usual_shape: Callable[[Tried], float | None]) -> Round:
    """`named` with which of those that passed may as well be it: by the odds or, where they are easily confused with
    it, by the likelihood.

    The odds contain the price of parameters, which tells no neighbours apart. A simpler one is tied where it gains
    almost as much, one with more parameters where the record asks for them, or would not tell it in its usual shape.
    """
    best, passed = named.finding, named.passed
    assert best is not None
    known = {each.name: each for each in named.tried}
    likeliest = max(each.evidence for each in passed)
    found: list[Tried] = []
    for each in sorted(passed, key=lambda each: each.cost):
        if each is best:
            continue
        gain, other = best.log_likelihood, each.log_likelihood
        likely = not likelier(likeliest - each.evidence)
        if exact(best, each) and each.parameters < best.parameters:
            likely = as_much(each, best)
        elif confusable(best.effect, each.effect):
            if each.cost < best.cost:
                likely = likely or as_much(each, best)
            elif each.cost > best.cost:
                # One that can be like the one that is named is an alternative only in what it does otherwise.
                asked = by_chance(other - gain, each.parameters - best.parameters) < DOUBT
                likely = asked and (likely or not as_much(best, each))
                if not likely and not likelier(gain - other):
                    # Where it is as likely in its usual shape, the record says nothing of its shape.
                    held = in_usual_shape(each)
                    known[each.name] = replace(each, in_usual_shape=held)
                    likely = held is not None and not likelier(gain - held)
            # Of one that contains a tied one only what it gains beyond that would count.
            likely = likely and not any(one.cost < each.cost and as_much(one, each) for one in found)
        if likely:
            found.append(each)
    names = {each.name for each in found}
    return replace(
        named,
        tried=tuple(known.values()),
        tied_with=tuple(each.name for each in passed if each.name in names),
    )


def exact(one: Tried, other: Tried) -> bool:
    """Whether the two are easily confused, and the formulas of both are exact: then the likelihood ratio decides alone
    between them, at LEVEL."""
    return confusable(one.effect, other.effect) and not formula_error(one.effect, other.effect)


def as_much(less: Tried, more: Tried) -> bool:
    """Whether `less` explains as much as `more`, but for what formulas may leave; where these are exact, but for
    chance.

    Real friction is no formula, and what a further parameter gains by bending a little towards it is no evidence for
    another effect: friction with bristles gains 7 % more by one formula than by its own.
    """
    error = formula_error(less.effect, more.effect)
    if not error and more.parameters > less.parameters:
        return needless(more, less) >= LEVEL
    return less.log_likelihood >= (1.0 - error) * more.log_likelihood


def formula_error(*effects: Effect) -> float:
    """Of the least exact of `effects`."""
    return max(each.formula_error for each in effects)


def needless(more: Tried, less: Tried) -> float:
    """p-value of the likelihood ratio of `more`, which has more parameters: how well chance alone explains its gain.

    An instant that was picked among many has the price of these.
    """
    gain, further = more.log_likelihood - less.log_likelihood, more.parameters - less.parameters
    return min(1.0, more.among * by_chance(gain, further))


def confusable(one: Effect, other: Effect) -> bool:
    """Whether the two are easily confused, by the catalogue's own word."""
    return one.family is other.family or other.name in one.confused_with or one.name in other.confused_with
