"""What does a diagnosis find in recordings by others? `python benchmarks/measured_verdicts.py [NAME ...]`

The model of each record lacks a known effect of the plant. The record is diagnosed twice within the time budget of
`upright diagnose`: with a random disturbance at each joint (models.random.disturbance), as all models have it, and
without. The program prints the verdict, the effects, the energy of the one-step errors over the noise floor before and
after, and seconds of wall clock time. `--json FILE` writes the figures.

    shaken     a MONOCAB of another simulator with a random torque; the name says what else is hidden
    emps       a positioning axis, modelled without dry friction, measured; friction is smoothed over 1 or 10 mm/s
    disk       a motor with an unbalanced disk, modelled without friction, measured
    drone      an arm with a propeller, modelled with thrust and gravity only, measured
    swing      a pendulum that swings freely on its motor, measured
    silverbox  a circuit like a mass on a hardening spring, modelled without the hardening, measured
    bouc_wen   an oscillator with hysteresis, modelled without it, simulated by its authors

The folder of the records is ../shared beside the project, or that of `--shared`. Those that are not there are left out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from examples import emps, quarter_drone, unbalanced_disk
from upright.diagnosis.diagnose import Diagnosis, diagnose
from upright.estimators.identify.run import with_values
from upright.estimators.stopwatch import stopwatch
from upright.models.effects.catalogue import CATALOGUE
from upright.models.file.model_file import load_model
from upright.models.model import Model
from upright.models.parts import Disturbance
from upright.service.offline.diagnose import default_budget
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load
from upright.vehicles.file import load as vehicle
from upright.vehicles.registry import nominal_model

HERE = Path(__file__).parent
ROWS = 8192
"""Number of samples of the silverbox and of the hysteretic oscillator: 900 and 380 periods of their resonance."""


@dataclass(frozen=True, slots=True)
class Case:
    """A `model` that lacks the effects `hidden`, by their names in the catalogue if they are there, and the `record` to
    be diagnosed with it."""

    name: str
    hidden: tuple[str, ...]
    model: Model
    record: Recording
    support: float | None = None


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of a diagnosis that took `seconds`; error energy over the floor `before` and `after` the findings."""

    name: str
    hidden: str
    disturbed: bool
    verdict: str
    effects: tuple[str, ...]
    disturbance: tuple[str, ...]
    before: float
    after: float
    seconds: float

    def __str__(self) -> str:
        effects = ", ".join(self.effects) or "-"
        disturbance = "; ".join(self.disturbance) or "switched off"
        return (
            f"{self.name:32} {self.verdict:18} {effects:58} {self.before:8.3g} -> {self.after:<7.3g}"
            f"{self.seconds:6.1f} s  {disturbance}"
        )


def without(model: Model, *names: str) -> Model:
    """`model` without these effects, or without any effects if none are given."""
    for name in names or [each.name for each in model.effects]:
        model = model.remove(name)
    return model


def with_disturbance(model: Model, disturbance: Disturbance | None) -> Model:
    """`model` with this disturbance at each joint."""
    return replace(model, joints=tuple(replace(each, disturbance=disturbance) for each in model.joints))


def _monocab(data: Path) -> Iterator[Case]:
    known = vehicle("monocab")
    model = with_values(nominal_model("monocab"), known.parameters.values, known.parameters.deviations)
    for path in sorted((data / "shaken").glob("*.csv")):
        yield Case(
            f"shaken {path.stem}", _hidden_in(path.stem), model.remove("static_torque"), load(path), known.support
        )


def _hidden_in(name: str) -> tuple[str, ...]:
    """What is hidden in the record `name`, with its size left out: "cubic_stiffness_9e6"; nothing in "clean_slow"."""
    word = max((each for each in CATALOGUE if name.startswith(each)), key=len, default=name)
    return () if word.startswith("clean") else (word,)


def _emps(data: Path) -> Iterator[Case]:
    friction = ("coulomb_friction", "static_torque")
    for slope in (1e-3, 1e-2):
        model = without(emps.model(), *friction)
        model = replace(model, joints=tuple(replace(each, smooth_rate=slope) for each in model.joints))
        yield Case(f"emps {1e3 * slope:.0f} mm/s", friction, model, emps.load(data))


def _disk(data: Path) -> Iterator[Case]:
    friction = ("viscous_friction", "coulomb_friction")
    model = without(load_model(Path(unbalanced_disk.__file__).with_suffix(".toml")), *friction)
    yield Case("disk", friction, model, unbalanced_disk.load(data)[0].between(0.0, 100.0))


def _drone(data: Path) -> Iterator[Case]:
    model = without(load_model(Path(quarter_drone.__file__).with_suffix(".toml")))
    # Which kind of dry friction it has has not been published.
    yield Case("drone", ("coulomb_friction",), model, quarter_drone.load(data, "sinal4_multiseno"))


def _swing(data: Path) -> Iterator[Case]:
    folder = data.parent / "field" / "swing"
    record = load(folder / "run.csv").between(11.8)
    yield Case("swing", ("coulomb_friction",), load_model(folder / "pendulum.toml"), record)


def _silverbox(data: Path) -> Iterator[Case]:
    columns = np.genfromtxt(data / "silverbox" / "train.csv", delimiter=",", names=True, max_rows=ROWS)
    channels = ChannelTable((Channel("position", "V", "output"), Channel("input", "V", "input")))
    values = {"position": columns["output"], "input": columns["input"]}
    yield Case(
        "silverbox",
        ("cubic_stiffness",),
        load_model(HERE / "measured" / "silverbox.toml"),
        _recording(channels, columns["time"], values, "silverbox"),
    )


def _bouc_wen(data: Path) -> Iterator[Case]:
    columns = np.genfromtxt(data / "bouc_wen" / "train.csv", delimiter=",", names=True, max_rows=ROWS)
    channels = ChannelTable((Channel("displacement", "m", "of the mass"), Channel("force", "N", "on it")))
    values = {name: columns[name] for name in ("displacement", "force")}
    yield Case(
        "bouc_wen",
        ("hysteresis",),
        load_model(HERE / "measured" / "bouc_wen.toml"),
        _recording(channels, columns["time"], values, "bouc_wen"),
    )


def _recording(channels: ChannelTable, time: np.ndarray, values: dict[str, np.ndarray], name: str) -> Recording:
    return Recording(channels, np.round(time * 1e9).astype(np.int64), values, source=name)


SOURCES: dict[str, tuple[str, Callable[[Path], Iterable[Case]]]] = {
    "shaken": ("shaken", _monocab),
    "emps": ("emps", _emps),
    "disk": ("unbalanced_disk", _disk),
    "drone": ("quarter_drone", _drone),
    "swing": ("../field/swing", _swing),
    "silverbox": ("silverbox", _silverbox),
    "bouc_wen": ("bouc_wen", _bouc_wen),
}


def answered(case: Case, disturbance: Disturbance | None) -> Answer:
    """The diagnosis of a case, with this disturbance at each joint."""
    began = stopwatch()
    model, budget = with_disturbance(case.model, disturbance), default_budget([case.record])
    found = diagnose(model, [case.record], support=case.support, budget=budget)
    return _answer(case, disturbance is not None, found, stopwatch() - began)


def _answer(case: Case, disturbed: bool, found: Diagnosis, seconds: float) -> Answer:
    effects = tuple(
        each.effect + (f" (tied with {', '.join(each.tied_with)})" if each.tied_with else "") for each in found.findings
    )
    before, after = found.innovation_ratio_before, found.innovation_ratio_after
    return Answer(
        case.name,
        ", ".join(case.hidden),
        disturbed,
        str(found.verdict.value),
        effects,
        tuple(map(str, found.disturbance)),
        float("nan") if before is None else before,
        float("nan") if after is None else after,
        seconds,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"one of {', '.join(SOURCES)}; default: all")
    parser.add_argument("--shared", type=Path, default=HERE.parents[1] / "shared", help="folder of the records")
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args()
    if unknown := set(given.names) - set(SOURCES):
        parser.error(f"unknown records: {', '.join(sorted(unknown))}; known are {', '.join(SOURCES)}")
    data, answers = given.shared / "data", []
    for name in given.names or SOURCES:
        folder, cases = SOURCES[name]
        if not (data / folder).is_dir():
            print(f"{name:32} left out: no folder {data / folder}")
            continue
        for case in cases(data):
            for disturbance in (Disturbance(), None):
                answers.append(answered(case, disturbance))
                print(answers[-1], flush=True)
    if given.json:
        given.json.write_text(json.dumps([asdict(each) for each in answers], indent=1))


if __name__ == "__main__":
    main()
