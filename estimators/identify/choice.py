"""Choice of the method to rely on, by a named rule with its reason in words.

The rule, "sound first, then the best prediction":

1. A method has to give values: for all estimated parameters, or for enough to measure its fit as that of the others.
2. A method that predicts worse than the mean of the measurements (a fit below 0 %) is not chosen.
3. A method that is not sound here (estimators.identify.table states the flaws, as data) is not chosen, unless a sound
   one has run and predicts worse than the mean: then the reason states the reservation.
4. Of the remaining methods that predict as well as the best, within AS_GOOD, the one with the lowest rank is chosen.
   Fits that were not measured in the same way cannot be compared: then the rank alone decides.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from upright.estimators.contract import Status
from upright.estimators.identify.table import METHODS, Condition, Flaw

AS_GOOD = 1.0
"""Insignificant difference of the fit, percent: the sensors' noise at the start of each prediction causes as much."""
SHORT = 1.0
"""Largest natural logarithm of the growth of an unstable motion within a simulation that counts as short compared with
the pole. For an axis with a pole at 5 rad/s under feedback, disturbed by white force noise of 0.5 N/sqrt(Hz) in
addition to pushes of 7 N (six records of 20 s, tests/support/unstable_plant.py), the inertia is 7 % too large with
windows of 2 / pole and 12 % with 4.5 / pole; prediction error is off by 0.5 %, within its scatter."""
MEAN = " (mean over the channels)"
COMMON, OWN = "alike", "own"
"""How a method's fit was measured: by the common predictor of all methods, or by the method itself."""


@dataclass(frozen=True, slots=True)
class Choice:
    """`best` is the method to rely on, "" for none; `reason` says why, or why there is none and what to do.

    By method: `unsound` says why it is not sound here, "" if it is; `not_chosen` why it is not the best, "" for the
    best.
    """

    best: str
    reason: str
    unsound: Mapping[str, str]
    not_chosen: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class _Candidate:
    """A method that gives values. `fit` percent, the mean over its channels; None if it is not known."""

    name: str
    rank: int
    fit: float | None
    comparable: bool
    unsound: str

    @property
    def predicts(self) -> bool:
        """Whether it predicts better than the mean of the measurements, as far as is known."""
        return self.fit is None or self.fit >= 0.0

    @property
    def in_words(self) -> str:
        if self.fit is None:
            return "its fit is not known"
        return f"its fit is {self.fit:.1f} %" + ("" if self.comparable else " by its own measure")


def choose(methods: Mapping[str, Mapping[str, Any]], *, closed_loop: bool = True) -> Choice:
    """The choice among the entries of `methods`, by name, as in the document of `identify --json`.

    Of an entry it reads `status`, `reason`, `fit_percent` and, if they are there, `fit_measured` (COMMON by default),
    `pole` (1/s, the largest real part at its values) and `window` (s of its longest simulation). `closed_loop`: the
    measurements were fed back by a controller.
    """
    ranked = [name for name in sorted(methods, key=_rank) if METHODS[name].rank is not None]
    unsound = {name: _unsound(name, methods[name], closed_loop) for name in methods}
    usable = [
        _candidate(name, methods[name], unsound[name])
        for name in ranked
        if (methods[name]["status"] == Status.OK if _is_own(methods[name]) else methods[name]["fit_percent"])
    ]
    predicting = [each for each in usable if each.predicts]
    sound = [each for each in predicting if not each.unsound]
    # If a sound method does not fit the record, the others are judged by their prediction.
    missed = [each for each in usable if not each.unsound and not each.predicts]
    left = sound or ([each for each in predicting if each.fit is not None] if missed else [])
    best = _first(left)
    if best is None:
        reason = _none(usable, methods, ranked)
    else:
        reason = _chosen(best, left, missed if not sound else [])
    lost = {each.name: _lost(each, best) for each in usable}
    not_chosen = {name: lost.get(name, _no_values(name, methods[name])) for name in methods}
    if best is not None:
        not_chosen[best.name] = ""
    return Choice(best.name if best else "", reason, unsound, not_chosen)


def _rank(name: str) -> float:
    rank = METHODS[name].rank
    return float("inf") if rank is None else rank


def _is_own(entry: Mapping[str, Any]) -> bool:
    return bool(entry.get("fit_measured", COMMON) == OWN)


def _candidate(name: str, entry: Mapping[str, Any], unsound: str) -> _Candidate:
    fit = fmean(entry["fit_percent"].values()) if entry["fit_percent"] else None
    return _Candidate(name, METHODS[name].rank or 0, fit, not _is_own(entry), unsound)


def _unsound(name: str, entry: Mapping[str, Any], closed_loop: bool) -> str:
    """Why the method is not sound here, "" if it is."""
    return "; ".join(each for flaw in METHODS[name].flaws for each in _counts(flaw, entry, closed_loop))


def _counts(flaw: Flaw, entry: Mapping[str, Any], closed_loop: bool) -> Iterator[str]:
    """The words for `flaw` if its condition holds."""
    pole, window = entry.get("pole"), entry.get("window")
    match flaw.condition:
        case Condition.ALWAYS:
            yield flaw.reason
        case Condition.CLOSED_LOOP if closed_loop:
            yield flaw.reason
        case Condition.UNSTABLE if pole is not None and pole > 0.0:
            if window is None:
                yield f"{flaw.reason} (pole {pole:.3g} 1/s)"
            elif pole * window > SHORT:
                yield f"{flaw.reason} (pole {pole:.3g} 1/s, windows of {window:.2g} s; short is {SHORT / pole:.2g} s)"


def _first(left: list[_Candidate]) -> _Candidate | None:
    """The lowest rank among those that predict as well as the best, or among all if no fit can be compared."""
    comparable = [each for each in left if each.comparable and each.fit is not None]
    most = max((each.fit for each in comparable if each.fit is not None), default=None)
    if most is None:
        return min(left, key=lambda each: each.rank, default=None)
    as_good = [each for each in comparable if each.fit is not None and each.fit >= most - AS_GOOD]
    return min(as_good, key=lambda each: each.rank)


def _chosen(best: _Candidate, left: list[_Candidate], missed: list[_Candidate]) -> str:
    """Why `best` is chosen; `missed` are the sound methods that predict worse than the mean, if it is not sound."""
    if missed:
        names = ", ".join(f"{each.name} ({each.fit:.1f} %)" for each in missed)
        return (
            f"with a reservation: {best.in_words}, while the sound methods predict worse than the mean of the"
            f" measurements: {names}; but {best.unsound}. Check the recordings and the model before relying on it"
        )
    others = [each for each in left if each is not best]
    if not others:
        return f"it is the only method that is sound here and gives a usable model; {best.in_words}{MEAN}"
    compared = [each.fit for each in left if each.comparable and each.fit is not None]
    if best.comparable and best.fit is not None:
        if max(compared) > best.fit:
            return (
                f"it is sound here, and {best.in_words}{MEAN}, within {AS_GOOD:g} % of the best;"
                " of the methods within that range it is usually the most precise"
            )
        return f"it is sound here and predicts best of the sound methods: {best.fit:.1f} %{MEAN}"
    return f"it is sound here and usually the most precise; the fits were not measured in the same way; {best.in_words}"


def _lost(each: _Candidate, best: _Candidate | None) -> str:
    """Why a method with values is not the best."""
    if not each.predicts:
        return f"it predicts worse than the mean of the measurements ({each.fit:.1f} %)"
    if each.unsound:
        return f"not sound here: {each.unsound}"
    if best is None:
        return each.in_words
    compared = each.comparable and best.comparable
    if compared and each.fit is not None and best.fit is not None and each.fit < best.fit - AS_GOOD:
        return f"its fit is {each.fit:.1f} %, that of {best.name} {best.fit:.1f} %"
    if each.rank < best.rank:
        return f"its fit cannot be compared: {each.in_words}"
    return f"{each.in_words}; {best.name} is usually more precise"


def _no_values(name: str, entry: Mapping[str, Any]) -> str:
    """Why a method that gives no model is not the best."""
    if METHODS[name].rank is None:
        return "it does not estimate the model"
    if entry["status"] == Status.OK:
        return str(entry.get("reason")) or "its fit could not be measured as that of the others"
    state = str(entry["status"]).replace("_", " ")
    return f"{state}: {entry['reason']}" if entry.get("reason") else state


def _none(usable: list[_Candidate], methods: Mapping[str, Mapping[str, Any]], ranked: list[str]) -> str:
    """Why there is no method to rely on, and what to do."""
    remedy = next(name for name in sorted(METHODS, key=_rank) if not METHODS[name].flaws)
    run = f"; run {remedy}" if remedy not in methods else ""
    if not usable:
        reasons_by_rank = [f"{name}: {_no_values(name, methods[name])}" for name in ranked]
        return f"no method gives all values{run}" + (f" ({reasons_by_rank[0]})" if reasons_by_rank else "")
    if not any(each.predicts for each in usable):
        fits = ", ".join(f"{each.name} {each.fit:.1f} %" for each in usable)
        return (
            f"every method predicts worse than the mean of the measurements ({fits}): the model does not fit the data;"
            f" check units, signs and the model's start values{run}"
        )
    reasons: dict[str, list[str]] = {}
    for each in usable:
        if each.unsound and each.predicts:
            reasons.setdefault(each.unsound, []).append(each.name)
    why = "; ".join(f"{', '.join(names)}: {reason}" for reason, names in reasons.items())
    if not run and remedy in methods and methods[remedy]["status"] != Status.OK:
        run = f"; {remedy} gives no values ({_no_values(remedy, methods[remedy])})"
    return f"no sound method has given values. {why}{run}"
