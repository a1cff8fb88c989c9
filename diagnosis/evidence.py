"""When is an effect asked for, and when is one explanation better than another? The one answer of all who ask.

An effect is asked for where chance alone would give any of the effects that were looked at as much log likelihood in
less than LEVEL of records, and where its size is beyond SURE standard deviations: of its own, or of those that it would
scatter by were there none of it. A diagnosis looks at the whole catalogue, `upright model add` and
`upright model drop-test` at one effect: what a diagnosis names, these call needed on the same rows. Of two explanations
one is better where the odds for it, by Schwarz, are beyond ODDS to one.

Sources: Wilks, "The large-sample distribution of the likelihood ratio for testing composite hypotheses", Annals of
Mathematical Statistics 9 (1938) 60-62; Schwarz, "Estimating the dimension of a model", Annals of Statistics 6 (1978)
461-464; Kass, Raftery, "Bayes factors", Journal of the American Statistical Association 90 (1995) 773-795: 20 to 1 is
where "strong" begins.
"""

from __future__ import annotations

import math

from scipy.stats import chi2

LEVEL = 0.01
"""Probability of naming an effect where nothing is missing, and of asking for a parameter that is not needed."""
SIGNIFICANT = 2.0
"""Standard deviations from which a size counts: one in twenty by chance."""
ODDS = 20.0
"""From which one explanation counts as better than another."""
STRONG = math.log(ODDS)
"""The same as log likelihood, nats."""


def by_chance(gain: float, count: int) -> float:
    """p-value of the log likelihood that `count` further parameters, one at least, `gain` (nats)."""
    return float(chi2.sf(2.0 * gain, max(count, 1)))


def beyond_chance(gain: float, count: int, tries: int = 1) -> bool:
    """Whether chance alone gives none of `tries` effects, of `count` parameters each, as much `gain` (nats)."""
    return tries * by_chance(gain, count) < LEVEL


def asked_for(gain: float, count: int, t_ratio: float, tries: int = 1) -> bool:
    """Whether an effect is asked for whose size is `surety` standard deviations from zero. The other arguments are
    those of `beyond_chance`."""
    return t_ratio > SIGNIFICANT and beyond_chance(gain, count, tries)


def likelier(log_odds: float, tries: float = 1.0) -> bool:
    """Whether one explanation is better than another, as one of `tries` that were as likely beforehand.

    `log_odds`: natural logarithm of the odds for it, half of what the Bayes information criterion falls by.
    """
    return log_odds > math.log(tries) + STRONG
