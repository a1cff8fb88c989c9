"""When is an effect asked for? The one answer of a diagnosis, of `upright model add` and of its drop tests.

An effect is asked for where the odds for the model with it are beyond ODDS to one, against the model without, and its
size is beyond SURE standard deviations of what it would scatter by were there none of it. The odds are those of Schwarz
(BIC). Where one of many was picked, each of these was as likely beforehand as that there is none of them. So what a
diagnosis names is what adding it to the model is then told to be.

Sources: Schwarz, "Estimating the dimension of a model", Annals of Statistics 6 (1978) 461-464; Kass, Raftery, "Bayes
factors", Journal of the American Statistical Association 90 (1995) 773-795: 20 to 1 is where "strong" begins.
"""

from __future__ import annotations

import math

ODDS = 20.0
"""From which one explanation counts as better than another."""
WORTH = math.log(ODDS)
SURE = 3.0
"""Standard deviations from which a size, or a difference on held-out data, counts."""


def likelier(gain: float, tries: float = 1.0) -> bool:
    """Whether one model is likelier than another by the odds that count.

    `gain`: natural logarithm of the odds for it (half of the fall of BIC), where it was one of `tries` that were as
    likely beforehand.
    """
    return gain > math.log(tries) + WORTH


def asked_for(gain: float, surety: float, tries: float = 1.0) -> bool:
    """Whether an effect whose model is likelier by `gain`, as in `likelier`, is asked for at all: also its size is not
    that of noise, being `surety` standard deviations from zero."""
    return surety > SURE and likelier(gain, tries)
