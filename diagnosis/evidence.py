"""When is an effect needed, and when is one explanation better than another? All parts of the diagnosis use these
rules.

An effect is needed if chance alone would raise the log-likelihood as much, by any of the effects considered, in less
than LEVEL of records, and if its amplitude exceeds SIGNIFICANT standard deviations: of its own estimate, or of the
estimate that would result if the effect were absent. A diagnosis considers the whole catalogue, `upright model add` and
`upright model drop-test` a single effect: what a diagnosis names, these call needed on the same samples. Of two
explanations one is better if its odds, by Schwarz's criterion, exceed ODDS to one.

Sources: Wilks, "The large-sample distribution of the likelihood ratio for testing composite hypotheses", Annals of
Mathematical Statistics 9 (1938) 60-62; Davies, "Hypothesis testing when a nuisance parameter is present only under the
alternative", Biometrika 74 (1987) 33-43; Schwarz, "Estimating the dimension of a model", Annals of Statistics 6 (1978)
461-464; Kass, Raftery, "Bayes factors", Journal of the American Statistical Association 90 (1995) 773-795: 20 to 1 is
where "strong" begins.
"""

from __future__ import annotations

import math

from upright.estimators.contract import ParameterEstimate
from upright.estimators.tails import chi2_sf

LEVEL = 0.01
"""Probability of naming an effect when nothing is missing, and of calling a parameter needed that is not."""
SIGNIFICANT = 2.0
"""Standard deviations above which an amplitude is significant: one in twenty exceeds them by chance."""
ODDS = 20.0
"""Odds above which one explanation counts as better than another."""
STRONG = math.log(ODDS)
"""The same as a difference of log-likelihoods, nats."""


def by_chance(log_ratio: float, count: int, shapes: int = 0, rows: int = 1) -> float:
    """p-value of `log_ratio`, the rise of the log-likelihood (nats) by `count` further parameters, one at least.

    Of these, `shapes` mean nothing without the others, as the frequency of an oscillation without its amplitude. Then
    the ratio is the largest of a chi-squared process over them, and its p-value at most that of one point times the
    number of maxima (Davies). A record of `rows` samples has at most as many for each shape.
    """
    return min(1.0, float(rows) ** shapes * float(chi2_sf(2.0 * log_ratio, max(count, 1))))


def beyond_chance(log_ratio: float, count: int, tries: int = 1) -> bool:
    """Whether the log-likelihood ratio (nats) is larger than chance makes it for the best of `tries` effects of `count`
    parameters each."""
    return tries * by_chance(log_ratio, count) < LEVEL


def is_supported(log_ratio: float, count: int, t_ratio: float, tries: int = 1) -> bool:
    """Whether an effect is needed whose amplitude is `t_ratio` standard deviations from zero. The other arguments are
    those of `beyond_chance`."""
    return t_ratio > SIGNIFICANT and beyond_chance(log_ratio, count, tries)


def is_significant(estimate: ParameterEstimate) -> bool:
    """Whether `estimate` is further from zero than SIGNIFICANT of its stated standard deviations; False if the record
    does not determine it."""
    value, std = estimate.value, estimate.std
    return value is not None and bool(std) and abs(value) > SIGNIFICANT * (std or 0.0)


def likelier(log_odds: float, tries: float = 1.0) -> bool:
    """Whether one explanation is better than another, as one of `tries` with the same prior probability.

    `log_odds`: natural logarithm of the odds for it, half of the decrease of the Bayesian information criterion.
    """
    return log_odds > math.log(tries) + STRONG
