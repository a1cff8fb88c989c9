"""What the reports have in common: their provenance, and the page template that is filled in.

Each is one HTML file that can be mailed and printed: no script, no other file, nothing to load. The caller supplies
what a pure function cannot know: vehicle, files and date.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from upright.diagnosis.prediction.compare import Comparison


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a report comes from. `hashes`: SHA-256 of each recording by its name. `date` is shown as given.
    `assumed`: what was assumed to read each recording that others wrote, by its name."""

    vehicle: str = ""
    version: str = ""
    date: str = ""
    hashes: Mapping[str, str] = field(default_factory=dict)
    assumed: Mapping[str, Sequence[str]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Figures:
    """Inline SVG, empty if there is none; `missing` says in words why."""

    overlay: str = ""
    loop: str = ""
    energies: str = ""
    forces: str = ""
    staircase: str = ""
    missing: str = ""


def render(
    template: str, models: Sequence[str], provenance: Provenance | None, *, package: str = __package__, **values: Any
) -> str:
    """The page as text. `models` names what it is about. The `package` of the template may have more of its own."""
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=ChoiceLoader([PackageLoader(package), PackageLoader(__package__)]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template(template)
    return page.render(models=models, provenance=provenance or Provenance(), **values)


def compared_figures(comparisons: Sequence[Comparison], name: str = "") -> Figures:
    """The figures of models side by side on the same recordings; `name` distinguishes those of several sets."""
    from upright.diagnosis.report.figures import diagnosis as pictures
    from upright.diagnosis.report.figures.loop import closed_loop

    return Figures(
        overlay=pictures.overlay(comparisons, f"overlay{name}"),
        loop=closed_loop(comparisons, f"loop{name}"),
        energies=pictures.energies(comparisons, f"energies{name}"),
        forces=pictures.forces(comparisons, f"forces{name}"),
    )
