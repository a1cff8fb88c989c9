"""Compare the fit of all the balancing robot's parameters with scipy's optimisers: `python benchmarks/robot.py`

All start from the paper's table 1, stay within its table 2 and minimise the same negative log-likelihood of the same
record over the same unknowns: parameters, noises and the initial state. The peers get the cost from a compiled
simulation without derivatives, like the optimiser of a simulation toolbox; SLSQP and trust-constr use finite
differences. A peer's time is the time until it first comes within NEAR of the cost that the fit reaches. A peer that
terminates before is restarted at its best point, with a new approximation of the Hessian or a new simplex. Each is
stopped after LIMIT seconds; its best cost by then counts, and its ratio is then a lower bound.
"""

from __future__ import annotations

import argparse
import time
import warnings

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import Bounds, minimize

from upright.estimators.fit.innovations import WIDEST
from upright.estimators.fit.likelihood import Likelihood
from upright.estimators.identify.bounded_fit import BoundedFit, bounded_fit
from upright.models.library import get
from upright.service.virtual.run import record

Array = NDArray[np.float64]

LIMIT = 120.0
"""s for each peer."""
NEAR = 0.5
"""Nats above the cost of the fit at which a peer counts as converged: less than any decision on a model depends on."""
PEERS = ("SLSQP", "trust-constr", "Nelder-Mead")
OPTIONS = {"SLSQP": {"ftol": 1e-12}, "Nelder-Mead": {"maxfev": 10**9, "adaptive": True}}
"""The best options found for each: with its default tolerance SLSQP stops every few steps, and restarts slow it."""


class Over(Exception):
    """A peer has converged, or its time is over."""


class Cost:
    """Negative log-likelihood per sample, by simulation, of unknowns (m,) in multiples of the start; keeps the best
    point and counts the calls."""

    def __init__(self, found: BoundedFit) -> None:
        task = found.fit.problem
        self.likelihood = Likelihood.of(task, np.zeros(len(task.free)))
        noises, own = self.likelihood.noise.size, np.array([task.model.states[each].initial_std for each in task.own])
        self.split = (len(task.free), len(task.free) + noises)
        # In multiples of the start: the peers fail in units of table 2's range, in which the start is close to zero.
        sizes = np.where(task.start == 0.0, task.scale, np.abs(task.start))
        self.scale = np.concatenate((sizes, np.ones(noises), *[own] * len(task.segments)))
        self.start = np.concatenate((task.start, np.zeros(noises), *task.own_start)) / self.scale
        lower, upper = task.bounds
        free = np.full(len(self.scale) - self.split[1], np.inf)
        ends = [(sign * WIDEST * np.ones(noises), sign * free) for sign in (-1.0, 1.0)]
        self.bounds = Bounds(
            *(np.concatenate((e, *more)) / self.scale for e, more in zip((lower, upper), ends, strict=True))
        )
        self.goal = found.fit.minimum.cost + NEAR
        self.begin(LIMIT)

    def begin(self, limit: float) -> None:
        """Reset for the next peer, with `limit` seconds."""
        self.best, self.at, self.count, self.deadline = np.inf, self.start, 0, time.perf_counter() + limit

    def __call__(self, unknowns: Array) -> float:
        if time.perf_counter() > self.deadline:
            raise Over
        self.count += 1
        inside = np.clip(unknowns, self.bounds.lb, self.bounds.ub)
        value = self.value(inside * self.scale)
        if value < self.best:
            self.best, self.at = value, inside
        if value <= self.goal:
            raise Over
        return value / self.likelihood.task.rows

    def value(self, natural: Array) -> float:
        task, noise = self.likelihood.task, self.likelihood.noise
        values, logarithms = task.values(natural[: self.split[0]]), natural[self.split[0] : self.split[1]]
        gain = noise.gain(values, logarithms)
        parts = natural[self.split[1] :].reshape(len(task.segments), -1)
        if gain is None:
            return 1e12
        squares, cost = np.zeros((len(task.kernel.outputs),) * 2), 0.0
        for segment, initial, part in zip(task.segments, task.initials, parts, strict=True):
            start = initial.copy()
            start[list(task.own)] = part
            run = task.kernel.run(segment, values, start, gain=gain, substeps=task.substeps)
            if run.diverges:
                return 1e12
            error = np.nan_to_num(segment.measured - run.predicted)
            squares += error.T @ error
            off = (part - initial[list(task.own)]) / [task.model.states[each].initial_std for each in task.own]
            cost += 0.5 * float(off @ off)
        covariance = squares / task.rows + np.diag(self.likelihood._floor)
        sign, size = np.linalg.slogdet(covariance)
        cost += 0.5 * task.rows * float(size) + 0.5 * float(self.likelihood.prior[self.split[0] :] @ logarithms**2)
        return cost if sign > 0.0 and np.isfinite(cost) else 1e12


def run(cost: Cost, peer: str, limit: float) -> tuple[float, int]:
    """Seconds that the peer took, and how often it was restarted after it had stopped before the goal."""
    cost.begin(limit)
    options = {"maxiter": 10**6} | OPTIONS.get(peer, {})
    began, again = time.perf_counter(), 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        while True:
            try:
                minimize(cost, cost.at, method=peer, bounds=cost.bounds, options=options)
            except Over:
                return time.perf_counter() - began, again
            again += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limit", type=float, default=LIMIT, help="s for each peer")
    limit = parser.parse_args().limit
    recording = record("twsbr", "square", seed=1)
    bounded_fit(get("twsbr"), [recording])  # compiles
    began = time.perf_counter()
    found = bounded_fit(get("twsbr"), [recording])
    own = time.perf_counter() - began
    cost = Cost(found)
    reached = found.fit.minimum.cost
    print(f"{len(cost.start)} unknowns, {cost.likelihood.task.rows} samples. The peers get the same compiled cost, the")
    print("same unknowns, scaled by the start, and the same bounds. A peer that stops early is restarted at its")
    print(f"best point. It ends within {NEAR:g} nat of upright's cost, or after {limit:g} s.")
    print(f"{'':14}{'s':>8}{'ratio':>9}{'cost above upright':>20}{'costs':>8}{'restarts':>10}")
    print(f"{'start':14}{'':8}{'':9}{cost.value(cost.start * cost.scale) - reached:20.2f}")
    print(f"{'upright':14}{own:8.2f}{1:9.1f}{0:20.2f}")
    for peer in PEERS:
        took, again = run(cost, peer, limit)
        ratio = f"{'' if cost.best <= cost.goal else '>= '}{took / own:.1f}"
        print(f"{peer:14}{took:8.2f}{ratio:>9}{cost.best - reached:20.2f}{cost.count:8}{again:10}", flush=True)


if __name__ == "__main__":
    main()
