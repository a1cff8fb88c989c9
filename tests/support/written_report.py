"""A diagnosis of a virtual vehicle, its report, and a parser of its page."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from html.parser import HTMLParser

from virtual_records import multisine

from upright.diagnosis.diagnose import Diagnosis, diagnose
from upright.diagnosis.prediction.relevance import Relevance
from upright.diagnosis.report import Provenance, write_report
from upright.estimators.identify.run import with_values
from upright.telemetry.recording import Recording
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)
HOSTILE = 'runs/<script>alert("1")</script> & $x^2$ "a" <b>.arrow'
HASH = "5e" * 32
PROVENANCE = Provenance(vehicle="monocab", version="1.2.3", date="2031-02-03 04:05", hashes={HOSTILE: HASH})
CANDIDATES = ("coulomb_friction", "stribeck_friction", "viscous_friction", "gyro_bias")
"""Few, to keep the tests short: the effect, its confusable neighbour, another, and one that a filter has learned."""
LARGEST = 3_000_000
"""Bytes, largest size of a page that can be sent by mail."""
VOID = frozenset({"meta", "br", "link", "img", "input", "hr"})
FIGURES = (
    "Measured and predicted, by channel, and the prediction errors",
    "Innovation energy relative to noise, by time and by frequency",
    "Mean missing force by coordinate",
    "Innovation energy relative to noise, step by step",
)


class Page(HTMLParser):
    """Tags, attributes and text of a page; raises AssertionError if a tag is not closed at the right place."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag
        if tag in ("td", "th", "text"):
            self.words.append(" ")

    def handle_data(self, data: str) -> None:
        if "style" not in self._open:
            self.words.append(data)

    @property
    def text(self) -> str:
        """The visible text, with each run of spaces as one."""
        return " ".join("".join(self.words).split())

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.tags if name == tag]

    @property
    def figures(self) -> list[str]:
        return [each["aria-label"] for each in self.all("svg") if each["aria-label"] in FIGURES]


@cache
def record() -> Recording:
    # The plant's bristle friction at its catalogue amplitude, 60 N m: forty times the detectable one in this record.
    return replace(multisine("coulomb_friction"), source=HOSTILE)


@cache
def found() -> Diagnosis:
    return diagnose(MODEL, [record()], support=VEHICLE.support, candidates=CANDIDATES)


@cache
def written() -> str:
    return write_report(found(), MODEL, [record()], support=VEHICLE.support, provenance=PROVENANCE)


@cache
def page() -> Page:
    return Page(written())


def of_little_matter() -> Diagnosis:
    """The diagnosis, as if the effect found caused 0.2 % of the error."""
    finding = replace(found().findings[0], relevance=Relevance(0.5, 0.2, 0.1))
    return replace(found(), findings=(finding,))
