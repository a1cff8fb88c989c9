"""Find and add hidden effects of the balancing robot from the command line: `python benchmarks/robot_diagnosis.py`

Each case is a virtual robot with a random torque (`--disturbance LEVEL`, 0 for none) and one hidden effect, or none,
recorded with the paper's square wave. `upright diagnose` gets the recording and the vehicle file, whose parameters are
up to 40 % off, and searches the whole catalogue at all places. `upright model add` then adds the hidden effect, with
the sine, the doublet and the sine stream held out. The program prints the verdict, the names, the amplitude beside the
plant's, and the energy of the innovations over that of the sensors' noise. For the three held-out recordings together
it prints by how much the energy of the prediction error falls at several horizons, each model with the filter that was
fitted with it, and to which multiple of the energy due to the noise stated in the model. For each of them it then
prints the fall in `upright compare`, whose filter uses the stated noise of sensors and process and no model's errors.
A delay and backlash are recorded with a softer controller (docs/how-to/diagnose-the-robot.md).

With `--live` every effect that the virtual robot can have is hidden in turn, and none, and the findings of the live
diagnosis at the end of the square wave are printed. With `--closed-loop` the true parameters are simulated in closed
loop with the robot's controller through the square wave, and the error is printed in multiples of the error due to
noise alone.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from upright.diagnosis.prediction.compare import compare
from upright.estimators.stopwatch import stopwatch
from upright.models.library import get
from upright.service.offline.inputs.replay import live_diagnosis
from upright.service.virtual.run import record
from upright.simulation.twsbr.hidden import TWSBR_HIDDEN
from upright.simulation.twsbr.truth import TwsbrTruth
from upright.telemetry.storage import save
from upright.vehicles.file import load
from upright.vehicles.registry import recorded_loop

OTHERS = ("sine", "doublet", "sine_stream")
FURTHEST = 0.5
"""s ahead: beyond that, the errors that the unstable robot has amplified say nothing about a model."""
CHANNELS = ("tilt", "tilt_rate", "left_wheel_angle")
SOFTER = {"proportional_gain = 25.0": "proportional_gain = 10.0", "derivative_gain = 3.5 ": "derivative_gain = 0.7 "}


@dataclass(frozen=True, slots=True)
class Case:
    """`hide` as for `upright simulate`; `names` are the right answers of a diagnosis, the first of which is added;
    `size` is the first parameter of the effect in the plant."""

    hide: str
    names: tuple[str, ...]
    size: float = 0.0
    softer: bool = False


CASES = {
    "nothing": Case("", ()),
    "centre of mass 1.4 mm ahead": Case("static_torque", ("static_torque", "sensor_offset"), 0.01),
    "IMU 0.5 deg askew": Case("sensor_offset", ("sensor_offset", "static_torque"), 8.7e-3),
    # -(m_b + 2 m_w) g r sin
    "slope of 2 deg": Case("slope", ("static_torque@travel",), -9.3e-3),
    "dead zone": Case("input_deadband", ("input_deadband",), 0.6),
    # both gears together
    "dry friction of the gears": Case("coulomb_friction", ("coulomb_friction@wheels",), 0.02),
    "nothing, softer": Case("", (), softer=True),
    "delay of 5 ms, softer": Case("input_delay", ("input_delay",), 5e-3, softer=True),
    "backlash of 1 mrad, softer": Case("backlash", ("backlash",), 1e-3, softer=True),
    "backlash of 0.5 mrad, softer": Case("backlash=0.5", ("backlash",), 0.5e-3, softer=True),
}


def upright(*arguments: object) -> dict[str, Any]:
    """The document that a command prints with `--json`."""
    command = [str(Path(sys.executable).with_name("upright")), *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
    return dict(json.loads(done.stdout))


def vehicle(folder: Path, softer: bool) -> Path:
    """Write the shipped vehicle file, or one with a softer controller."""
    text = (resources.files("upright.vehicles") / "twsbr" / "vehicle.toml").read_text(encoding="utf-8")
    for old, new in SOFTER.items() if softer else ():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    path = folder / "vehicle.toml"
    path.write_text(text, encoding="utf-8")
    return path


def hidden(name: str, level: float) -> list[str]:
    """The argument `hide` of `record` for the effect `name`, or none, with a random torque of that `level`."""
    return [each for each in (name, f"disturbance={level:g}" if level else "") if each]


def tried(case: Case, seed: int, level: float, candidates: list[str], named: bool, budget: float | None) -> list[str]:
    """The results of a case, as lines; only those of the diagnosis if `named`. `budget` of the diagnosis in s."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        file = vehicle(folder, case.softer)

        def recorded(experiment: str) -> Path:
            path = folder / f"{experiment}.arrow"
            save(record(load(str(file)), experiment, hide=hidden(case.hide, level), seed=seed), path)
            return path

        square = recorded("square")
        looked_for = [word for each in candidates for word in ("--effect", each)]
        if budget is not None:
            looked_for += ["--budget", f"{budget:g}"]
        begun = stopwatch()
        found = upright("diagnose", square, "--vehicle", file, *looked_for)
        lines = [f"{diagnosed(case, found)}, {stopwatch() - begun:.0f} s"]
        if case.names and not named:
            effect, _, place = case.names[0].partition("@")
            at = ["--at", place] if place else []
            held_out = [word for each in OTHERS for word in ("--held-out", recorded(each))]
            command = ["model", "add", "twsbr", effect, *at, "--vehicle", file, "--output", folder / "repaired.toml"]
            answer = upright(*command, "--recording", square, *held_out)
            lines += added(answer["repair"])
            before, after = folder / "before.json", folder / "repaired.toml"
            before.write_text(json.dumps(answer), encoding="utf-8")
            for each in OTHERS:
                found = upright("compare", recorded(each), "--vehicle", file, "--model", before, "--model", after)
                lines += compared(each, found["models"][-2:])
        return lines


def diagnosed(case: Case, found: dict[str, Any]) -> str:
    names = [(each["effect"], *each["tied_with"]) for each in found["findings"]]
    right = found["verdict"] == "adequate" if not case.names else bool(names) and case.names[0] in names[0]
    texts = [found["verdict"], "; ".join(" = ".join(each) for each in names)]
    for each in found["findings"]:
        if each["effect"] in case.names:
            size = next(iter(each["parameters"].values()))
            value, std = (float("nan") if size[key] is None else size[key] for key in ("value", "std"))
            texts.append(f"{value:.4g} ± {std:.2g} {size['unit']} for {case.size:g}")
    for joint, each in found["disturbance"].items():
        if each["shown"]:
            texts.append(f"{each['rms']:.2g} ± {each['rms_std']:.1g} {each['unit']} RMS at {joint}")
    if found["innovation_ratio_before"] is not None:
        texts.append(f"{found['innovation_ratio_before']:.3g} to {found['innovation_ratio_after']:.3g} times the noise")
    return f"{'right' if right else 'WRONG'}  " + ", ".join(each for each in texts if each)


def added(revision: dict[str, Any]) -> list[str]:
    """The fall of the held-out error's energy by channel and horizon, and its multiple of the noise's energy."""
    lines = [f"       added, t-ratio {revision['surety']:.3g}: {'needed' if revision['needed'] else 'NOT needed'}"]
    before, after, floor = revision["before"]["held_out"], revision["after"]["held_out"], revision["floor"]["held_out"]
    for channel in CHANNELS:
        texts = [
            f"{ahead:g} s: by {100.0 * (1.0 - (new / old) ** 2):.3g} % to {(new / least) ** 2:.2g}"
            for ahead, old, new, least in zip(
                revision["horizons"], before[channel], after[channel], floor[channel], strict=True
            )
        ]
        lines.append(f"       {channel:17}{', '.join(texts)}")
    return lines


def compared(experiment: str, models: Sequence[dict[str, Any]]) -> list[str]:
    """The fall of the error's energy from the first of two models to the second, by channel and horizon."""
    lines = []
    for channel in CHANNELS:
        texts = [
            f"{old['horizon']:g} s: by {100.0 * (1.0 - (new['rmse'][channel] / old['rmse'][channel]) ** 2):.3g} %"
            for old, new in zip(*(each["by_horizon"] for each in models), strict=True)
            if old["horizon"] <= FURTHEST
        ]
        lines.append(f"       {experiment:12}{channel:17}{', '.join(texts)}")
    return lines


def while_it_runs(name: str, seed: int, level: float) -> str:
    """The names of the live diagnosis at the end of a square wave with the effect `name`; empty if there are none."""
    file = load("twsbr")
    found = live_diagnosis(record("twsbr", "square", hide=hidden(name, level), seed=seed), file) or {}
    return "; ".join(" = ".join((each["effect"], *each["tied_with"])) for each in found.get("findings", ()))


def in_the_loop(name: str, seed: int, level: float) -> str:
    """Error of the true parameters without the effect `name` in closed loop, in multiples of that by noise alone."""
    file, right = load("twsbr"), get("twsbr").change(TwsbrTruth().table_1)
    recording = record("twsbr", "square", hide=hidden(name, level), seed=seed)
    (found,) = compare({"": right}, [recording], support=file.support, loops=[recorded_loop(file, recording)])
    loop = found.closed_loop
    return loop.reason or ", ".join(f"{each} {loop.over_floor(each):.2g}" for each in ("tilt", "left_wheel_angle"))


def of_each(result: Callable[[str, int, float], str], seeds: Sequence[int], level: float, processes: int) -> None:
    """Print the `result` for the robot with each effect that it can hide, and with none."""
    cases = [(name, seed, level) for name in ("", *TWSBR_HIDDEN) for seed in seeds]
    with ProcessPoolExecutor(processes) as pool:
        for (name, *_), text in zip(cases, pool.map(result, *zip(*cases, strict=True)), strict=True):
            print(f"{name or 'nothing':26}{text or 'no name'}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--runs", type=int, default=1, help="runs per case, with consecutive seeds")
    parser.add_argument("--case", action="append", choices=list(CASES), help="may be given several times; default: all")
    parser.add_argument("--effect", action="append", default=[], help="to look for; default: all effects")
    parser.add_argument("--budget", type=float, metavar="SECONDS", help="of a diagnosis; default: its own")
    parser.add_argument("--named", action="store_true", help="only diagnose, do not add the effect")
    parser.add_argument("--disturbance", type=float, default=1.0, metavar="LEVEL", help="of the random torque; 0: none")
    parser.add_argument("--live", action="store_true", help="names of the live diagnosis for each effect")
    parser.add_argument("--closed-loop", action="store_true", help="error of the true parameters in closed loop")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    for result, wanted in ((while_it_runs, arguments.live), (in_the_loop, arguments.closed_loop)):
        if wanted:
            of_each(result, seeds, arguments.disturbance, arguments.processes)
    if arguments.live or arguments.closed_loop:
        return
    cases = [(name, seed) for name in arguments.case or CASES for seed in seeds]
    with ThreadPoolExecutor(arguments.processes) as pool:
        options = (arguments.disturbance, arguments.effect, arguments.named, arguments.budget)
        results = pool.map(lambda each: tried(CASES[each[0]], each[1], *options), cases)
        for (name, seed), lines in zip(cases, results, strict=True):
            print(f"{name}, seed {seed}", *lines, sep="\n", flush=True)


if __name__ == "__main__":
    main()
