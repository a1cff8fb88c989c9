"""Decides about effects that were fitted, each added to the same model, from their numbers alone, through gates.

Each of GATES has one threshold and rejects with one reason. The effects that pass all of them are then tested as a
whole, because the likeliest of all that were considered may be due to chance (LEVEL). Next, the simplest of the
likeliest is named unless held-out data reject it. Last come its ties, the effects that the record cannot distinguish
from it.

Nothing is fitted here, so that a table of these numbers can be decided again (benchmarks/decisions.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from upright.diagnosis.evidence import LEVEL, SIGNIFICANT, by_chance, likelier
from upright.models.effect import Effect

DOUBT = 0.05
"""p-value of the likelihood ratio below which an effect with more parameters is tied with a simpler one that is
named."""
CHECKED = 3
"""Number of effects, the likeliest first, that are checked on held-out data before none is named."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """What held-out data say of one further effect.

    `gain`: rise of the log-likelihood, nats; `std`: standard deviation of the part of it that the fit did not predict;
    `known`: rise of the log prior of the parameters, nats. `closed_percent`: share of the excess error energy (over
    that of the sensors' noise, one horizon ahead) that the effect removes, with its standard deviation `closed_std`;
    None if there is no excess. `closing_percent`: the share that it would remove if it were right, and add if it were
    absent. `impacts`: parts of the model collide.
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
        """Whether the log-likelihood rises by more than its standard deviation, and no error clearly grows.

        The error ahead does not count if the effect changes it by less than its scatter, because then other errors of
        the model, which accumulate over the horizon, would decide. Nor does it count if parts collide: how well the
        motion after an impact is predicted depends on the filter, which the impacts of one record have shaped.
        """
        return (self.impacts or not self._grows) and self.gain + self.known >= self.std

    @property
    def _grows(self) -> bool:
        if self.closed_percent is None or self.closed_std is None or self.closing_percent is None:
            return False
        return self.closing_percent > self.closed_std and self.closed_percent <= -SIGNIFICANT * self.closed_std


@dataclass(frozen=True, slots=True)
class Tried:
    """One further effect in a model, in the numbers that decide about it.

    `log_likelihood`: rise over the model without it (nats), with `parameters` more, fitted to `rows` samples; `usual`:
    these two with its usual formula, if a finer one is likelier. `converged`: whether its fit did; `inside_bounds`: no
    amplitude ends at a bound; `t_ratio`: the largest of its amplitudes'. `p_value` of it or of an effect confusable
    with it, corrected for all effects. `among`: number of change points from which its own was chosen. `left`: rise of
    the log-likelihood that the formulas of the effects found before may leave. `held_out`: the result on data that its
    fit has not used, None if there is none. `in_usual_shape`: the log-likelihood with its shape held at the usual one,
    None if it was not needed. `refused`: why it is not named; empty if it passed all checks that were made.
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
    left: float = 0.0
    held_out: HeldOut | None = None
    in_usual_shape: float | None = None
    refused: str = ""

    @property
    def cost(self) -> float:
        """Price of its parameters (Schwarz), nats: the log-likelihood has to rise by more."""
        return 0.5 * self.parameters * math.log(self.rows)

    @property
    def evidence(self) -> float:
        """Logarithm of the posterior odds for it, against the model without it."""
        return self.log_likelihood - self.cost


Gate = Callable[[Tried, int], str]
"""Maps an effect, as one of so many that were tried, to the reason for its rejection, empty if it passes."""


def converges(tried: Tried, tries: int) -> str:
    """The likelihood of a fit that does not converge is unknown."""
    return "" if tried.converged else "its fit does not converge"


def is_inside_its_bounds(tried: Tried, tries: int) -> str:
    """An amplitude that the record drives to the limit of what is physical imitates another cause."""
    return "" if tried.inside_bounds else "its amplitude ends at a bound"


def is_significant(tried: Tried, tries: int) -> str:
    """If the amplitude may as well be zero, the other parameters explain the rise of the log-likelihood."""
    if tried.t_ratio > SIGNIFICANT:
        return ""
    return f"its t-ratio is {tried.t_ratio:.2g}, and more than {SIGNIFICANT:g} is needed"


def is_beyond_chance(tried: Tried, tries: int) -> str:
    """The best of many effects raises the log-likelihood by chance alone."""
    log_ratio, parameters = tried.usual or (tried.log_likelihood, tried.parameters)
    chance = tries * by_chance(log_ratio, parameters)
    return "" if chance < LEVEL else f"chance explains as much in {100.0 * min(1.0, chance):.2g} % of records"


def is_beyond_formula_errors(tried: Tried) -> str:
    """No formula is exact: an effect may describe no more than what the formulas of those found before leave."""
    if tried.log_likelihood >= tried.left:
        return ""
    return f"formulas found before may leave as much: a log-likelihood ratio of {tried.left:.3g}"


GATES: tuple[Gate, ...] = (converges, is_inside_its_bounds, is_significant, is_beyond_chance)


def gated(tried: Tried, tries: int) -> Tried:
    """`tried` with the reason of the first gate that rejects it."""
    return replace(tried, refused=next(filter(None, (gate(tried, tries) for gate in GATES)), ""))


@dataclass(frozen=True, slots=True)
class Round:
    """A search for one more effect `beside` those of a model, as one of `tries`: all that were fitted, which of them is
    `named`, empty for none, and what it is `tied_with`. `covered`: one that would be named if formulas were exact.
    `given`: the name was not chosen among these, only its ties were."""

    beside: tuple[str, ...]
    tries: int
    tried: tuple[Tried, ...]
    p_value: float
    named: str = ""
    tied_with: tuple[str, ...] = ()
    covered: str = ""
    given: bool = False

    @property
    def finding(self) -> Tried | None:
        """The effect that is named."""
        return next((each for each in self.tried if each.name == self.named), None)

    @property
    def passed(self) -> list[Tried]:
        """The effects that neither a gate nor held-out data rejected, the one with most evidence first."""
        return sorted((each for each in self.tried if not each.refused), key=lambda each: -each.evidence)


def decide(
    undecided: Round,
    on_held_out: Callable[[Tried], Tried],
    in_usual_shape: Callable[[Tried], float | None],
) -> Round:
    """`undecided`, whose effects went through GATES, with the effect that is named and its ties.

    `on_held_out` returns an effect with its result on held-out data, or with the reason for its rejection;
    `in_usual_shape` the log-likelihood of an effect whose shape is held at the usual one.
    """
    if undecided.p_value >= LEVEL:
        return undecided
    known, doubted = {each.name: each for each in undecided.tried}, False
    for _ in range(CHECKED):
        now = replace(undecided, tried=tuple(known.values()))
        if not now.passed:
            break
        best = on_held_out(simplest(now.passed))
        # An effect that explains the same as a rejected one is not named without a check of its own.
        stands = best.held_out.stands if best.held_out is not None else not doubted
        if not best.refused and not stands:
            why = "does not hold on held-out data" if best.held_out else "cannot be checked on held-out data"
            best = replace(best, refused=why)
        if not best.refused and (why := is_beyond_formula_errors(best)):
            known[best.name] = replace(best, refused=why)
            return replace(undecided, tried=tuple(known.values()), covered=best.name)
        known[best.name] = best
        if not best.refused:
            now = replace(undecided, tried=tuple(known.values()), named=best.name)
            return tie(now, in_usual_shape)
        doubted = True
    return replace(undecided, tried=tuple(known.values()))


def simplest(passed: Sequence[Tried]) -> Tried:
    """The first of `passed`, or one with fewer parameters that explains almost as much.

    Between exact formulas, the one with more parameters if the record requires them.
    """
    best = passed[0]
    needed = [
        each
        for each in passed
        if each.parameters > best.parameters and exact(each, best) and ratio_p_value(each, best) < LEVEL
    ]
    if needed:
        return needed[0]
    simple = [each for each in passed if each.cost < best.cost and explains_as_much(each, best)]
    return min(simple, key=lambda each: (each.cost, -each.log_likelihood)) if simple else best


def tie(named: Round, in_usual_shape: Callable[[Tried], float | None]) -> Round:
    """`named` with its ties: those that passed and are as plausible, by the odds or, if they are confusable with it, by
    the likelihood.

    The odds contain the price of parameters, which does not distinguish neighbours. A simpler effect is tied if it
    explains almost as much; one with more parameters is tied if the record requires them, or if it is as likely in its
    usual shape.
    """
    best, passed = named.finding, named.passed
    assert best is not None
    known = {each.name: each for each in named.tried}
    likeliest = max(each.evidence for each in passed)
    found: list[Tried] = []
    for each in sorted(passed, key=lambda each: each.cost):
        if each is best:
            continue
        named_ratio, other = best.log_likelihood, each.log_likelihood
        likely = not likelier(likeliest - each.evidence)
        if exact(best, each) and each.parameters < best.parameters:
            likely = explains_as_much(each, best)
        elif confusable(best.effect, each.effect):
            if each.cost < best.cost:
                likely = likely or explains_as_much(each, best)
            elif each.cost > best.cost:
                # An effect that can imitate the named one is an alternative only by what it does differently.
                needed = by_chance(other - named_ratio, each.parameters - best.parameters) < DOUBT
                likely = needed and (likely or not explains_as_much(best, each))
                if not likely and not likelier(named_ratio - other):
                    # If it is as likely in its usual shape, the record does not determine its shape.
                    held = in_usual_shape(each)
                    known[each.name] = replace(each, in_usual_shape=held)
                    likely = held is not None and not likelier(named_ratio - held)
            # Of an effect that contains a tied one, only what it explains beyond that would count.
            likely = likely and not any(one.cost < each.cost and explains_as_much(one, each) for one in found)
        if likely:
            found.append(each)
    names = {each.name for each in found}
    return replace(
        named,
        tried=tuple(known.values()),
        tied_with=tuple(each.name for each in passed if each.name in names),
    )


def exact(one: Tried, other: Tried) -> bool:
    """Whether the two are confusable, and the formulas of both are exact: then the likelihood ratio alone decides
    between them, at LEVEL."""
    return confusable(one.effect, other.effect) and not formula_error(one.effect, other.effect)


def explains_as_much(less: Tried, more: Tried) -> bool:
    """Whether `less` explains as much as `more`, apart from what formulas may leave; if these are exact, apart from
    chance.

    Real friction follows no formula exactly, and what a further parameter adds by bending a formula towards it is no
    evidence for another effect: the log-likelihood ratio of friction with bristles is 7 % higher with one other formula
    than with its own.
    """
    error = formula_error(less.effect, more.effect)
    if not error and more.parameters > less.parameters:
        return ratio_p_value(more, less) >= LEVEL
    return less.log_likelihood >= (1.0 - error) * more.log_likelihood


def formula_error(*effects: Effect) -> float:
    """The formula error of the least exact of `effects`."""
    return max(each.formula_error for each in effects)


def ratio_p_value(more: Tried, less: Tried) -> float:
    """p-value of the likelihood ratio of `more`, which has more parameters: how well chance alone explains the
    difference.

    A change point chosen from many is corrected for their number.
    """
    log_ratio, further = more.log_likelihood - less.log_likelihood, more.parameters - less.parameters
    return min(1.0, more.among * by_chance(log_ratio, further))


def confusable(one: Effect, other: Effect) -> bool:
    """Whether the two are easily confused, according to the catalogue."""
    return one.family is other.family or other.name in one.confused_with or one.name in other.confused_with
