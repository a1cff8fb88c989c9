"""What a revision proves, in sentences."""

from __future__ import annotations

from collections.abc import Iterator
from math import degrees

from upright.diagnosis.evidence import LEVEL, SIGNIFICANT
from upright.diagnosis.revise.result import Neighbour, Revision

MOST_ODDS = 1e4
WORTH_STATING = 0.05
"""Share by which the error falls with a neighbour, from which on the neighbour is mentioned."""
SHOWN = {"rad": ("deg", degrees(1.0)), "rad/s": ("deg/s", degrees(1.0)), "m": ("mm", 1e3), "m/s": ("mm/s", 1e3)}
"""By SI unit: the one in which people read a small error, and its number in it."""


def in_words(revision: Revision) -> list[str]:
    """The outcome first, then its significance, then what would separate it from its neighbours."""
    return list(_sentences(revision))


def readable(unit: str) -> tuple[str, float]:
    """The unit in which an error in `unit` is shown, and the factor to it."""
    return SHOWN.get(unit, (unit, 1.0))


def odds_text(odds: float) -> str:
    """`50 to 1`, `1 to 50`; beyond MOST_ODDS only a bound."""
    if odds > MOST_ODDS:
        return f"more than {MOST_ODDS:.0f} to 1"
    if odds * MOST_ODDS < 1.0:
        return f"less than 1 to {MOST_ODDS:.0f}"
    return f"{odds:.0f} to 1" if odds >= 1.0 else f"1 to {1.0 / odds:.0f}"


def _sentences(revision: Revision) -> Iterator[str]:
    budget, horizon = revision.budget, revision.horizons[-1]
    moves = "does not change"
    if abs(budget.fall) > 5e-4:
        moves = f"{'falls' if budget.fall > 0.0 else 'rises'} by {_percent(abs(budget.fall))}"
    closed = budget.closed_percent
    of = (
        "" if closed is None or closed < 0.5 else f" ({min(closed, 100.0):.0f} % of the excess over the sensors' floor)"
    )
    yield f"With {revision.effect} the held-out error {horizon:g} s ahead {moves}{of}."
    if not revision.needed:
        chance = (
            f"chance alone explains as much in {_percent(revision.p_value)} of records (less than {_percent(LEVEL)}"
        )
        size = f"its t-ratio is {revision.t_ratio:.1f} (more than {SIGNIFICANT:.0f} is needed)"
        yield f"The records do not support it: {chance} is needed), and {size}."
    elif budget.fall <= 0.0 and (near := _falls_near(revision)):
        channels = " and ".join(f"{channel} by {_percent(share)}" for channel, share in near.items())
        first = revision.horizons[0]
        yield f"At {first:g} s ahead the error falls: {channels}. What is left of the error grows with the horizon."
    elif budget.fall <= 0.0:
        yield "It explains only the records that it was fitted to: the model may lack something else."
    elif revision.odds > 1.0:
        yield f"By BIC the odds for it are {odds_text(revision.odds)}."
    else:
        yield f"Chance alone explains as much in {_percent(revision.p_value)} of records."
    if revision.uses_time and not all(each.startswith("last third") for each in revision.held_out):
        yield "It depends on the time since a record's first sample, so another recording says little about it."
    if budget.unexplained > max(budget.sensors, 0.02):
        yield (
            f"{_percent(budget.unexplained)} of the error energy is still unexplained: "
            "`upright diagnose` searches for what else is missing."
        )
    back = [name for name, each in revision.moved.items() if each.back and abs(each.before) > 2.0 > abs(each.after)]
    if back:
        yield f"Back within two standard deviations of its CAD value: {', '.join(back)}."
    yield from _about_neighbours(revision)
    if revision.needed and revision.separated_by and any(each.tied or each.better for each in revision.neighbours):
        yield f"What would separate {revision.effect} from its neighbours: {revision.separated_by}"


def _falls_near(revision: Revision) -> dict[str, float]:
    """Shares by which held-out errors fall at the shortest horizon, of the channels whose error exceeds the sensors'
    there; empty if one of these rises.

    An unstable vehicle amplifies small errors: if an impact is predicted a sample late, nothing is right some samples
    later.
    """
    floor = revision.floor_held_out
    before, after = revision.before.held_out, revision.after.held_out
    falls = {name: 1.0 - after[name][0] / errors[0] for name, errors in before.items() if errors[0] > floor[name][0]}
    return falls if falls and min(falls.values()) > WORTH_STATING else {}


def _about_neighbours(revision: Revision) -> Iterator[str]:
    near = [each for each in revision.neighbours if each.fall > WORTH_STATING] if revision.needed else []
    for each in near:
        falls = f"With {each.effect} instead the error falls by {_percent(each.fall)}"
        if each.better:
            yield (
                f"{falls}, and the odds are {odds_text(each.odds)} for {each.effect}{_confusable(each)}: "
                f"{revision.effect} imitates it, or a part of it, and its falling error proves little."
            )
        elif each.tied:
            yield f"{falls} too, so the falling error proves little: the two are tied{_confusable(each)}."
    others = [each for each in near if not (each.better or each.tied)]
    if others:
        names = ", ".join(f"{each.effect} (by {_percent(each.fall)}{_confusable(each, ', ')})" for each in others)
        odds = odds_text(max(each.odds for each in others))
        yield f"With a neighbour instead the error falls as well, but the odds are {odds} at best: {names}."


def _confusable(neighbour: Neighbour, before: str = "; ") -> str:
    if neighbour.correlation is None:
        return ""
    return f"{before}score directions correlate by {neighbour.correlation:.2f}"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %" if abs(share) < 0.1 or share > 0.995 else f"{100.0 * share:.0f} %"
