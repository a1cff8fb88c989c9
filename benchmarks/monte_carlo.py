"""Are an estimator, its variance and its intervals unbiased? `python benchmarks/monte_carlo.py`

Many runs of one experiment on the virtual vehicle, each with other sensor noise, are fitted with every --method. The
virtual vehicle is independent of the models: it has its own integrator with a ten times finer step, sin(roll),
quantised encoders and the gimbals' speed loops, and the estimators get the real roll filter's output for a noisy IMU.
The program prints for each parameter:

    bias               mean of the estimates minus the truth; beside it in standard errors of that mean
    variance ratio     variance of the estimates over the mean variance that the method reports. For a
                       maximum-likelihood method this is the Cramer-Rao bound at the estimate: 1 is efficient with a
                       correct variance; above 1 the reported variance is too small. In brackets its 95 % interval
                       (chi squared)
    coverage           share of the runs whose 95 % interval contains the truth; in brackets the binomial interval

The parameters that are not estimated, angular momentum and trim mass, are known exactly here: their uncertainty would
increase the reported variance but not the scatter. Fits start from the vehicle file's CAD values.
With --keep the recordings stay in that folder, and a second run only fits.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy import stats

from upright.service.virtual.run import record
from upright.simulation.monocab.truth import PlantTruth
from upright.telemetry.storage import load as load_recording
from upright.telemetry.storage import save
from upright.vehicles.file import load

METHODS = ("prediction_error", "output_error", "least_squares", "instrumental_variables")
PEERS = ("recursive_least_squares", "recursive_instrumental_variables")
DEFAULT_METHODS = ("prediction_error", "recursive_least_squares")
CONFIDENCE = 0.95

PLANT = PlantTruth()
TRUTH = {
    "inertia": PLANT.inertia,
    "gravity_stiffness": PLANT.gravity_stiffness,
    "static_torque.torque": 0.0,
    "static_torque": 0.0,
}
"""By the names that the methods report. Other parameters are nuisances and have no true value."""
EXACT = {
    "angular_momentum": PLANT.angular_momentum,
    "trim_mass": PLANT.trim_mass,
    "trim_height": PLANT.trim_height,
}


@dataclass(frozen=True, slots=True)
class Fit:
    """One method on one recording: `values` maps estimated parameters to (value, std); `reason` if it failed."""

    seed: int
    values: Mapping[str, tuple[float, float]]
    reason: str
    seconds: float


@dataclass(frozen=True, slots=True)
class Summary:
    """One parameter over all runs; see the module. Intervals are (low, high). None if there is no true value."""

    parameter: str
    runs: int
    truth: float | None
    mean: float
    bias: float | None
    bias_percent: float | None
    bias_in_standard_errors: float | None
    std: float
    reported_std: float
    variance_ratio: float
    variance_ratio_interval: tuple[float, float]
    coverage: float | None
    coverage_interval: tuple[float, float] | None


def main() -> None:
    arguments = _arguments()
    console = Console(width=None if sys.stdout.isatty() else 150)
    with TemporaryDirectory() as temporary:
        folder = Path(arguments.keep or temporary)
        paths = _recordings(arguments, folder, console)
        document: dict[str, Any] = {
            "experiment": arguments.experiment,
            "duration": arguments.duration,
            "hide": arguments.hide,
            "runs": len(paths),
            "methods": {},
        }
        for method in arguments.method or DEFAULT_METHODS:
            started = time.perf_counter()
            with ProcessPoolExecutor(arguments.processes) as pool:
                fits = list(pool.map(partial(fit, method), paths))
            summaries = summarise(fits)
            _show(console, method, fits, summaries, time.perf_counter() - started)
            document["methods"][method] = {
                "parameters": [asdict(summary) for summary in summaries],
                "failed": {found.seed: found.reason for found in fits if found.reason},
                "seconds_a_fit": statistics.median(found.seconds for found in fits),
                "fits": [asdict(found) for found in fits] if arguments.fits else [],
            }
    if arguments.json:
        Path(arguments.json).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def simulate(experiment: str, duration: float, hide: Sequence[str], path: Path) -> float:
    """Record the run whose seed is in `path`'s name; return the s it took. An existing recording is kept."""
    if path.exists():
        return 0.0
    started = time.perf_counter()
    recording = record("monocab", experiment, hide=hide, seed=_seed(path), duration=duration)
    part = path.with_name(f"part-{os.getpid()}-{path.name}")
    save(recording, part)
    part.rename(path)
    return time.perf_counter() - started


def fit(method: str, path: Path) -> Fit:
    """One method on one recording."""
    vehicle, recording = load("monocab"), load_recording(path)
    started = time.perf_counter()
    if method in PEERS:
        estimate = _recursive(method, recording, vehicle)
    else:
        from upright import estimators
        from upright.vehicles.monocab.model import MONOCAB_ROLL

        there = {parameter.name for parameter in MONOCAB_ROLL.parameters}
        cad, std = vehicle.parameters.values, vehicle.parameters.deviations
        model = MONOCAB_ROLL.change(
            {name: value for name, value in {**cad, **EXACT}.items() if name in there},
            deviations={name: value for name, value in {**std, **dict.fromkeys(EXACT, 0.0)}.items() if name in there},
        ).add("static_torque")
        estimate = getattr(estimators, method)(model, [recording], support=vehicle.support)
    known = {
        name: (parameter.value, parameter.std)
        for name, parameter in estimate.parameters.items()
        if parameter.value is not None and parameter.std is not None
    }
    reason = "" if estimate.status.value == "ok" else f"{estimate.status.value}: {estimate.reason}"
    return Fit(_seed(path), known, reason, time.perf_counter() - started)


def _recursive(method: str, recording: Any, vehicle: Any) -> Any:
    from upright.vehicles.monocab.identification.torque_balance import Method, make

    values, deviations = (
        {**vehicle.parameters.values, **EXACT},
        {**vehicle.parameters.deviations, **dict.fromkeys(EXACT, 0.0)},
    )
    estimator = make(values, vehicle.support, method=Method(method), deviations=deviations)
    for frame in recording.frames():
        estimator.update(frame)
    return estimator.result()


def summarise(fits: Sequence[Fit]) -> list[Summary]:
    """A summary of each parameter over the runs in which it was estimated."""
    names = dict.fromkeys(name for found in fits for name in found.values)
    return [_summary(name, [found.values[name] for found in fits if name in found.values]) for name in names]


def _summary(name: str, pairs: Sequence[tuple[float, float]]) -> Summary:
    values, reported = np.array(pairs).T
    runs, truth = len(values), TRUTH.get(name)
    mean, std = float(values.mean()), float(values.std(ddof=1)) if runs > 1 else float("nan")
    ratio = std**2 / float(np.mean(reported**2))
    tails = np.array([1.0 + CONFIDENCE, 1.0 - CONFIDENCE]) / 2.0
    low, high = ratio * (runs - 1) / stats.chi2.ppf(tails, max(runs - 1, 1))
    bias = percent = errors = coverage = interval = None
    if truth is not None:
        bias = mean - truth
        percent = 100.0 * bias / truth if truth else None
        errors = bias / (std / np.sqrt(runs))
        held = int(np.count_nonzero(np.abs(values - truth) <= stats.norm.ppf(tails[0]) * reported))
        binomial = stats.binomtest(held, runs).proportion_ci(CONFIDENCE, method="wilson")
        coverage, interval = held / runs, (float(binomial.low), float(binomial.high))
    return Summary(
        parameter=name,
        runs=runs,
        truth=truth,
        mean=mean,
        bias=bias,
        bias_percent=percent,
        bias_in_standard_errors=None if errors is None else float(errors),
        std=std,
        reported_std=float(reported.mean()),
        variance_ratio=ratio,
        variance_ratio_interval=(float(low), float(high)),
        coverage=coverage,
        coverage_interval=interval,
    )


def _recordings(arguments: argparse.Namespace, folder: Path, console: Console) -> list[Path]:
    hidden = "".join(f"-{effect}" for effect in arguments.hide)
    folder = folder / f"{arguments.experiment}-{arguments.duration:g}s{hidden}"
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"seed-{seed:04d}.arrow" for seed in range(arguments.runs)]
    started = time.perf_counter()
    work = partial(simulate, arguments.experiment, arguments.duration, arguments.hide)
    with ProcessPoolExecutor(arguments.processes) as pool:
        took = [seconds for seconds in pool.map(work, paths) if seconds]
    elapsed = time.perf_counter() - started
    if took:
        console.print(
            f"{len(took)} recordings in {elapsed:.0f} s ({statistics.median(took):.1f} s each, "
            f"{arguments.processes} at a time); {len(paths) - len(took)} already existed"
        )
    return paths


def _seed(path: Path) -> int:
    return int(path.stem.removeprefix("seed-"))


def _show(console: Console, method: str, fits: Sequence[Fit], summaries: Sequence[Summary], elapsed: float) -> None:
    failed = [found for found in fits if found.reason]
    each = statistics.median(found.seconds for found in fits)
    table = Table(
        title=f"{method}: {len(fits) - len(failed)} of {len(fits)} fits, {each:.2f} s each, {elapsed:.0f} s in total",
        title_justify="left",
    )
    for heading in (
        "parameter",
        "truth",
        "mean",
        "bias",
        "%",
        "in SE",
        "std",
        "reported",
        "variance ratio",
        "coverage %",
    ):
        table.add_column(heading, justify="left" if heading == "parameter" else "right", no_wrap=True)
    for row in summaries:
        low, high = row.variance_ratio_interval
        coverage = "-"
        if row.coverage is not None and row.coverage_interval is not None:
            least, most = row.coverage_interval
            coverage = f"{100 * row.coverage:.1f} [{100 * least:.1f}, {100 * most:.1f}]"
        table.add_row(
            row.parameter,
            _number(row.truth),
            _number(row.mean),
            _number(row.bias),
            "-" if row.bias_percent is None else f"{row.bias_percent:+.3f}",
            "-" if row.bias_in_standard_errors is None else f"{row.bias_in_standard_errors:+.1f}",
            _number(row.std),
            _number(row.reported_std),
            f"{row.variance_ratio:.2f} [{low:.2f}, {high:.2f}]",
            coverage,
        )
    console.print(table)
    for found in failed[:3]:
        console.print(f"seed {found.seed}: {found.reason}")


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}" if abs(value) >= 1.0 else f"{value:.3g}"


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--runs", type=int, default=200, help="seeds 0 to RUNS - 1")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--method", action="append", choices=(*METHODS, *PEERS), help="may be given several times")
    parser.add_argument("--experiment", default="multisine")
    parser.add_argument("--duration", type=float, default=30.0, help="s, length of the excitation")
    parser.add_argument(
        "--hide", action="append", default=[], metavar="EFFECT[=LEVEL]", help="hide an effect in the virtual vehicle"
    )
    parser.add_argument("--keep", metavar="FOLDER", help="keep the recordings here; empty it when the plant changes")
    parser.add_argument("--json", metavar="FILE")
    parser.add_argument("--fits", action="store_true", help="write every single fit to the JSON, too")
    arguments = parser.parse_args()
    if arguments.runs < 2:
        parser.error("a variance needs --runs of at least 2")
    return arguments


if __name__ == "__main__":
    sys.exit(main())
