"""What does the diagnosis decide, and by which numbers? A regression test of some 300 cases for changes of its code.

    python benchmarks/decisions.py record TABLE     diagnose every case and write the decisions: an hour or two
    python benchmarks/decisions.py replay [TABLE]   decide again from the numbers in the table, in seconds
    python benchmarks/decisions.py diff OLD NEW     cases whose verdict or names differ
    python benchmarks/decisions.py summary [TABLE]  right names, false names, unknown and adequate, by class

The cases are records of both vehicles with nothing missing, with one effect, with two, or with one that is not in the
catalogue, with and without a random disturbance; records of a MONOCAB of another simulator; bodies that swing freely;
and the measured records in ../shared, if they are there. A case is defined by its name. There is no time limit: each
diagnosis takes as long as it needs. A table has one line of JSON per case, compressed if the file's name ends in .xz:
the verdict, the names, and for every effect that was fitted the numbers that decided about it (diagnosis.gates.Tried)
and the reason why it was rejected.

`record` resumes where it was interrupted. `--only WORDS` takes the cases whose name contains one of these, `--every N`
each N-th of them.
"""

from __future__ import annotations

import argparse
import json
import lzma
import os
import tempfile
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

from benchmarks import free_decays, measured_verdicts, others_recordings
from upright.diagnosis.diagnose import Diagnosis, Verdict, diagnose
from upright.diagnosis.gates import HeldOut, Round, Tried, decide, gated, tie
from upright.diagnosis.parts import diagnose_parts
from upright.models.effect import Effect, Family
from upright.models.effects.catalogue import CATALOGUE
from upright.models.model import Model
from upright.service.hidden_effects.cases import pairs
from upright.service.hidden_effects.vehicles import drawn
from upright.service.virtual.run import record
from upright.simulation.monocab.hidden import HIDDEN, UNLISTED
from upright.simulation.twsbr.hidden import TWSBR_HIDDEN, TWSBR_UNLISTED
from upright.telemetry import storage
from upright.telemetry.clock import with_regular_times
from upright.telemetry.errors import UprightError
from upright.vehicles import registry
from upright.vehicles.file import load

HERE = Path(__file__).parent
KEPT = HERE / "decisions.jsonl.xz"
"""The table in the repository, which `replay` and `summary` read by default."""
SHARED = HERE.parents[1] / "shared"
Line = dict[str, Any]

SEED = 300
"""Seed of all cases. No setting of the diagnosis was chosen with it."""
SHAKEN = "disturbance=5,0.3"
"""N m RMS and s: the middle of the range drawn from in `upright benchmark hidden-effects`."""
LOUDER = 4.0
"""Factor on the level of a hidden effect if a disturbance acts: 30 s show that much less there
(docs/measurements/diagnosis.md, while the vehicle runs)."""
LEVELS: Mapping[str, float] = {
    "static_torque": -0.027,
    "viscous_friction": 0.062,
    "coulomb_friction": 0.018,
    "stribeck_friction": 0.080,
    "load_dependent_friction": 0.0097,
    "asymmetric_friction": 0.081,
    "quadratic_drag": 0.046,
    "cubic_stiffness": 0.061,
    "end_stop": 0.0045,
    "hysteresis": 0.018,
    "position_cogging": 0.037,
    "periodic_disturbance": 0.018,
    "torque_step": 0.0081,
    "torque_drift": -0.14,
    "gimbal_angle_coupling": 0.24,
    "flexible_mode": 0.030,
    "gimbal_imbalance": 0.39,
    "input_deadband": 0.012,
    "input_delay": 1.0,
    "backlash": 0.005,
    "actuator_lag": 0.62,
    "input_asymmetry": 0.00086,
    "sensor_offset": -0.026,
    "input_gain": -0.020,
    "sensor_delay": 1.55,
    "sensor_lag": 0.19,
    "sensor_scale": -1.2,
    "test_cubic_drag": -0.029,
    "test_one_sided_damping": -0.023,
    "test_varying_stiffness": 0.037,
    "test_patchy_damping": 0.11,
}
"""Twice the minimum detectable effect of 30 s of multisine without a disturbance, as levels of the virtual MONOCAB's
effects: those of `upright benchmark hidden-effects --sizes 2 --excitations multisine --seeds 1 --first 66
--disturbance none`."""


@dataclass(frozen=True, slots=True)
class Case:
    """`hidden`: names of the effects that the model lacks; `unlisted`: the catalogue does not have them. `diagnosed`
    simulates or reads the record and diagnoses it."""

    name: str
    hidden: tuple[str, ...]
    unlisted: bool
    diagnosed: Callable[[], Diagnosis]


def cases() -> Iterator[Case]:
    """All cases, class by class. Those whose records are not there are left out."""
    yield from _monocabs()
    yield from _robots()
    yield from _of_others()
    yield from _swings()
    yield from _measured()


def _monocabs() -> Iterator[Case]:
    for shaken in (False, True):
        how, factor = ("shaken", LOUDER) if shaken else ("still", 1.0)
        for number in range(10):
            yield _monocab(f"monocab {how} nothing {number}", {}, shaken, SEED + number)
        listed = [name for name in LEVELS if name in HIDDEN]
        for names in [*((name,) for name in LEVELS), *pairs(listed, SEED)]:
            levels = {name: factor * LEVELS[name] for name in names}
            yield _monocab(f"monocab {how} {'+'.join(names)}", levels, shaken, SEED)
        for name in listed:
            yield _monocab(f"monocab {how} {name} of the demo", {name: DEMO.get(name, 1.0)}, shaken, SEED + 1)


def bare(model: Model) -> Model:
    """`model` without the effects that identification assumes: the diagnosis has to find these."""
    for each in model.effects:
        model = model.remove(each.name)
    return model


DEMO: Mapping[str, float] = {"backlash": 0.02, "load_dependent_friction": 0.05, "gyro_bias": 1.0}
"""Levels of effects that stop the vehicle at the level of the demo."""


def _monocab(name: str, levels: Mapping[str, float], shaken: bool, seed: int) -> Case:
    def diagnosed() -> Diagnosis:
        vehicle, known = drawn(seed), load("monocab")
        hide = [*(f"{each}={level:g}" for each, level in levels.items()), *([SHAKEN] if shaken else [])]
        run = record(vehicle.file, "multisine", hide=hide, seed=seed, duration=30.0, configure=vehicle.configured)
        models = registry.models_of(known)
        return diagnose_parts(bare(models.nominal), models.actuators, [run], support=known.support)

    return Case(name, tuple(levels), any(each in UNLISTED for each in levels), diagnosed)


AS_NAMED: Mapping[str, str] = {"slope": "static_torque@travel"}
"""The catalogue's name of an effect of the virtual robot, if it differs."""


def _robots() -> Iterator[Case]:
    for level in (0.0, 1.0):
        how = "shaken" if level else "still"
        for number in range(5):
            yield _robot(f"robot {how} nothing {number}", "", level, SEED + number)
        for name in (*TWSBR_HIDDEN, *TWSBR_UNLISTED):
            yield _robot(f"robot {how} {name}", name, level, SEED)


def _robot(name: str, hidden: str, level: float, seed: int) -> Case:
    def diagnosed() -> Diagnosis:
        known = load("twsbr")
        hide = [each for each in (hidden, f"disturbance={level:g}" if level else "") if each]
        model = bare(registry.models_of(known).nominal)
        return diagnose(model, [record("twsbr", "square", hide=hide, seed=seed)], support=known.support)

    names = (AS_NAMED.get(hidden, hidden),) if hidden else ()
    return Case(name, names, hidden in TWSBR_UNLISTED, diagnosed)


def _of_others() -> Iterator[Case]:
    listed = {others_recordings.CLEAN: {}, **others_recordings.EFFECTS}
    for name, how in {**listed, **others_recordings.UNLISTED}.items():
        hidden = () if name == others_recordings.CLEAN else (name,)
        yield Case(f"others {name}", hidden, name in others_recordings.UNLISTED, _others_diagnosed(how))


def _others_diagnosed(how: Mapping[str, Any]) -> Callable[[], Diagnosis]:
    def diagnosed() -> Diagnosis:
        known = load("monocab")
        with tempfile.TemporaryDirectory() as folder:
            vehicle = others_recordings.OthersVehicle(rate=200, noise=5.0, sweep=False, seed=SEED, **how)
            run = with_regular_times(storage.load(vehicle.write(Path(folder) / "table.csv")))
        models = registry.models_of(known)
        return diagnose_parts(bare(models.nominal), models.actuators, [run], support=known.support)

    return diagnosed


def _swings() -> Iterator[Case]:
    for name, swing in free_decays.SWINGS.items():
        sizes = {"coulomb_friction": swing.body.dry, "viscous_friction": swing.body.viscous}
        hidden = tuple(each for each, size in sizes.items() if size)
        yield Case(f"swing {name}", hidden, False, _swing_diagnosed(swing))


def _swing_diagnosed(swing: free_decays.Swing) -> Callable[[], Diagnosis]:
    return lambda: diagnose(swing.body.model(swing.noise, swing.force), [swing.seen(swing.body)])


def _measured() -> Iterator[Case]:
    for folder, found in measured_verdicts.SOURCES.values():
        if (SHARED / "data" / folder).is_dir():
            for case in found(SHARED / "data"):
                unlisted = any(name not in CATALOGUE for name in case.hidden)
                yield Case(f"measured {case.name}", case.hidden, unlisted, _measured_diagnosed(case))


def _measured_diagnosed(case: measured_verdicts.Case) -> Callable[[], Diagnosis]:
    return lambda: diagnose(case.model, [case.record], support=case.support)


def line_of(case: Case) -> Line:
    """The result of a case, or the reason if it cannot be recorded or diagnosed."""
    about: Line = {"case": case.name, "hidden": list(case.hidden), "unlisted": case.unlisted}
    try:
        found = case.diagnosed()
    except (UprightError, ArithmeticError) as error:
        return {**about, "verdict": "failed", "reason": str(error), "named": [], "rounds": []}
    rounds = [each for part in (found.parts or (found,)) for each in part.rounds]
    return {
        **about,
        "verdict": found.verdict.value,
        "named": [[each.effect, *each.tied_with] for each in found.findings],
        "sizes": {
            name: [size.value, size.std]
            for each in found.findings
            for name, size in each.parameters.items()
            if size.value is not None and size.std is not None
        },
        "ratios": [found.innovation_ratio_before, found.innovation_ratio_after],
        "rounds": [_round_line(each) for each in rounds],
    }


def _round_line(decided: Round) -> Line:
    return {
        "beside": list(decided.beside),
        "tries": decided.tries,
        "p_value": decided.p_value,
        "named": decided.named,
        "tied_with": list(decided.tied_with),
        "covered": decided.covered,
        "given": decided.given,
        "tried": [_tried_line(each) for each in decided.tried],
    }


def _tried_line(tried: Tried) -> Line:
    """The numbers of `tried`. The effect itself is left out: its name identifies it."""
    own = {name: getattr(tried, name) for name in Tried.__slots__ if name not in ("effect", "held_out")}
    return {**own, "held_out": asdict(tried.held_out) if tried.held_out else None}


def _short(value: Any) -> Any:
    """`value` with numbers rounded to six significant digits."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, dict):
        return {key: _short(each) for key, each in value.items()}
    return [_short(each) for each in value] if isinstance(value, list | tuple) else value


def read_table(path: Path) -> dict[str, Line]:
    """The lines of a table by case."""
    with lzma.open(path, "rt", encoding="utf-8") if path.suffix == ".xz" else path.open(encoding="utf-8") as file:
        return {line["case"]: line for line in map(json.loads, file)}


def _round_of(line: Mapping[str, Any]) -> Round:
    """The round of `line` before anything was decided."""
    tried = tuple(gated(_tried_of(each), line["tries"]) for each in line["tried"])
    return Round(tuple(line["beside"]), line["tries"], tried, line["p_value"])


def _tried_of(line: Mapping[str, Any]) -> Tried:
    own = {name: line[name] for name in Tried.__slots__ if name in line and name not in ("held_out", "refused")}
    held_out = HeldOut(**line["held_out"]) if line["held_out"] else None
    effect = CATALOGUE.get(line["name"].partition("@")[0]) or _without_kin(line["name"])
    usual = tuple(line["usual"]) if line["usual"] else None
    return Tried(effect=effect, held_out=held_out, **{**own, "usual": usual})


def _without_kin(name: str) -> Effect:
    """An effect that is not in the catalogue and is not declared confusable with any other."""
    return replace(next(iter(CATALOGUE.values())), name=name, family=Family.STRUCTURE, confused_with=())


def decided_again(line: Line) -> list[tuple[str, str]]:
    """Rounds of a case that the current code decides differently from its line, and how."""
    found = []
    for each in line["rounds"]:
        again, lacking = _again(each)
        before, now = [each["named"], *each["tied_with"]], [again.named, *again.tied_with]
        if before != now or lacking:
            beside = " beside " + " and ".join(each["beside"]) if each["beside"] else ""
            change = f"{' = '.join(before) or 'none'} is now {' = '.join(now) or 'none'}"
            needs = f", and needs held-out data about {', '.join(lacking)}" if lacking else ""
            found.append((line["case"] + beside, change + needs))
    return found


def _again(line: Line) -> tuple[Round, list[str]]:
    """The round of `line` decided now, and the effects whose held-out results it needs but `line` does not have."""
    known = {each["name"]: each for each in line["tried"]}
    lacking: list[str] = []

    def on_held_out(best: Tried) -> Tried:
        then = known[best.name]
        if then["held_out"] is None and not then["refused"] and best.name != line["named"]:
            lacking.append(best.name)
        return best

    undecided = _round_of(line)
    if line.get("given"):
        return tie(replace(undecided, named=line["named"]), lambda other: None), lacking
    return decide(undecided, on_held_out, lambda other: other.in_usual_shape), lacking


def kind_of(line: Line) -> str:
    """The kind among which a case is counted."""
    group = line["case"].split(" ")[0]
    how = " ".join(word for word in ("still", "shaken") if f" {word} " in line["case"])
    count = "unlisted" if line["unlisted"] else ("nothing", "one", "two")[min(2, len(line["hidden"]))]
    return " ".join(filter(None, (group, how, count)))


def right(line: Line) -> bool:
    """Whether all hidden effects are named; a single one has to be the first, alone or tied with one other. With an
    effect outside the catalogue, `unknown` is right; with nothing hidden, `adequate` is."""
    names = [set(each) for each in line["named"]]
    if line["unlisted"]:
        return bool(line["verdict"] == Verdict.UNKNOWN.value)
    if not line["hidden"]:
        return bool(line["verdict"] == Verdict.ADEQUATE.value)
    if len(line["hidden"]) == 1:
        return bool(names) and line["hidden"][0] in names[0] and len(names[0]) <= 2
    return all(any(hidden in each for each in names) for hidden in line["hidden"])


def false_names(line: Line) -> int:
    """Number of findings that name no hidden effect. For a hidden effect outside the catalogue every name is false."""
    hidden = set() if line["unlisted"] else set(line["hidden"])
    missing = line["verdict"] == Verdict.MISSING_EFFECT.value
    return sum(not hidden & set(each) for each in line["named"]) if missing or not line["unlisted"] else 0


def summary(lines: Iterable[Line]) -> Iterator[str]:
    """A line for each kind of case."""
    kinds: dict[str, list[Line]] = {}
    for line in lines:
        kinds.setdefault(kind_of(line), []).append(line)
    for kind, each in kinds.items():
        verdicts = ", ".join(f"{count} {name}" for name, count in Counter(one["verdict"] for one in each).most_common())
        good, false = sum(map(right, each)), sum(map(false_names, each))
        yield f"{kind:26} right {good:3} of {len(each):3}, false names {false:2}; {verdicts}"


def difference(old: Mapping[str, Line], new: Mapping[str, Line]) -> Iterator[str]:
    """The differences between two tables, a line per case."""
    for name in old:
        if name not in new:
            yield f"{name}: only in the old table"
            continue
        one, other = old[name], new[name]
        before, now = (f"{each['verdict']} {_names(each)}" for each in (one, other))
        if before != now:
            hidden = " and ".join(one["hidden"]) or "nothing"
            change = {(True, False): "WORSE", (False, True): "better"}.get((right(one), right(other)), "other")
            yield f"{change:6} {name} (hides {hidden}): {before.strip()} -> {now.strip()}"
    yield from (f"{name}: only in the new table" for name in new if name not in old)


def _names(line: Line) -> str:
    return "; ".join(" = ".join(each) for each in line["named"])


def recorded(path: Path, words: Sequence[str], every: int, processes: int) -> None:
    """Write the table of the cases whose name contains one of `words`, the first and each `every`-th after it. Cases in
    `path`.part are taken from there."""
    part = path.with_name(f"{path.name}.part")
    done = read_table(part) if part.exists() else {}
    names = [each.name for each in cases() if not words or any(word in each.name for word in words)][::every]
    left = [name for name in names if name not in done]
    path.parent.mkdir(parents=True, exist_ok=True)
    # An executor with max_tasks_per_child may wait for ever for workers that have ended (python/cpython 115634).
    with get_context("spawn").Pool(processes, maxtasksperchild=20) as pool, part.open("a", encoding="utf-8") as file:
        for number, line in enumerate(pool.imap_unordered(_line_of, left), start=1):
            done[line["case"]] = line
            file.write(json.dumps(line) + "\n")
            file.flush()
            print(f"{number:4} of {len(left)}  {line['case']:60} {line['verdict']:16} {_names(line)}", flush=True)
    with lzma.open(path, "wt", encoding="utf-8") if path.suffix == ".xz" else path.open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(done[name], separators=(",", ":")) + "\n" for name in names)
    part.unlink()


def _line_of(name: str) -> Line:
    found: Line = _short(line_of(next(each for each in cases() if each.name == name)))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    for verb in ("record", "replay", "summary"):
        one = verbs.add_parser(verb)
        one.add_argument("table", type=Path, **({} if verb == "record" else {"nargs": "?", "default": KEPT}))
        if verb == "record":
            one.add_argument(
                "--only", nargs="*", default=[], metavar="WORD", help="only cases whose name contains one of these"
            )
            one.add_argument("--every", type=int, default=1, metavar="N", help="the first case and each N-th after it")
            one.add_argument("--processes", type=int, default=2)
    two = verbs.add_parser("diff")
    two.add_argument("old", type=Path)
    two.add_argument("new", type=Path)
    given = parser.parse_args()
    if given.verb == "record":
        recorded(given.table, given.only, given.every, given.processes)
    elif given.verb == "replay":
        table = read_table(given.table)
        others = [each for line in table.values() for each in decided_again(line)]
        rounds = sum(len(line["rounds"]) for line in table.values())
        print(*(f"{name}: {how}" for name, how in others), sep="\n")
        print(f"{len(others)} of {rounds} rounds of {len(table)} cases are decided differently")
    elif given.verb == "summary":
        print(*summary(read_table(given.table).values()), sep="\n")
    else:
        print(*difference(read_table(given.old), read_table(given.new)), sep="\n")


if __name__ == "__main__":
    main()
