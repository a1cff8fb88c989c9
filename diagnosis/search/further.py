"""How much a further effect has to gain beside those that were found: no formula is exact, and a long record tells."""

from __future__ import annotations

from collections.abc import Sequence

from diagnosis.findings import Finding
from diagnosis.gates import alike
from diagnosis.search.explanation import Explanation

FURTHER = 0.02
"""Share of what was gained so far that a further effect has to gain.

What backlash leaves looks like elasticity, which is a neighbour. With 0.05 friction or a torque beside it had no
name."""
FURTHER_ALIKE = 0.1
"""The same for an effect that is easily confused with one that was found: it bends its formula."""
FURTHER_STRUCK = 0.2
"""The same beside one whose parts strike each other: fits of the same model end up to a tenth of what was gained apart,
as impacts come a row early or late, and a torque that sets in somewhere moved 437 and 512 nats of 4,000."""


def asked(further: Finding, before: Sequence[Finding], of_impacts: float = 0.0) -> float:
    """Log likelihood that a further effect has to gain, beside those found before and beside the effects of the model
    as it was whose parts strike each other, which gain `of_impacts`."""
    share = FURTHER_STRUCK if of_impacts else _least(before)
    if any(alike(further.definition, each.definition) for each in before):
        share = max(share, FURTHER_ALIKE)
    return share * (of_impacts + sum(each.log_likelihood_gain for each in before))


def says_something(found: Explanation) -> float:
    """Log likelihood by which two fits of effects that gain as much as those of `found` differ, if that is to mean
    anything."""
    return _least(found.findings) * found.gain


def _least(findings: Sequence[Finding]) -> float:
    return FURTHER_STRUCK if any(each.definition.strikes for each in findings) else FURTHER
