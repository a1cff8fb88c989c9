"""The figures of merit of each method, each with its 95 % interval and the number of cases.

Shares have Wilson's interval (E. B. Wilson, JASA 22 (1927) 209), medians that of the order statistics. "Seen" cases
have at least twice the minimum detectable effect. A method that failed in a case counts as not right.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from statistics import median
from typing import Any

from scipy.stats import binom, binomtest

from upright.service.hidden_effects.cases import Kind
from upright.service.hidden_effects.methods.answers import ADEQUATE, INSUFFICIENT, MISSING, UNKNOWN
from upright.service.hidden_effects.results.by_disturbance import thirds
from upright.service.hidden_effects.results.trials import methods_of
from upright.service.hidden_effects.trial import DETECTABLE, Line

SEEN = 2.0
"""Multiple of the minimum detectable effect from which on an effect should be named."""
FAILED = "failed"
"""The entry for a method that gave no answer."""


@dataclass(frozen=True, slots=True)
class Figure:
    """A share or a median of `of` cases with its 95 % interval; all None if there is no case."""

    value: float | None
    low: float | None
    high: float | None
    of: int
    count: int | None = None
    """For a share: the number of cases that count."""

    def to_json(self) -> dict[str, float | int | None]:
        document: dict[str, float | int | None] = {
            "value": self.value,
            "low": self.low,
            "high": self.high,
            "of": self.of,
        }
        return document if self.count is None else {**document, "count": self.count}


def share(true: Collection[bool]) -> Figure:
    """The share of cases that are true."""
    of, count = len(true), sum(true)
    if not of:
        return Figure(None, None, None, 0, 0)
    interval = binomtest(count, of).proportion_ci(method="wilson")
    return Figure(count / of, float(interval.low), float(interval.high), of, count)


def middle(values: Iterable[float | None]) -> Figure:
    """The median of the known values. With fewer than six, no two contain it with 95 %, so the interval is None."""
    known = sorted(value for value in values if value is not None)
    if not known:
        return Figure(None, None, None, 0)
    # The median lies between the k-th and the k-th last value unless fewer than k of n coins show heads, or tails.
    rank = int(binom.ppf(0.025, len(known), 0.5))
    enough = rank >= 1
    return Figure(median(known), known[rank - 1] if enough else None, known[-rank] if enough else None, len(known))


@dataclass(frozen=True, slots=True)
class Merit:
    """The figures of one method. `right` and `both` are by size, `false_alarms` and `right_by_excitation` by
    excitation, `confusion` by hidden effect and the name given first. Those `_by_disturbance` are by third of the
    disturbance's RMS, and empty if there was no disturbance."""

    right_seen: Figure
    right: Mapping[str, Figure]
    right_by_excitation: Mapping[str, Figure]
    right_by_disturbance: Mapping[str, Figure]
    seen_unknown: Figure
    """Share of the seen single effects with the verdict unknown: an effect may be named beside it or not."""
    false_alarms_all: Figure
    seen_unknown_by_disturbance: Mapping[str, Figure]
    false_alarms: Mapping[str, Figure]
    false_alarms_by_disturbance: Mapping[str, Figure]
    false_names: Figure
    """Share of all records with no effect, one or two, of any size, that have a name of an effect that is not there."""
    false_names_that_matter: Figure
    """The same without findings that are called negligible."""
    unlisted_unknown: Figure
    unlisted_misnamed: Figure
    both_seen: Figure
    both: Mapping[str, Figure]
    both_by_disturbance: Mapping[str, Figure]
    held_out_closed: Figure
    energy_over_floor: Figure
    covered: Figure
    disturbance_covered: Mapping[str, Figure]
    """Coverage of each of its two numbers, empty if there was no disturbance."""
    disturbance_covered_named: Mapping[str, Figure]
    """The same for records in which all hidden effects and no others are named: otherwise the estimated disturbance
    contains what is missing or explained in excess."""
    seconds: Figure
    failed: int
    confusion: Mapping[str, Mapping[str, int]]

    def to_json(self) -> dict[str, Any]:
        def plain(value: Any) -> Any:
            if isinstance(value, Figure):
                return value.to_json()
            return {key: plain(each) for key, each in value.items()} if isinstance(value, Mapping) else value

        return {name: plain(getattr(self, name)) for name in self.__slots__}


@dataclass(frozen=True, slots=True)
class Summary:
    """`cases` by status, `conditions` of all of them, `detectable` by excitation and noise and by effect, `methods`."""

    conditions: str
    cases: Mapping[str, int]
    detectable: Mapping[str, Mapping[str, float]]
    methods: Mapping[str, Merit]

    def to_json(self) -> dict[str, Any]:
        return {
            "conditions": self.conditions,
            "cases": dict(self.cases),
            "detectable": {key: dict(sizes) for key, sizes in self.detectable.items()},
            "methods": {name: merit.to_json() for name, merit in self.methods.items()},
        }


def summarise(lines: Iterable[Line]) -> Summary:
    """The figures of all methods in the lines of a results file."""
    lines = list(lines)
    usable = [line for line in lines if line["status"] == "ok"]
    return Summary(
        conditions=lines[0]["conditions"] if lines else "",
        cases=Counter(line["status"] for line in lines),
        detectable={
            f"{line['excitation']}, noise {line['noise']:g}": line[DETECTABLE] for line in usable if DETECTABLE in line
        },
        methods={name: merit(usable, name) for name in methods_of(usable)},
    )


def merit(lines: Sequence[Line], method: str) -> Merit:
    """The figures of `method` in lines whose status is ok."""
    answered = [line for line in lines if method in line["methods"]]
    by_kind = {kind: [line for line in answered if line["kind"] == kind.value] for kind in Kind}
    nothing, one, two, unlisted = (by_kind[kind] for kind in (Kind.NOTHING, Kind.ONE, Kind.TWO, Kind.UNLISTED))
    seen, both_seen, strange = ([line for line in part if line["size"] >= SEEN] for part in (one, two, unlisted))

    def answer(line: Line) -> Mapping[str, Any]:
        found: Mapping[str, Any] = line["methods"][method]
        return found

    def right(line: Line) -> bool:
        found = answer(line).get("found", [])
        return bool(found) and _names(line["effects"][0], found[0])

    def both(line: Line) -> bool:
        return any(
            all(_names(effect, found) for effect, found in zip(line["effects"], chosen, strict=True))
            for chosen in permutations(answer(line).get("found", []), len(line["effects"]))
        )

    def alarm(line: Line) -> bool:
        return answer(line).get("verdict") in (MISSING, UNKNOWN)

    def false_names(line: Line) -> list[Mapping[str, Any]]:
        found = answer(line).get("found", [])
        return [each for each in found if not {each["effect"], *each["tied_with"]}.intersection(line["effects"])]

    def false_name(line: Line) -> bool:
        return bool(false_names(line))

    def it_matters(line: Line) -> bool:
        return any(not each.get("negligible", False) for each in false_names(line))

    def unknown(line: Line) -> bool:
        return answer(line).get("verdict") == UNKNOWN

    parts = thirds(lines)

    def by_disturbance(chosen: Sequence[Line], true: Callable[[Line], bool]) -> dict[str, Figure]:
        among = {id(line) for line in chosen}
        values = {part: [true(line) for line in of if id(line) in among] for part, of in parts.items()}
        return {part: share(each) for part, each in values.items() if each}

    def all_named(line: Line) -> bool:
        names = {name for each in answer(line).get("found", []) for name in (each["effect"], *each["tied_with"])}
        return line["kind"] != Kind.UNLISTED.value and names >= set(line["effects"]) and not false_name(line)

    def disturbance_covered(chosen: Sequence[Line]) -> dict[str, Figure]:
        numbers: dict[str, list[bool]] = {}
        for line in chosen:
            for name, holds in answer(line).get("disturbance_covered", {}).items():
                numbers.setdefault(name, []).append(holds)
        return {name: share(each) for name, each in numbers.items()}

    confusion: dict[str, Counter[str]] = {}
    for line in (*seen, *strange):
        confusion.setdefault(line["effects"][0], Counter())[_named(answer(line), line["kind"])] += 1
    return Merit(
        right_seen=share([right(line) for line in seen]),
        right=_by(one, _size, right),
        right_by_excitation=_by(seen, _excitation, right),
        right_by_disturbance=by_disturbance(seen, right),
        seen_unknown=share([unknown(line) for line in seen]),
        seen_unknown_by_disturbance=by_disturbance(seen, unknown),
        false_alarms_all=share([alarm(line) for line in nothing]),
        false_alarms=_by(nothing, _excitation, alarm),
        false_alarms_by_disturbance=by_disturbance(nothing, alarm),
        false_names=share([false_name(line) for line in (*nothing, *one, *two)]),
        false_names_that_matter=share([it_matters(line) for line in (*nothing, *one, *two)]),
        unlisted_unknown=share([unknown(line) for line in strange]),
        unlisted_misnamed=share([answer(line).get("verdict") == MISSING for line in strange]),
        both_seen=share([both(line) for line in both_seen]),
        both=_by(two, _size, both),
        both_by_disturbance=by_disturbance(both_seen, both),
        held_out_closed=middle(answer(line).get("held_out_closed") for line in (*seen, *both_seen)),
        energy_over_floor=middle(answer(line).get("energy_over_floor") for line in (*nothing, *one, *two)),
        covered=share([each for line in (*one, *two) for each in answer(line).get("covered", {}).values()]),
        disturbance_covered=disturbance_covered(answered),
        disturbance_covered_named=disturbance_covered([line for line in answered if all_named(line)]),
        seconds=middle(answer(line)["seconds"] for line in answered),
        failed=sum(bool(answer(line)["error"]) for line in answered),
        confusion=confusion,
    )


def _names(effect: str, found: Mapping[str, Any]) -> bool:
    """Whether a finding names `effect`, alone or with at most one other."""
    return effect in (found["effect"], *found["tied_with"]) and len(found["tied_with"]) <= 1


def _named(answer: Mapping[str, Any], kind: str) -> str:
    """The name, or the verdict, of an answer."""
    if answer["error"]:
        return FAILED
    # For an effect outside the catalogue, unknown is right even beside a name; a listed effect has been named or not.
    if answer["found"] and not (kind == Kind.UNLISTED.value and answer["verdict"] == UNKNOWN):
        return str(answer["found"][0]["effect"])
    return {ADEQUATE: "nothing", INSUFFICIENT: "insufficient data"}.get(answer["verdict"], str(answer["verdict"]))


def _by(lines: Sequence[Line], key: Callable[[Line], str], true: Callable[[Line], bool]) -> dict[str, Figure]:
    keys = dict.fromkeys(key(line) for line in lines)
    return {each: share([true(line) for line in lines if key(line) == each]) for each in keys}


def _size(line: Line) -> str:
    return f"{line['size']:g}"


def _excitation(line: Line) -> str:
    return str(line["excitation"])
