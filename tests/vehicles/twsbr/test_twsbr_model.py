"""The balancing robot: its equations compared with the energies and Kane's method, and their physical properties."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sympy
from numpy.typing import NDArray
from scipy.linalg import expm
from sympy.physics.mechanics import KanesMethod, Point, ReferenceFrame, RigidBody, dynamicsymbols, inertia
from twsbr_derivation import Derivation, derive

from upright.models.compiler.equations import compose
from upright.models.compiler.kernel import Kernel, compile_model
from upright.models.gravity import GRAVITY
from upright.models.library import get
from upright.models.model import Model
from upright.models.segment import Segment
from upright.models.text.expressions import number
from upright.vehicles.twsbr.channels import CHANNELS

Array = NDArray[np.float64]
Values = Mapping[str, float]

TWSBR = get("twsbr")
TABLE_3 = {
    "wheel_radius": 0.03015,
    "wheel_mass": 0.0585,
    "com_height": 0.0489,
    "body_mass": 0.585,
    "wheel_distance": 0.1625,
    "yaw_inertia": 0.0189,
    "tilt_inertia": 0.0075,
    "gear_ratio": 43.8,
    "rotor_inertia": 1.538e-5,
    "armature_resistance": 5.5609,
    "armature_inductance": 23.68e-6,
    "motor_constant": 0.00586,
    "motor_friction": 8.153e-6,
    "wheel_friction": 0.00642,
}
"""The parameters that the paper identified."""
TILT_STD = 1.3e-3
"""rad, standard deviation of the tilt filter after some seconds."""
FREE = {"armature_resistance": 1e15, "motor_friction": 0.0, "wheel_friction": 0.0}
"""Motors disconnected, no friction."""


@pytest.fixture(scope="module")
def derived() -> Derivation:
    return derive()


@pytest.fixture(scope="module")
def kernel() -> Kernel:
    return compile_model(TWSBR)


@pytest.fixture(scope="module")
def bare() -> Kernel:
    """The same with the true tilt as output, instead of the tilt that its filter estimates."""
    tilt, *others = TWSBR.outputs
    return compile_model(replace(TWSBR, outputs=(replace(tilt, expression="tilt"), *others)))


# --- the equations, derived independently


def _slopes(model: Model) -> Callable[[Values], dict[str, float]]:
    """The states' derivatives by name."""
    equations = compose(model)
    arguments = (*equations.states, *equations.inputs, *equations.slopes, *equations.parameters)
    function = sympy.lambdify(arguments, equations.derivatives, modules="numpy", cse=True)
    names = [state.name for state in model.states]

    def slopes(values: Values) -> dict[str, float]:
        given = ({"tilt_std": TILT_STD, **values}.get(symbol.name, 0.0) for symbol in arguments)
        return dict(zip(names, map(float, function(*given)), strict=True))

    return slopes


def _accelerations(slopes: dict[str, float]) -> Array:
    """Accelerations of the wheels relative to the floor and of the body; in the model the wheels are relative to it."""
    tilt = slopes["tilt_rate"]
    return np.array([slopes["left_wheel_rate"] + tilt, slopes["right_wheel_rate"] + tilt, tilt])


def _draw(source: np.random.Generator) -> dict[str, float]:
    """A random state, voltages and parameters."""
    values = {p.name: p.value * source.uniform(0.5, 2.0) for p in TWSBR.base_parameters}
    values |= {name: source.uniform(-8.0, 8.0) for name in ("left_voltage", "right_voltage", "tilt_rate")}
    values |= {name: source.uniform(-30.0, 30.0) for name in ("left_wheel_rate", "right_wheel_rate")}
    return values | {"tilt": source.uniform(-math.pi, math.pi)}


def _rates(values: Values) -> Array:
    tilt = values["tilt_rate"]
    return np.array([values["left_wheel_rate"] + tilt, values["right_wheel_rate"] + tilt, tilt])


def _lagrange(derived: Derivation) -> Callable[[Values], tuple[Array, Array]]:
    """Mass matrix (3, 3) and forces minus bias (3,) from the energies."""
    matrices = (derived.mass, derived.forces - derived.bias)
    known = sorted(set().union(*(each.free_symbols for each in matrices)), key=str)
    function = sympy.lambdify(known, matrices, modules="numpy", cse=True)

    def evaluate(values: Values) -> tuple[Array, Array]:
        here = {"gravity": GRAVITY, **values}
        renamed = dict(zip(derived.rates, _rates(values), strict=True))
        mass, forces = function(*(renamed.get(symbol, here.get(symbol.name)) for symbol in known))
        return mass, forces.ravel()

    return evaluate


def _kane() -> Callable[[Values], Array]:
    """Accelerations (3,) by Kane's method: rigid bodies in rotating frames, without energies."""
    names = ("wheel_radius", "wheel_distance", "com_height", "wheel_mass", "body_mass", "yaw_inertia", "tilt_inertia")
    r, d, height, wheel_mass, body_mass, yaw_inertia, tilt_inertia = symbols = sympy.symbols(names)
    rotor, left, right, tilt = more = sympy.symbols("rotor left right tilt")
    angles, rates = dynamicsymbols("q1:4"), dynamicsymbols("u1:4")
    floor, heading = ReferenceFrame("floor"), ReferenceFrame("heading")
    heading.set_ang_vel(floor, r * (rates[1] - rates[0]) / d * heading.z)
    leaning = heading.orientnew("leaning", "Axis", (angles[2], heading.y))
    leaning.set_ang_vel(heading, rates[2] * heading.y)
    axle = Point("axle")
    axle.set_vel(floor, r * (rates[0] + rates[1]) / 2 * heading.x)
    centre = axle.locatenew("centre", height * leaning.z)
    centre.v2pt_theory(axle, floor, leaning)
    about = inertia(leaning, yaw_inertia, tilt_inertia, yaw_inertia)
    bodies = [RigidBody("body", centre, leaning, body_mass, (about, centre))]
    loads = [(centre, -body_mass * GRAVITY * heading.z), (leaning, tilt * heading.y)]
    for side, rate, torque in ((1, rates[0], left), (-1, rates[1], right)):
        wheel, turned = ReferenceFrame(f"wheel{side}"), ReferenceFrame(f"rotor{side}")
        wheel.set_ang_vel(heading, rate * heading.y)
        turned.set_ang_vel(heading, (rate - rates[2]) * heading.y)
        hub = axle.locatenew(f"hub{side}", side * d / 2 * heading.y)
        hub.v2pt_theory(axle, floor, heading)
        disc = inertia(heading, 0, wheel_mass * r**2 / 2, 0)
        bodies.append(RigidBody(f"wheel{side}", hub, wheel, wheel_mass, (disc, hub)))
        bodies.append(RigidBody(f"rotor{side}", axle, turned, 0, (inertia(heading, 0, rotor, 0), axle)))
        loads.append((wheel, torque * heading.y))
    time = dynamicsymbols._t
    method = KanesMethod(floor, angles, rates, [q.diff(time) - u for q, u in zip(angles, rates, strict=True)])
    method.kanes_equations(bodies, loads)
    plain = sympy.symbols("a1:4 v1:4")
    matrices = [m.subs(dict(zip((*angles, *rates), plain, strict=True))) for m in (method.mass_matrix, method.forcing)]
    function = sympy.lambdify((*symbols, *more, *plain), matrices, modules="numpy")

    def evaluate(values: Values) -> Array:
        gear, constant = values["gear_ratio"], values["motor_constant"]
        speeds = _rates(values)
        torques = []
        for side, rate in zip(("left", "right"), speeds[:2], strict=True):
            slip = rate - speeds[2]
            current = (values[f"{side}_voltage"] - constant * gear * slip) / values["armature_resistance"]
            torques.append(gear * constant * current - values["motor_friction"] * slip)
        on_wheels = [t - values["wheel_friction"] * v for t, v in zip(torques, speeds[:2], strict=True)]
        given = [values[name] for name in names]
        acting = [gear**2 * values["rotor_inertia"], *on_wheels, -sum(torques)]
        mass, forces = function(*given, *acting, 0.0, 0.0, values["tilt"], *speeds)
        return np.asarray(np.linalg.solve(mass, forces.ravel()))

    return evaluate


def test_model_equations_follow_from_the_energies(derived: Derivation) -> None:
    slopes, lagrange, source = _slopes(TWSBR), _lagrange(derived), np.random.default_rng(1)
    for _ in range(50):
        values = _draw(source)
        mass, forces = lagrange(values)
        # The two sides invert a matrix of condition number 1e3 in different ways, in float64.
        assert _accelerations(slopes(values)) == pytest.approx(np.linalg.solve(mass, forces), rel=1e-10, abs=1e-9)


def test_kanes_method_gives_the_same_accelerations() -> None:
    slopes, kane, source = _slopes(TWSBR), _kane(), np.random.default_rng(2)
    for _ in range(50):
        values = _draw(source)
        expected = kane(values)
        assert _accelerations(slopes(values)) == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.max(np.abs(expected)))


def test_bias_contains_the_centrifugal_force_of_the_body_in_a_turn(derived: Derivation) -> None:
    """The term that is lost if x' and y' are put into the energies first: m l sin(tilt) heading'^2 on the axle."""
    r, d, height, mass = (
        sympy.Symbol(n, positive=True) for n in ("wheel_radius", "wheel_distance", "com_height", "body_mass")
    )
    left, right, tilt_rate = derived.rates
    turning = r * (right - left) / d
    pushes = -(derived.bias[0] + derived.bias[1]).subs(tilt_rate, 0)
    assert sympy.simplify(pushes - r * mass * height * sympy.sin(derived.angles[2]) * turning**2) == 0


@pytest.mark.parametrize("joint", [joint.name for joint in TWSBR.joints])
def test_joint_torque_acts_along_the_coordinate_of_its_joint(joint: str, derived: Derivation) -> None:
    """An effect at a joint enters Lagrange's equations along the direction of the joint, and `load / inertia` is the
    acceleration of the joint, as effects assume."""
    directions = {"tilt": (0, 0, 1), "travel": (0.5, 0.5, 0), "wheels": (0.5, 0.5, -1)}
    direction = np.array(directions[joint])
    model = TWSBR.add("static_torque", joint)
    torque = next(p.name for p in model.parameters if p.name.startswith("static_torque"))
    bare, pushed, lagrange = _slopes(TWSBR), _slopes(model), _lagrange(derived)
    place = next(each for each in TWSBR.joints if each.name == joint)
    source = np.random.default_rng(3)
    for _ in range(5):
        values = _draw(source)
        mass, forces = lagrange(values)
        expected = np.linalg.solve(mass, forces + 0.2 * direction)
        found = _accelerations(pushed({**values, torque: 0.2}))
        assert found == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.max(np.abs(expected)))
        known = dict.fromkeys(("tilt_error", "rate_error", "level_error", "tilt_std", "tilt_std_slope"), 0.0) | values
        for name, text in TWSBR.definitions.items():
            known[name] = number(text, known)
        load, joint_inertia = number(place.load, known), number(place.inertia, known)
        assert load / joint_inertia == pytest.approx(direction @ _accelerations(bare(values)), rel=1e-9)
        assert 1.0 / joint_inertia == pytest.approx(direction @ np.linalg.solve(mass, direction), rel=1e-9)


# --- physics


def _coast(kernel: Kernel, values: Array, initial: Array, spacing: float, duration: float) -> Array:
    """The outputs (n, 6) without voltages."""
    time = spacing * np.arange(round(duration / spacing) + 1)
    knots = np.repeat(time[:, None], 3, axis=1)
    silent = Segment(time, knots, np.zeros((len(time), 3)), np.full((len(time), 6), np.nan))
    return kernel.run(silent, values, initial).predicted


def _energy(derived: Derivation, values: Values, outputs: Array) -> Array:
    tilt, tilt_rate, _, left, _, right = outputs.T
    known = {s: {"gravity": GRAVITY, **values}.get(s.name) for s in derived.energy.free_symbols}
    expression = derived.energy.subs({s: v for s, v in known.items() if v is not None})
    function = sympy.lambdify((derived.angles[2], *derived.rates), expression, modules="numpy")
    return np.asarray(function(tilt, left + tilt_rate, right + tilt_rate, tilt_rate))


def test_energy_is_conserved_without_friction_and_motors(bare: Kernel, derived: Derivation) -> None:
    """A minute of swinging below the axle and up again, in a turn. The drift, relative to the energy of the pendulum's
    swing, is the error of the integration: of order four, so that half the step leaves a sixteenth or less of it. An
    error of the equations would not shrink with the step."""
    values = bare.vector(FREE)
    initial = np.array([0.3, 2.0, 0.0, 15.0, 0.0, 25.0, 0.0, 0.0, 0.0])
    named = dict(zip(bare.parameters, values, strict=True))
    drift = []
    for spacing in (2e-3, 1e-3):
        outputs = _coast(bare, values, initial, spacing, 60.0)
        assert np.ptp(outputs[:, 0]) > math.pi
        energy = _energy(derived, named, outputs)
        swing = GRAVITY * named["body_mass"] * named["com_height"]
        drift.append(float(np.max(np.abs(energy - energy[0]))) / swing)
    assert drift[1] < 1e-6
    assert drift[0] / drift[1] > 12.0


def test_friction_and_short_circuited_motors_always_dissipate_energy(bare: Kernel, derived: Derivation) -> None:
    values = bare.vector()
    outputs = _coast(bare, values, np.array([0.3, 2.0, 0.0, 15.0, 0.0, 25.0, 0.0, 0.0, 0.0]), 1e-3, 3.0)
    energy = _energy(derived, dict(zip(bare.parameters, values, strict=True)), outputs)
    assert np.all(np.diff(energy) < 1e-12)


def _matrix(tilt: float, parameters: Values | None = None) -> Array:
    """The system matrix (9, 9) at rest with the body at `tilt`, by central differences."""
    slopes, names = _slopes(TWSBR), [state.name for state in TWSBR.states]
    rest = {**TWSBR.values, **(parameters or {}), "tilt": tilt}
    columns = []
    for name in names:
        there = [slopes({**rest, name: rest.get(name, 0.0) + step}) for step in (1e-5, -1e-5)]
        columns.append([(there[0][each] - there[1][each]) / 2e-5 for each in names])
    return np.array(columns).T


def test_upright_is_unstable_and_hanging_is_not() -> None:
    upright, hanging = np.linalg.eigvals(_matrix(0.0)), np.linalg.eigvals(_matrix(math.pi))
    assert np.sum(upright.real > 1e-6) == 1
    # The vehicle can stand at any place in any direction: two poles at 0.
    assert np.max(hanging.real) < 1e-6
    assert np.sum(np.abs(hanging) < 1e-6) == 2


def test_gravity_gives_the_unstable_pole_of_the_pendulum_on_free_wheels() -> None:
    """The sign is not that of (20) in the paper, with which the upright body would oscillate. Closed form: with free
    wheels the axle moves away under the body, which reduces the effective inertia."""
    v = {**TWSBR.values, **FREE}
    rotors = 2.0 * v["gear_ratio"] ** 2 * v["rotor_inertia"]
    moment = v["body_mass"] * v["com_height"]
    travel = (3.0 * v["wheel_mass"] + v["body_mass"]) * v["wheel_radius"] ** 2 + rotors
    body = moment * v["com_height"] + v["tilt_inertia"] + rotors
    shared = moment * v["wheel_radius"] - rotors
    squared = GRAVITY * moment / (body - shared**2 / travel)
    assert _matrix(0.0, FREE)[1, 0] == pytest.approx(squared, rel=1e-6)
    assert max(np.linalg.eigvals(_matrix(0.0, FREE)).real) == pytest.approx(math.sqrt(squared), rel=1e-6)
    assert _matrix(math.pi, FREE)[1, 0] < 0.0


def test_positive_voltage_drives_forward_tilts_back_and_right_alone_turns_left() -> None:
    slopes = _slopes(TWSBR)
    both = slopes({**TWSBR.values, "left_voltage": 1.0, "right_voltage": 1.0})
    assert both["left_wheel_rate"] == pytest.approx(both["right_wheel_rate"])
    assert both["left_wheel_rate"] > 0.0 > both["tilt_rate"]
    one = slopes({**TWSBR.values, "right_voltage": 1.0})
    assert one["right_wheel_rate"] > 0.0
    assert one["right_wheel_rate"] > one["left_wheel_rate"]


def test_steady_speed_without_friction_requires_the_back_emf_voltage() -> None:
    values = {**TWSBR.values, "motor_friction": 0.0, "wheel_friction": 0.0}
    voltage = values["motor_constant"] * values["gear_ratio"] * 20.0
    slopes = _slopes(TWSBR)(
        {**values, "left_wheel_rate": 20.0, "right_wheel_rate": 20.0, "left_voltage": voltage, "right_voltage": voltage}
    )
    assert max(map(abs, _accelerations(slopes))) < 1e-9


def test_paper_controller_balances_the_model_through_the_paper_excitation() -> None:
    """PID gains of 25 V/deg, 3 and 3.5 at 200 Hz within 12 V, a square wave of 8 V and 5 rad/s on the voltage, and the
    parameters of Table 3: the tilt stays within 3 degrees, as in the paper."""
    slopes = _slopes(TWSBR)
    state = dict.fromkeys((state.name for state in TWSBR.states), 0.0) | {"tilt": math.radians(0.5)}
    total, largest = 0.0, 0.0
    for k in range(2000):
        tilt, rate = math.degrees(state["tilt"]), math.degrees(state["tilt_rate"])
        total += tilt * 0.005
        square = 8.0 if math.sin(5.0 * 0.005 * k) >= 0.0 else -8.0
        voltage = max(-12.0, min(12.0, 25.0 * tilt + 3.0 * total + 3.5 * rate + square))
        given = {**TWSBR.values, **TABLE_3, "left_voltage": voltage, "right_voltage": voltage}
        for _ in range(5):  # midpoint rule, 1 ms
            first = slopes({**given, **state})
            middle = slopes({**given, **{name: state[name] + 5e-4 * first[name] for name in state}})
            state = {name: state[name] + 1e-3 * middle[name] for name in state}
        largest = max(largest, abs(math.degrees(state["tilt"])))
    assert 0.1 < largest < 3.0


# --- the kernel


def test_kernel_linearisation_matches_a_numerical_jacobian(kernel: Kernel) -> None:
    """Over 1 ms, a pass and the matrix exponential differ by the fifth-order error of the integration,
    (20/s 1 ms)^5 / 120, and by the error of the differences, 1e-9 of the largest entry, 1e3/s^2, times 1 ms."""
    step, states = 1e-3, len(kernel.states)
    time = step * np.arange(2)
    held = np.tile([0.0, 0.0, TILT_STD], (2, 1))
    rest = Segment(time, np.repeat(time[:, None], 3, axis=1), held, np.full((2, 6), np.nan))
    for tilt in (0.0, math.pi):
        initial = np.zeros(states)
        initial[0] = tilt
        columns = len(kernel.parameters) + np.arange(states)
        memory = kernel.memory(initial, columns)
        kernel.proceed(rest, kernel.vector(), memory, None, columns, np.empty((2, 6)), np.empty((2, 6, states)))
        expected = expm(_matrix(tilt) * step)
        assert np.max(np.abs(memory.S - expected)) < 1e-8


def test_kernel_sensitivities_match_central_differences(kernel: Kernel) -> None:
    """For every parameter and initial state; central differences are accurate to 1e-7 of the largest slope here."""
    source = np.random.default_rng(4)
    time = 5e-3 * np.arange(60)
    knots = np.repeat(time[:, None] - 1e-3, 3, axis=1)
    inputs = np.column_stack((source.uniform(-6.0, 6.0, (60, 2)), np.full(60, TILT_STD)))
    segment = Segment(time, knots, inputs, np.full((60, 6), np.nan))
    values = kernel.vector({"voltage_offset": 2e-3})
    unknowns = np.concatenate((values, [0.2, 1.0, 0.3, 10.0, -0.2, 20.0, 1e-3, 1e-3, 1e-3]))
    sizes = np.concatenate(
        ([p.value or p.typical for p in TWSBR.parameters], [0.1, 1.0, 1.0, 10.0, 1.0, 10.0, 1e-2, 1e-2, 1e-2])
    )

    def predicted(unknowns: Array) -> Array:
        return kernel.run(segment, unknowns[: len(values)], unknowns[len(values) :]).predicted

    exact = kernel.run(segment, values, unknowns[len(values) :], active=range(len(unknowns))).sensitivity
    for place, size in enumerate(sizes):
        step = np.zeros(len(unknowns))
        step[place] = 1e-4 * size
        slope = (predicted(unknowns + step) - predicted(unknowns - step)) / 2e-4
        largest = np.max(np.abs(slope))
        if place < len(values) and kernel.parameters[place] == "armature_inductance":
            assert largest == 0.0
            continue
        assert np.max(np.abs(exact[:, :, place] * size - slope)) < 1e-6 * largest, place


# --- the shipped model


def test_model_library_imports_without_sympy_numba_or_scipy() -> None:
    code = "import sys, upright.models.library; assert not {'sympy', 'numba', 'scipy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).resolve().parents[3], timeout=60)


def test_paper_values_are_within_the_bounds_and_model_channels_are_recorded() -> None:
    for name, value in TABLE_3.items():
        parameter = TWSBR.parameter(name)
        assert parameter.lower < parameter.value < parameter.upper
        assert parameter.lower < value < parameter.upper
    used = [each.name for each in (*TWSBR.inputs, *TWSBR.outputs)]
    assert set(used) < set(CHANNELS.names)
    units = {channel.name: channel.unit for channel in CHANNELS}
    assert all(each.unit == units[each.name] for each in (*TWSBR.inputs, *TWSBR.outputs))
