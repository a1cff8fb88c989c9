"""How much work is a diagnosis in this build, and in another one? `python benchmarks/before_and_after.py --other TREE`

`upright diagnose RECORDING --budget inf` of two records of the virtual MONOCAB, a minute each at 200 Hz: a sine sweep
with viscous friction hidden, and a shaken multisine with dry friction and a cubic stiffness; and of the square wave of
the virtual robot, shaken, on a slope. The program prints the names that were found, the CPU seconds without the start
of Python, and the number of

    fits      of a model with its noise
    passes    over a segment of data
    attach    effects attached to a model
    compile   kernels of a model, nearly all of which are in memory already

TREE is a checkout of another build (`git worktree add TREE COMMIT`). The builds take turns, each in a process of its
own, once to compile and then `--times` times; of these the fastest counts. `--times 0` counts the compilation.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import os
import pkgutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

RECORDS: Mapping[str, tuple[str, str, tuple[str, ...]]] = {
    "viscous friction": ("monocab", "sweep", ("viscous_friction", "disturbance=0")),
    "two effects, shaken": ("monocab", "multisine", ("coulomb_friction", "cubic_stiffness", "disturbance=5,0.3")),
    "robot on a slope": ("twsbr", "square", ("slope", "disturbance=1")),
}
"""Vehicle, experiment, and what is hidden."""
SEED = 9
"""Of all recordings. No setting was chosen on them."""
COUNTED = {
    "fits": ("estimators", "fit"),
    "attach": ("models", "attach"),
    "compile": ("models", "compile_model"),
}
"""Package and name of the functions that are counted; passes are calls of `Kernel.run`."""
PACKAGES = ("models", "estimators", "diagnosis", "service")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--other", type=Path, help="a checkout of the build to compare with")
    parser.add_argument("--times", type=int, default=2, help="measured diagnoses of each record and build")
    parser.add_argument("--only", choices=RECORDS, help="this record alone")
    parser.add_argument("--count", nargs=2, metavar=("VEHICLE", "RECORDING"), help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.count:
        print(json.dumps(counted(*chosen.count)))
        return
    trees = {"this build": Path(__file__).resolve().parents[1]}
    if chosen.other:
        trees["the other"] = chosen.other.resolve()
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, (vehicle, experiment, hidden)) in enumerate(RECORDS.items()):
            if chosen.only in (None, name):
                recording = Path(folder) / f"{number}.arrow"
                make(recording, vehicle, experiment, hidden)
                show(name, taken_in_turn(trees, vehicle, recording, chosen.times))


def make(path: Path, vehicle: str, experiment: str, hidden: Sequence[str]) -> None:
    """Write a recording: of the MONOCAB a minute of free motion, of the robot the whole experiment."""
    from benchmarks.diagnosing import minute
    from upright.service.virtual.run import record
    from upright.telemetry.storage import save

    recording = minute(experiment, hidden, SEED) if vehicle == "monocab" else None
    save(recording or record(vehicle, experiment, hide=list(hidden), seed=SEED), path)


def taken_in_turn(trees: Mapping[str, Path], vehicle: str, recording: Path, times: int) -> dict[str, dict[str, Any]]:
    """The counts of each build, with its least seconds."""
    best: dict[str, dict[str, Any]] = {}
    for _ in range(1 + times):
        for name, tree in trees.items():
            command = [sys.executable, __file__, "--count", vehicle, str(recording)]
            done = subprocess.run(
                command, env={**os.environ, "PYTHONPATH": str(tree)}, cwd=tree, capture_output=True, text=True
            )
            if done.returncode:
                sys.exit(f"{name}: {done.stderr[-2000:]}")
            one = json.loads(done.stdout)
            best[name] = min(one, best.get(name, one), key=lambda each: each["seconds"])
    return best


def show(name: str, found: Mapping[str, dict[str, Any]]) -> None:
    print(f"{name}\n  {'':12s} {'fits':>6s} {'passes':>7s} {'attach':>7s} {'compile':>8s} {'seconds':>8s}  found")
    for build, one in found.items():
        numbers = f"{one['fits']:6d} {one['passes']:7d} {one['attach']:7d} {one['compile']:8d} {one['seconds']:8.1f}"
        print(f"  {build:12s} {numbers}  {', '.join(one['found'])}")
    if len(found) == 2:
        this, other = found.values()
        print(f"  the other takes {other['seconds'] / this['seconds']:.2f} times as long")


def counted(vehicle: str, recording: str) -> dict[str, Any]:
    """One diagnosis on the command line of the build in the current folder, with its counts."""
    within = "upright." if Path("upright/service").exists() else ""  # builds before the folders were upright's packages
    app = importlib.import_module(f"{within}service.cli").app
    for package in [f"{within}{each}" for each in PACKAGES[:-1]]:
        for each in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            importlib.import_module(each.name)
    counts = Counter(dict.fromkeys((*COUNTED, "passes"), 0))
    for key, (package, name) in COUNTED.items():
        _wrap(within, package, name, key, counts)
    kernel = next(
        m.Kernel for n, m in sys.modules.items() if n.startswith(f"{within}models.") and n.endswith(".kernel")
    )
    kernel.run = _counting(kernel.run, "passes", counts)
    text, begun = io.StringIO(), time.process_time()
    with contextlib.redirect_stdout(text):
        app(["diagnose", recording, "--vehicle", vehicle, "--budget", "inf", "--json"], standalone_mode=False)
    seconds = time.process_time() - begun
    names = [each["effect"] for each in json.loads(text.getvalue())["findings"]]
    return {**counts, "seconds": seconds, "found": names}


def _counting(function: Callable[..., Any], key: str, counts: Counter[str]) -> Callable[..., Any]:
    def called(*arguments: Any, **named: Any) -> Any:
        counts[key] += 1
        return function(*arguments, **named)

    return called


def _wrap(within: str, package: str, name: str, key: str, counts: Counter[str]) -> None:
    """Count the calls of every function `name` that is defined in `package`, wherever it is imported."""
    ours = tuple(f"{within}{each}." for each in PACKAGES)
    modules = [module for each, module in sys.modules.items() if f"{each}.".startswith(ours)]
    defined = {vars(module).get(name) for module in modules}
    for function in [each for each in defined if callable(each) and each.__module__.startswith(f"{within}{package}.")]:
        wrapped = _counting(function, key, counts)
        for module in modules:
            for attribute in [one for one, value in vars(module).items() if value is function]:
                setattr(module, attribute, wrapped)


if __name__ == "__main__":
    main()
