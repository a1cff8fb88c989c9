"""How many passes over a record does a fit take, and how long is one? `python benchmarks/passes.py --seed 300`

The vehicle's model is fitted with its noise and a random disturbance to one record of the virtual MONOCAB (30 s of
multisine) and one of the virtual robot (its square wave), each with nothing hidden and with dry friction, with and
without a random disturbance. One pass evaluates the likelihood and its gradient once.

The first column, `settled`, is what a diagnosis does with a model alone: it starts from two splits of the noise, and
again from the end until that changes nothing. The second is one fit from the noise that the model states. The peer of
that one is L-BFGS-B of SciPy on the same likelihood, gradient, start and bounds. Its column states the passes until it
is within one nat of the fit, and `peer short of it` by how many nats it ends below.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from unittest.mock import patch

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does, before numpy is loaded

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.optimize import minimize

from upright.diagnosis.fits.refit import settled
from upright.diagnosis.prepare.ready import ready
from upright.diagnosis.prepare.workspace import Workspace
from upright.estimators.fit.likelihood import Likelihood, Seen
from upright.estimators.fit.logarithms import InLogarithms
from upright.estimators.fit.maximum_likelihood import Begin, fit, noise_of
from upright.estimators.fit.problem import Problem
from upright.models.model import Model
from upright.service.virtual.run import record
from upright.vehicles import registry
from upright.vehicles.file import load

Array = NDArray[np.float64]

NEAR = 1.0
"""Nats within which the peer counts as having reached the fit."""
PASSES = 2000
"""Passes after which the peer is stopped."""
DIVERGED = 1e12
"""Cost of a point at which the model diverges."""
HIDDEN = {
    "monocab": ("multisine", "coulomb_friction=0.1", "disturbance=5,0.3"),
    "twsbr": ("square", "coulomb_friction", "disturbance=1"),
}
"""By kind of vehicle: the experiment, dry friction, and a random disturbance."""
SILENT = "disturbance=0"


@dataclass(frozen=True, slots=True)
class Count:
    """Passes of `settled` and of one fit to a record, those of the peer (None if it never comes near), by how many nats
    the peer ends below the fit, and the CPU time of a pass, ms."""

    what: str
    settled: int
    passes: int
    peer: int | None
    short: float
    milliseconds: float


def tasks(vehicles: Sequence[str], seed: int, seconds: float | None) -> Iterator[tuple[str, Model, Workspace]]:
    """The fits, with what each is of."""
    for vehicle in vehicles:
        experiment, friction, disturbance = HIDDEN[vehicle]
        known, model = load(vehicle), registry.nominal_model(vehicle)
        for each in model.effects:
            model = model.remove(each.name)
        for shaken, dry in ((False, False), (False, True), (True, False), (True, True)):
            hide = [disturbance if shaken else SILENT, *([friction] if dry else [])]
            run = record(vehicle, experiment, hide=hide, seed=seed, duration=seconds)
            what = f"{vehicle} {'shaken' if shaken else 'still'}{' friction' if dry else ''}"
            own = ready(model, [run])
            yield what, own, Workspace.of(own, [run], known.support, ())


def counted(what: str, model: Model, workspace: Workspace) -> Count:
    """The passes of the fits and of the peer on the samples of `workspace`."""
    passes, began = 0, time.process_time()
    evaluate = Likelihood.of_data

    def of_data(self: Likelihood, *arguments: object, **further: object) -> Seen | None:
        nonlocal passes
        passes += 1
        return evaluate(self, *arguments, **further)  # type: ignore[arg-type]

    task = workspace.problem(model)
    with patch.object(Likelihood, "of_data", of_data):
        found = fit(task, begin=Begin({}, noise_of(task)))
        one = passes
        settled(model, workspace)
    milliseconds = 1e3 * (time.process_time() - began) / passes
    costs, least = peer(found.problem), found.minimum.cost
    near = next((number for number, cost in enumerate(costs, 1) if cost <= least + NEAR), None)
    return Count(what, passes - one, one, near, min(costs) - least, milliseconds)


def peer(task: Problem) -> list[float]:
    """The least cost after each pass of L-BFGS-B."""
    likelihood = Likelihood.of(task, np.array([parameter.std for parameter in task.parameters]))
    inside = InLogarithms.of(likelihood)
    scale = inside.scale(np.concatenate((task.scale, np.ones(likelihood.noise.size))))
    sides = zip(task.bounds, (-1.0, 1.0), strict=True)
    lower, upper = (inside.inside(np.concatenate((each, sign * likelihood.noise.widest))) for each, sign in sides)
    size, starts = len(scale), [len(part) for part in task.own_start]
    ends = size + np.cumsum([0, *starts])
    costs: list[float] = []

    def cost_and_gradient(z: Array) -> tuple[float, Array]:
        parts = [task.spread * z[ends[k] : ends[k + 1]] for k in range(len(starts))]
        seen = inside(np.clip(scale * z[:size], lower, upper), [*parts, np.zeros(0)])
        if seen is None:
            costs.append(min(costs, default=DIVERGED))
            return DIVERGED, np.zeros(len(z))
        common = sum((each.vector[:size] for each in seen.normals), np.zeros(size))
        own = [task.spread * each.vector[size:] for each in seen.normals if len(each.vector) > size]
        costs.append(min(seen.cost, min(costs, default=DIVERGED)))
        return seen.cost, np.concatenate((scale * common, *own))

    start = np.concatenate((inside.inside(likelihood.centre) / scale, *(part / task.spread for part in task.own_start)))
    free = [(None, None)] * (len(start) - size)
    bounds = [*zip(lower / scale, upper / scale, strict=True), *free]
    limits = {"maxfun": PASSES, "maxiter": PASSES, "ftol": 0.0, "gtol": 0.0}
    minimize(cost_and_gradient, start, jac=True, method="L-BFGS-B", bounds=bounds, options=limits)
    return costs


def _shown(counts: Sequence[Count]) -> Table:
    table = Table("record", "settled", "one fit", "L-BFGS-B", "ratio", "peer short of it", "ms a pass")
    for each in counts:
        ratio = f"{each.passes / each.peer:.2f}" if each.peer else ""
        reached = str(each.peer) if each.peer else "never"
        table.add_row(
            each.what,
            str(each.settled),
            str(each.passes),
            reached,
            ratio,
            f"{each.short:.1f}",
            f"{each.milliseconds:.1f}",
        )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--seed", type=int, default=300, help="of all records (default: 300)")
    parser.add_argument("--vehicle", choices=list(HIDDEN), action="append", help="only this (default: both)")
    parser.add_argument("--seconds", type=float, help="of each record (default: as the vehicle file has it)")
    given = parser.parse_args()
    Console().print(
        _shown([counted(*each) for each in tasks(given.vehicle or list(HIDDEN), given.seed, given.seconds)])
    )


if __name__ == "__main__":
    main()
