"""How fast are models compiled, simulated and fitted? `python benchmarks/fitting.py [--json FILE]`

Three things are timed, all in one run:

    passes     one pass over 60 s at 200 Hz (12,000 samples) with all sensitivities
    fits       prediction error and output error on such a record, compared with SciPy's least_squares over solve_ivp
               and with CasADi, from the same start values, 15 % off, to the same estimates
    compiling  the whole catalogue of effects, the first time and in later processes

The plant of the fits is a pendulum with damping and dry friction, driven by a motor with a lag. It has three states,
five parameters, and three initial states that are fitted, too. Its record is simulated by solve_ivp (DOP853, tolerance
1e-10, restarted at each change of the held command), with noise added. The peers:

    solve_ivp  the usual way: the state derivative in plain Python, RK45 or LSODA, whichever is faster here, with a
               relative tolerance of 1e-6, and a Jacobian by finite differences
    CasADi     the same Runge-Kutta steps by mapaccum of an expanded function, symbolic Jacobian, Gauss-Newton: by IPOPT
               as in its own example of system identification, and in a plain loop; on its virtual machine and compiled
               (JIT). Also, which its example does not do, with the variational equations written by hand, so that one
               mapaccum integrates the sensitivities, as upright's loops do

The peers are given the channels' noise; upright estimates it, and standard deviations. Its output error, the
counterpart of the peers, allows for correlated errors in the standard deviations, which takes half of its time. Its
prediction error also estimates the gain of a Kalman filter from parameters and noise, and the fit half a second ahead.
Times are wall clock times, for compiling also CPU times. OPENBLAS_NUM_THREADS=1 is fair to all: no method needs more.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares

from upright import estimators
from upright.models import library
from upright.models.compiler.kernel import compile_model
from upright.models.effects.catalogue import CATALOGUE
from upright.models.model import Model
from upright.models.parts import Actuator, Hold, Input, Joint, Output, Parameter, State
from upright.models.segment import Segment
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording

Array = NDArray[np.float64]

RATE, ROWS = 200.0, 12_000
TIME = np.arange(ROWS) / RATE
NOISE = np.array([2e-4, 2e-3])
FRICTION_RATE = 0.05
TRUTH = {"inertia": 0.02, "damping": 0.03, "gravity": 1.1, "friction": 0.04, "lag": 0.03}
START = {name: value * (1.15 if place % 2 else 0.85) for place, (name, value) in enumerate(TRUTH.items())}
INITIAL_STD = np.array([1e-3, 1e-2, 1e-2])


@dataclass(frozen=True, slots=True)
class Pass:
    """One pass over 12,000 samples, ms."""

    what: str
    states: int
    parameters: int
    columns: int
    milliseconds: float

    @property
    def microseconds_per_sample(self) -> float:
        return 1e3 * self.milliseconds / ROWS


@dataclass(frozen=True, slots=True)
class Fit:
    """One way of fitting: s to build and compile, s of the fit itself, and the estimates."""

    what: str
    build: float
    seconds: float
    values: Mapping[str, float]


# --- passes


def small_model() -> Model:
    """The reduced MONOCAB without the states of its roll filter: three states; with effects fifteen parameters."""
    model = library.get("monocab_reduced")
    model = replace(
        model,
        name="benchmark-pass",
        base_states=tuple(
            state for state in model.base_states if state.name in ("roll", "roll_rate", "precession_rate")
        ),
        outputs=tuple(replace(each, expression=each.name) for each in model.outputs),
    )
    for effect in ("static_torque", "viscous_friction", "coulomb_friction", "quadratic_drag", "cubic_stiffness"):
        model = model.add(effect)
    return model.add("gimbal_imbalance").add("torque_drift").add("periodic_disturbance")


def full_model() -> Model:
    """The reduced MONOCAB with the whole catalogue attached."""
    model = library.get("monocab_reduced")
    for name in CATALOGUE:
        model = model.add(name)
    return model


def passes() -> list[Pass]:
    """Passes as in a prediction-error fit: with a gain that stabilises the prediction of the unstable plant."""
    small, full = small_model(), full_model()
    fifteen = [parameter.name for parameter in small.parameters][:15]
    few = [
        "inertia",
        "gravity_stiffness",
        "static_torque.torque",
        "coulomb_friction.torque",
        "viscous_friction.coefficient",
    ]
    return [
        _pass("all sensitivities", small, fifteen),
        _pass("no sensitivities", small, []),
        _pass("the whole catalogue attached, few active", full, few),
        _pass("the whole catalogue, all active", full, [parameter.name for parameter in full.parameters]),
    ]


def _pass(what: str, model: Model, names: list[str]) -> Pass:
    kernel = compile_model(model)
    source = np.random.default_rng(0)
    held = np.repeat(source.uniform(-0.2, 0.2, ROWS // 10), 10)
    slow = {"precession": 0.1 * np.sin(TIME), "trim_position": 0.01 * np.sin(TIME), "trim_rate": 0.01 * np.cos(TIME)}
    usual = {each.name: np.full(ROWS, each.usual) for each in model.inputs if each.usual is not None}
    inputs = np.column_stack([{**slow, **usual}.get(name, held) for name in kernel.inputs])
    knots = np.repeat(TIME[:, None], len(kernel.inputs), axis=1)
    data = Segment(TIME, knots.copy(), inputs, np.zeros((ROWS, len(kernel.outputs))))
    gain = np.zeros((len(kernel.states), len(kernel.outputs)))
    for state, output in (("roll", "roll"), ("roll_rate", "roll_rate"), ("precession_rate", "precession_rate")):
        gain[kernel.states.index(state), kernel.outputs.index(output)] = 0.3
    active = [kernel.index(name) for name in names]
    start = np.zeros(len(kernel.states))
    run = kernel.run(data, kernel.vector(), start, gain=gain, active=active)
    if not (np.isfinite(run.predicted).all() and np.isfinite(run.sensitivity).all()):
        raise ArithmeticError(f"{what}: the pass diverges")
    seconds = least(lambda: kernel.run(data, kernel.vector(), start, gain=gain, active=active), 50)
    return Pass(what, len(kernel.states), len(kernel.parameters), len(active), 1e3 * seconds)


def least(work: Callable[[], Any], runs: int) -> float:
    """Time of the fastest of several runs, s."""
    best = math.inf
    for _ in range(runs):
        began = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - began)
    return best


# --- fits


def pendulum() -> Model:
    """inertia rate' = torque - damping rate - gravity sin(angle) - friction tanh(rate / 0.05); the torque has a lag."""
    scales = {"force_scale": 1.0, "coordinate_scale": 0.5, "rate_scale": 2.0, "smooth_rate": FRICTION_RATE}
    load = f"torque - damping * rate - gravity * sin(angle) - friction * tanh(rate / {FRICTION_RATE})"
    units = {"inertia": "kg m^2", "damping": "N m s/rad", "gravity": "N m", "friction": "N m", "lag": "s"}
    return Model(
        name="benchmark-pendulum",
        title="a pendulum with dry friction behind a motor with a lag",
        base_states=(
            State("angle", "rad", "rate", initial="angle", initial_std=INITIAL_STD[0]),
            State("rate", "rad/s", "pendulum_force / inertia", initial="rate", initial_std=INITIAL_STD[1]),
            State("torque", "N m", "(command - torque) / lag", initial_std=INITIAL_STD[2]),
        ),
        inputs=(Input("command", "N m", Hold.ZERO_ORDER),),
        outputs=(
            Output("angle", "rad", "angle", noise=NOISE[0]),
            Output("rate", "rad/s", "rate", noise=NOISE[1]),
        ),
        base_parameters=tuple(
            Parameter(name, units[name], value, lower=0.0, scale=value) for name, value in START.items()
        ),
        joints=(Joint("pendulum", "angle", "rate", "inertia", load, "N m", "rad", **scales),),
        actuators=(Actuator("motor", "command", "pendulum"),),
    )


def slope(values: Mapping[str, float], state: Any, command: float) -> tuple[float, float, float]:
    """The state derivative of the pendulum in plain Python."""
    angle, rate, torque = state
    force = torque - values["damping"] * rate - values["gravity"] * math.sin(angle)
    force -= values["friction"] * math.tanh(rate / FRICTION_RATE)
    return rate, force / values["inertia"], (command - torque) / values["lag"]


def recording() -> Recording:
    """The true pendulum, 60 s at 200 Hz, driven by a multisine that is held over each sample."""
    source = np.random.default_rng(7)
    frequencies = np.geomspace(0.1, 8.0, 14)
    command = np.sum(0.14 * np.sin(2.0 * np.pi * np.outer(TIME, frequencies) + source.uniform(0, 6.28, 14)), axis=1)
    states = np.zeros((ROWS, 3))
    for row in range(ROWS - 1):
        found = solve_ivp(
            lambda _, x, u=float(command[row]): slope(TRUTH, x, u),
            (TIME[row], TIME[row + 1]),
            states[row],
            method="DOP853",
            rtol=1e-10,
            atol=1e-12,
        )
        states[row + 1] = found.y[:, -1]
    angle, rate = (states[:, :2] + source.normal(0.0, 1.0, (ROWS, 2)) * NOISE).T
    channels = ChannelTable((Channel("angle", "rad", ""), Channel("rate", "rad/s", ""), Channel("command", "N m", "")))
    values = {"angle": angle, "rate": rate, "command": command}
    return Recording(channels, np.round(TIME * 1e9).astype(np.int64), values)


def fits() -> list[Fit]:
    """All ways of fitting, upright first."""
    record = recording()
    measured = np.column_stack((record["angle"], record["rate"]))
    names, guess = list(TRUTH), np.array([*START.values(), *measured[0], 0.0])
    found = _upright(record) + _casadi(record["command"], measured, guess, names)
    found.append(_solve_ivp(record["command"], measured, guess, names))
    return found


def _upright(record: Recording) -> list[Fit]:
    model = pendulum()
    build = least(lambda: compile_model(model), 1)
    found = []
    for method in (estimators.prediction_error, estimators.output_error):
        estimate = method(model, [record])
        if estimate.status.value != "ok":
            raise ArithmeticError(f"upright: {estimate.reason}")
        seconds = least(lambda: method(model, [record]), 5)  # noqa: B023
        found.append(Fit(f"upright: {method.__name__}", build, seconds, estimate.values))
    return found


def _solve_ivp(command: Array, measured: Array, guess: Array, names: list[str]) -> Fit:
    commands, scale = command.tolist(), np.array([*guess[:5], *INITIAL_STD])

    def simulate(unknowns: Array, method: str) -> Array:
        values = dict(zip(names, unknowns[:5].tolist(), strict=True))

        def f(t: float, state: Array) -> tuple[float, float, float]:
            return slope(values, state.tolist(), commands[int(t * RATE + 1e-9)])

        found = solve_ivp(f, (0.0, TIME[-1]), unknowns[5:], method=method, t_eval=TIME, rtol=1e-6, atol=1e-8)
        return np.asarray(found.y[:2].T)

    took = {method: least(lambda: simulate(guess, method), 1) for method in ("RK45", "LSODA")}  # noqa: B023
    method = min(took, key=lambda name: took[name])

    def residual(scaled: Array) -> Array:
        unknowns = scaled * scale
        errors = (measured - simulate(unknowns, method)) / NOISE
        return np.concatenate((errors.ravel(), (unknowns[5:] - guess[5:]) / INITIAL_STD))

    began = time.perf_counter()
    found = least_squares(residual, guess / scale, diff_step=1e-4, ftol=1e-6, xtol=1e-6, gtol=1e-6)
    seconds = time.perf_counter() - began
    what = f"solve_ivp ({method}) and least_squares, {found.njev} Jacobians"
    return Fit(what, 0.0, seconds, dict(zip(names, (found.x * scale)[:5].tolist(), strict=True)))


def _casadi_step(sensitivities: bool) -> ca.Function:
    """One step of classical Runge-Kutta, expanded, with the variational equations if `sensitivities`."""
    x, p, u = ca.SX.sym("x", 3), ca.SX.sym("p", 5), ca.SX.sym("u")
    inertia, damping, gravity, friction, lag = ca.vertsplit(p)
    angle, rate, torque = ca.vertsplit(x)
    force = torque - damping * rate - gravity * ca.sin(angle) - friction * ca.tanh(rate / FRICTION_RATE)
    derivative = ca.vertcat(rate, force / inertia, (u - torque) / lag)
    z, dz = x, derivative
    if sensitivities:
        S = ca.SX.sym("S", 3, 8)
        along = ca.mtimes(ca.jacobian(derivative, x), S)
        along[:, :5] += ca.jacobian(derivative, p)
        z, dz = ca.vertcat(x, ca.vec(S)), ca.vertcat(derivative, ca.vec(along))
    f = ca.Function("f", [z, p, u], [dz])
    h = 1.0 / RATE
    k1 = f(z, p, u)
    k2 = f(z + h / 2 * k1, p, u)
    k3 = f(z + h / 2 * k2, p, u)
    k4 = f(z + h * k3, p, u)
    return ca.Function("step", [z, p, u], [z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)], {"cse": True})


def _casadi(command: Array, measured: Array, guess: Array, names: list[str]) -> list[Fit]:
    scale = np.array([*guess[:5], *INITIAL_STD])
    jit = {"jit": True, "compiler": "shell", "jit_options": {"flags": "-O3 -march=native", "verbose": False}}
    V = ca.MX.sym("V", 8)
    unknowns = V * scale
    drive = ca.DM(command[:-1]).T

    def errors(states: ca.MX) -> ca.MX:
        seen = ca.horzcat(unknowns[5:], states)[:2, :]
        return ca.vertcat(ca.vec((measured.T - seen) / NOISE), (unknowns[5:] - guess[5:]) / INITIAL_STD)

    def simulated() -> ca.MX:
        step = _casadi_step(False)
        return step.mapaccum(ROWS - 1)(unknowns[5:], ca.repmat(unknowns[:5], 1, ROWS - 1), drive)

    def symbolic(options: dict[str, Any]) -> ca.Function:
        e = errors(simulated())
        return ca.Function("GN", [V], [e, ca.jacobian(e, V)], options)

    def by_hand(options: dict[str, Any]) -> ca.Function:
        start = ca.vertcat(unknowns[5:], ca.vec(ca.horzcat(ca.MX.zeros(3, 5), ca.MX.eye(3))))
        rows = _casadi_step(True).mapaccum(ROWS - 1)(start, ca.repmat(unknowns[:5], 1, ROWS - 1), drive)
        return ca.Function("GN", [V], [errors(rows[:3, :]), ca.horzcat(start, rows)[3:, :]], options)

    found = []
    for what, make, options in (
        ("CasADi: mapaccum, symbolic Jacobian", symbolic, {}),
        ("CasADi: the same, JIT (-O3)", symbolic, jit),
        ("CasADi: variational equations by hand", by_hand, {}),
        ("CasADi: the same, JIT (-O3)", by_hand, jit),
    ):
        began = time.perf_counter()
        function = make(options)
        build = time.perf_counter() - began
        plain = make is symbolic

        def step(V: Array, function: ca.Function = function, plain: bool = plain) -> Array:
            e, J = function(V)
            if plain:
                J = J.full()
            else:  # derivatives of the states by the unscaled unknowns, column after column
                rows = -(J.full().reshape(8, 3, ROWS)[:, :2] / NOISE[:, None] * scale[:, None, None])
                own = np.hstack((np.zeros((3, 5)), np.diag(scale[5:] / INITIAL_STD)))
                J = np.vstack((rows.transpose(2, 1, 0).reshape(-1, 8), own))
            return -np.linalg.solve(J.T @ J, J.T @ e.full().ravel())

        fit = Fit(what, build, *_gauss_newton(step, guess / scale, scale, names))
        found.append(fit)
    found.append(_ipopt(V, errors(simulated()), guess / scale, scale, names))
    return found


def _gauss_newton(
    step: Callable[[Array], Array], V: Array, scale: Array, names: list[str]
) -> tuple[float, dict[str, float]]:
    """Time in s, and estimates by full steps: this problem needs no damping, which favours methods without it."""
    began = time.perf_counter()
    for _ in range(30):
        moved = step(V)
        V = V + moved
        if np.max(np.abs(moved[:5])) < 1e-4:
            break
    return time.perf_counter() - began, dict(zip(names, (V * scale)[:5].tolist(), strict=True))


def _ipopt(V: ca.MX, e: ca.MX, start: Array, scale: Array, names: list[str]) -> Fit:
    """As in CasADi's example sysid.py."""
    began = time.perf_counter()
    J = ca.jacobian(e, V)
    sigma = ca.MX.sym("sigma")
    hessian = ca.Function(
        "nlp_hess_l",
        {"x": V, "lam_f": sigma, "hess_gamma_x_x": sigma * ca.triu(ca.mtimes(J.T, J))},
        ["x", "p", "lam_f", "lam_g"],
        ["hess_gamma_x_x"],
    )
    options = {"hess_lag": hessian, "print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-6}}
    solver = ca.nlpsol("solver", "ipopt", {"x": V, "f": 0.5 * ca.dot(e, e)}, options)
    build = time.perf_counter() - began
    began = time.perf_counter()
    found = solver(x0=start)["x"].full().ravel() * scale
    seconds = time.perf_counter() - began
    return Fit("CasADi: IPOPT, Gauss-Newton Hessian", build, seconds, dict(zip(names, found[:5].tolist(), strict=True)))


# --- compiling


COMPILE = """
import json, sys, time
from upright.models import library
from upright.models.effects.catalogue import CATALOGUE
from upright.models.compiler.kernel import compile_model
model = library.get("monocab_reduced")
for name in CATALOGUE:
    model = model.add(name)
told = []
began, cpu = time.perf_counter(), time.process_time()
compile_model(model, progress=told.append)
took = [time.perf_counter() - began, time.process_time() - cpu]
there = sorted({"sympy", "numba"} & set(sys.modules))
print(json.dumps({"wall": took[0], "cpu": took[1], "told": told, "there": there}))
"""


def compiling() -> dict[str, Any]:
    """The whole catalogue in a new process with an empty cache, and in later ones; `import numba` for comparison."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "UPRIGHT_CACHE": folder}
        first = _process(COMPILE, environment)
        later = [_process(COMPILE, environment) for _ in range(5)]
    numba = [_process("import numba, json; print(json.dumps({}))", dict(os.environ)) for _ in range(5)]
    best = min(later, key=lambda each: each["process_cpu"])
    if best["told"] or best["there"]:
        raise RuntimeError(f"a later start compiled or imported: {best}")
    return {"first": first, "later": best, "import_numba": min(numba, key=lambda each: each["process_cpu"])}


def _process(code: str, environment: dict[str, str]) -> dict[str, Any]:
    before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {**json.loads(done.stdout), "process_wall": time.perf_counter() - began, "process_cpu": cpu}


# --- output


def _show_passes(found: list[Pass]) -> Table:
    table = Table(title="One pass over 60 s at 200 Hz: 12,000 samples", title_justify="left")
    for heading in ("", "states", "parameters", "columns", "ms", "us per sample"):
        table.add_column(heading, justify="right" if heading else "left")
    for each in found:
        counts = (str(each.states), str(each.parameters), str(each.columns))
        table.add_row(each.what, *counts, f"{each.milliseconds:.2f}", f"{each.microseconds_per_sample:.3f}")
    return table


def _show_fits(found: list[Fit]) -> Table:
    table = Table(title="Fits of 60 s at 200 Hz, five parameters and three initial states", title_justify="left")
    for heading in ("", "build, s", "fit, s", "times upright", *TRUTH, "differs by"):
        table.add_column(heading, justify="right" if heading else "left")
    ours = found[0]
    for each in found:
        values = [f"{each.values[name]:.5g}" for name in TRUTH]
        ratio = f"{each.seconds / ours.seconds:.1f}"
        table.add_row(
            each.what, f"{each.build:.2f}", f"{each.seconds:.3f}", ratio, *values, f"{difference(each, ours):.1e}"
        )
    truth = [f"{value:.5g}" for value in TRUTH.values()]
    table.add_row("truth", "", "", "", *truth, "")
    return table


def _show_compiling(found: Mapping[str, Any]) -> Table:
    table = Table(title="Compiling the whole catalogue, s", title_justify="left")
    for heading in ("", "kernel, CPU", "kernel, wall", "process, CPU", "process, wall"):
        table.add_column(heading, justify="right" if heading else "left")
    for what, name in (("first time", "first"), ("later process", "later"), ("`import numba` alone", "import_numba")):
        each = found[name]
        keys = ("cpu", "wall", "process_cpu", "process_wall")
        table.add_row(what, *("" if key not in each else f"{each[key]:.3f}" for key in keys))
    return table


def difference(one: Fit, other: Fit) -> float:
    """The largest relative difference of two fits' parameters."""
    return max(abs(one.values[name] / other.values[name] - 1.0) for name in TRUTH)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--json", metavar="FILE", help="also write the figures to FILE")
    arguments = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 150)
    all_passes = passes()
    console.print(_show_passes(all_passes))
    all_fits = fits()
    console.print(_show_fits(all_fits))
    apart = [each.what for each in all_fits if difference(each, all_fits[0]) > 1e-3]
    console.print("All agree to three digits." if not apart else f"Different estimates: {', '.join(apart)}")
    compiled = compiling()
    console.print(_show_compiling(compiled))
    if arguments.json:
        document = {
            "passes": [asdict(each) for each in all_passes],
            "fits": [{**asdict(each), "times_upright": each.seconds / all_fits[0].seconds} for each in all_fits],
            "compiling": compiled,
        }
        Path(arguments.json).write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
