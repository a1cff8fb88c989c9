"""The paper's estimation of the two-wheeled balancing robot (figures 7 to 13), with the virtual robot.

    python examples/estimate_robot.py [FOLDER]

A square wave is used for estimation; a sine, a doublet and a sine stream for validation. All parameters of the paper's
table 1 are estimated within the bounds of its table 2; then only those that the record can identify, with the others
fixed. Takes two minutes, most of them for the profiles.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

import matplotlib.pyplot as plt
import numpy as np

from upright.estimators.fit.maximum_likelihood import Fit, fit
from upright.estimators.fit.problem import problem
from upright.estimators.identify.bounded_fit import RISE, BoundedFit, Profile, bounded_fit, profile
from upright.estimators.identify.combinations import combinations
from upright.estimators.identify.validation import in_windows, on_others
from upright.estimators.methods.prediction_error import predicted_percent
from upright.estimators.numbers import with_error
from upright.models.library import get
from upright.service.virtual.run import record
from upright.telemetry.recording import Recording
from upright.vehicles.twsbr.model import IDENTIFIABLE_NEAR_UPRIGHT

MODEL = get("twsbr")
TABLE_1 = MODEL.values
EXPERIMENTS = ("square", "sine", "doublet", "sine_stream")
HORIZON = 0.1  # s ahead: a tilt error doubles in that time
SHOWN = ("tilt", "tilt_rate", "left_wheel_angle", "left_wheel_rate")


@dataclass(frozen=True)
class Estimation:
    recordings: dict[str, Recording]
    complete: BoundedFit
    reduced: Fit
    profiles: list[Profile]


def runs(seed: int = 1, seconds: float | None = None) -> dict[str, Recording]:
    return {name: record("twsbr", name, seed=seed, duration=seconds) for name in EXPERIMENTS}


def estimate(recordings: dict[str, Recording], profiled: Sequence[str] | None = None) -> Estimation:
    square = [recordings["square"]]
    complete = bounded_fit(MODEL, square)
    names = complete.parameters if profiled is None else profiled
    return Estimation(
        recordings=recordings,
        complete=complete,
        reduced=fit(problem(MODEL, square)),
        profiles=[profile(complete, name) for name in names],
    )


def percents(found: Estimation) -> dict[str, list[dict[str, float]]]:
    """Percent of each channel predicted HORIZON ahead by table 1, complete and reduced fit, for each experiment."""
    complete, reduced = found.complete.fit, found.reduced
    fits: list[tuple[Fit, dict[str, float]]] = [(reduced, TABLE_1), (complete, {}), (reduced, {})]
    return {
        name: [predicted_percent(on_others(each, [recording], values=values), HORIZON) for each, values in fits]
        for name, recording in found.recordings.items()
    }


def print_tables(found: Estimation) -> None:
    complete = found.complete
    bounded = {each.parameter: each for each in found.profiles}
    print(
        f"{'parameter':22}{'table 1':>12}{'estimate':>12}  95 % interval by its profile, within the bounds of table 2"
    )
    for name, start, value in zip(complete.parameters, complete.start, complete.values, strict=True):
        edges = bounded[name].interval if name in bounded else ()
        text = " to ".join("bound" if edge is None else f"{edge:.4g}" for edge in edges)
        print(f"{name:22}{start:12.4g}{value:12.4g}  {text}")
    print(
        f"{complete.determined} combinations are identified to 30 %; "
        f"gradient at the minimum {complete.kkt_residual:.2g} std"
    )
    print("\ncombination per unit of motor gain, with the other parameters fixed")
    for name, (value, std) in combinations(found.reduced, IDENTIFIABLE_NEAR_UPRIGHT).items():
        print(f"{name:28}{with_error(value, std):>20}")
    print(f"\npercent of the motion predicted {HORIZON:g} s ahead: table 1, complete fit, reduced fit")
    for experiment, shares in percents(found).items():
        for channel in SHOWN:
            print(f"{experiment:12}{channel:20}" + "".join(f"{each[channel]:9.2f}" for each in shares))


def save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=120)
    plt.close(figure)


def draw(found: Estimation, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    complete = found.complete
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    left.semilogy(complete.costs - complete.costs[-1] + 1.0, ".-")
    left.set(xlabel="step", ylabel="cost above the minimum, plus 1", title="Convergence (figure 8)")
    moves = complete.path / np.where(complete.start == 0.0, np.nan, complete.start)
    for name, line in zip(complete.parameters, moves.T, strict=True):
        if np.ptp(line) > 0.05:
            right.plot(line, label=name)
    right.set(yscale="log", xlabel="step", ylabel="value over that of table 1", title="Parameters that change")
    right.legend(fontsize=7)
    save(figure, folder / "convergence.png")

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    left.barh(complete.parameters, np.maximum(complete.sensitivity, 1e-9))
    left.set(xscale="log", xlabel="increase of the cost for a change of 1 %", title="Sensitivity (figure 7)")
    left.invert_yaxis()
    right.semilogy(np.arange(1, len(complete.singular_values) + 1), np.maximum(complete.singular_values, 1e-9), "o")
    right.axhline(2.0 / 0.3, color="grey", linestyle=":", label="known to 30 %")
    right.set(xlabel="combination", ylabel="singular value", title="Jacobian for relative changes")
    right.legend()
    save(figure, folder / "sensitivity.png")

    if found.profiles:
        rows = -(-len(found.profiles) // 4)
        figure, axes = plt.subplots(rows, 4, figsize=(12, 2.4 * rows), layout="constrained", squeeze=False)
        for axis in axes.flat[len(found.profiles) :]:
            axis.set_axis_off()
        for axis, each in zip(axes.flat, found.profiles, strict=False):
            axis.plot(each.values, np.minimum(each.rises, 10.0 * RISE), ".-")
            axis.axhline(RISE, color="grey", linestyle=":")
            axis.set_title(f"{each.parameter}{'' if each.identifiable else ': not identifiable'}", fontsize=9)
        figure.supylabel("increase of the cost (95 % dotted)")
        save(figure, folder / "profiles.png")

    for number, (experiment, recording) in enumerate(found.recordings.items()):
        overlay(found, experiment, recording, folder / f"{9 + number}_{experiment}.png")


def overlay(found: Estimation, experiment: str, recording: Recording, path: Path) -> None:
    """Plot measurements and simulations over windows of HORIZON with table 1 and the estimates (figures 9 to 13)."""
    fits = {
        "table 1": on_others(found.reduced, [recording], values=TABLE_1),
        "estimated": on_others(found.reduced, [recording]),
    }
    task = fits["estimated"].problem
    segment = task.segments[0]
    middle = slice(len(segment) // 2, len(segment) // 2 + round(3.0 / float(np.median(np.diff(segment.time)))))
    figure, axes = plt.subplots(len(SHOWN), 1, figsize=(10, 9), sharex=True, layout="constrained")
    for axis, channel in zip(axes, SHOWN, strict=True):
        place = task.kernel.outputs.index(channel)
        axis.plot(segment.time[middle], segment.measured[middle, place], color="black", linewidth=2.5, label="measured")
        for label, each in fits.items():
            axis.plot(segment.time[middle], in_windows(each, HORIZON)[0][middle, place], linewidth=1.0, label=label)
        axis.set_ylabel(f"{channel}\n{task.model.outputs[place].unit}", fontsize=8)
    axes[0].set_title(f"{experiment}: simulated over windows of {HORIZON:g} s")
    axes[0].legend(fontsize=8, ncols=3)
    axes[-1].set_xlabel("time, s")
    save(figure, path)


if __name__ == "__main__":
    estimation = estimate(runs())
    print_tables(estimation)
    draw(estimation, Path(sys.argv[1] if len(sys.argv) > 1 else "robot"))
