"""The catalogue of effects: each vanishes at amplitude zero, obeys physics, and explains its hidden counterpart."""

from __future__ import annotations

import math
import runpy
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sympy

from upright.models.attach import starts
from upright.models.compiler.equations import compose
from upright.models.compiler.kernel import Kernel, compile_model
from upright.models.effect import Effect, Family
from upright.models.effects.catalogue import CATALOGUE, families, find
from upright.models.file.effect_rules import validate
from upright.models.library import get
from upright.models.library.axis import axis
from upright.models.model import Model
from upright.models.parts import ModelError, Place, Sensor
from upright.models.segment import Segment
from upright.models.sensing import FILTERED
from upright.models.text.expressions import number
from upright.simulation.monocab.hidden import HIDDEN
from upright.simulation.monocab.roll_effects import roll_effects
from upright.simulation.physics.friction import BRISTLE_DEFLECTION
from upright.simulation.physics.input_effects import input_effects

REPOSITORY = Path(__file__).resolve().parents[2]
markdown = runpy.run_path(str(REPOSITORY / "docs" / "reference" / "effects_page.py"))["markdown"]
MONOCAB = get("monocab_reduced")
DISSIPATIVE = {
    "viscous_friction",
    "quadratic_drag",
    "coulomb_friction",
    "stribeck_friction",
    "load_dependent_friction",
    "asymmetric_friction",
    "hysteresis",
}
TIMES_AND_WIDTHS = {"end_stop", "backlash", "input_deadband", "input_delay", "actuator_lag", "flexible_mode"}
EITHER_SIGN = set(CATALOGUE) - DISSIPATIVE - TIMES_AND_WIDTHS - {"gimbal_angle_coupling", "sensor_lag", "sensor_delay"}

Array = np.ndarray
ARRAY_FUNCTIONS = {name: getattr(np, name) for name in ("sin", "cos", "tanh", "exp", "abs", "sign")} | {
    "max": np.maximum,
    "min": np.minimum,
    "pi": np.pi,
}


def for_each_effect(names: object = CATALOGUE) -> Callable[[Callable[..., None]], Callable[..., None]]:
    return pytest.mark.parametrize("name", sorted(names))  # type: ignore[call-overload]


def values_at(text: str, names: Mapping[str, object]) -> Array:
    """`text` with arrays for its names: an evaluator independent of the project's. The texts are trusted."""
    return eval(text, {"__builtins__": {}}, {**ARRAY_FUNCTIONS, **names})


# --- the catalogue as a list


def test_catalogue_has_all_effects_of_the_virtual_vehicle_and_gravity_nonlinearity() -> None:
    assert set(CATALOGUE) == {*HIDDEN, "gravity_nonlinearity"}
    assert all(name == effect.name for name, effect in CATALOGUE.items())


def test_every_effect_is_in_exactly_one_family() -> None:
    assert list(families()) == list(Family)
    assert all(families().values())
    assert sorted(e.name for effects in families().values() for e in effects) == sorted(CATALOGUE)


def test_misspelt_effect_name_is_answered_with_similar_names() -> None:
    assert find("backlash") is CATALOGUE["backlash"]
    with pytest.raises(ModelError, match="did you mean coulomb_friction") as caught:
        find("columb_friction")
    assert caught.value.where == "effect columb_friction"
    with pytest.raises(ModelError, match="use one of: static_torque, "):
        MONOCAB.add("xyz")


def test_importing_effects_loads_neither_sympy_nor_numba_nor_scipy() -> None:
    code = "import sys, upright.models.file.own_effects;assert not {'sympy', 'numba', 'scipy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=REPOSITORY, timeout=60)


def test_reference_page_is_the_one_generated_from_the_catalogue() -> None:
    page = (REPOSITORY / "docs" / "reference" / "effects.md").read_text()
    assert page == markdown(), "write it again: python docs/reference/effects_page.py > docs/reference/effects.md"


@for_each_effect()
def test_every_effect_is_documented_and_confusions_are_listed_mutually(name: str) -> None:
    effect = CATALOGUE[name]
    validate(effect)
    assert all((effect.title, effect.equation, effect.signature, effect.confused_with, effect.separated_by))
    assert effect.source
    assert all(parameter.meaning for parameter in effect.parameters)
    for other in effect.confused_with:
        assert name in CATALOGUE[other].confused_with, f"{other} is not said to be confused with {name}"


# --- in a model


@for_each_effect()
def test_units_scales_and_bounds_resolve_on_the_monocab(name: str) -> None:
    attached = MONOCAB.add(name).effects[0]
    assert attached.amplitudes
    for parameter in attached.parameters:
        assert parameter.name.startswith(f"{name}.")
        assert "{" not in parameter.unit
        assert parameter.scale > 0.0
        assert parameter.lower <= parameter.value <= parameter.upper
        assert parameter.estimated == (parameter.name in attached.amplitudes)
        assert parameter.value == 0.0 or not parameter.estimated
        local = parameter.name.removeprefix(f"{name}.")
        assert all(parameter.lower <= start <= parameter.upper for start in starts(MONOCAB, attached, local))
    if name in HIDDEN:
        units = [parameter.unit for parameter in attached.parameters if parameter.name in attached.amplitudes]
        assert set(units) == {HIDDEN[name].unit}


@for_each_effect()
def test_lower_bounds_allow_only_physical_signs(name: str) -> None:
    attached = MONOCAB.add(name).effects[0]
    lower = [parameter.lower for parameter in attached.parameters if parameter.name in attached.amplitudes]
    assert all(each < 0.0 if name in EITHER_SIGN else each == 0.0 for each in lower)
    if name in HIDDEN:
        assert HIDDEN[name].signed <= (name in EITHER_SIGN)


def _functions(model: Model) -> Callable[..., list[float]]:
    equations = compose(model)
    arguments = (equations.time, *equations.states, *equations.inputs, *equations.slopes, *equations.parameters)
    function = sympy.lambdify(
        arguments,
        [*equations.derivatives, *equations.outputs],
        modules=[{"Signum": np.sign, "Magnitude": abs}, "numpy"],
    )

    def compute(values: Mapping[str, float]) -> list[float]:
        return [float(each) for each in function(*(values[symbol.name] for symbol in arguments))]

    return compute


@for_each_effect()
def test_effect_of_amplitude_zero_leaves_the_equations_unchanged(name: str) -> None:
    extended = MONOCAB.add(name)
    bare, full = _functions(MONOCAB), _functions(extended)
    source = np.random.default_rng(1)
    for _ in range(5):
        values = {**extended.values, "time": source.uniform(0.0, 30.0)}
        values |= {state.name: source.normal(0.0, 0.3) for state in extended.states}
        # A filter without an error stays at rest.
        values |= {f"{name}.{state}": 0.0 for state in FILTERED}
        values |= {each.name: source.normal(0.0, 0.3) for each in MONOCAB.inputs}
        values |= {f"{each.name}_slope": source.normal() for each in MONOCAB.inputs}
        computed, expected = full(values), bare(values)
        states = len(MONOCAB.base_states)
        memory = len(extended.states) - states
        assert computed[:states] + computed[states + memory :] == pytest.approx(expected, rel=1e-12, abs=1e-15)


@for_each_effect(DISSIPATIVE - {"hysteresis"})
def test_friction_and_drag_never_supply_power(name: str) -> None:
    effect = CATALOGUE[name]
    source = np.random.default_rng(2)
    for _ in range(300):
        names = {"rate": source.normal(), "actuator_rate": source.normal(), "gain": source.normal(0.0, 3000.0)}
        sizes = {parameter.name: abs(source.normal()) for parameter in effect.parameters}
        force = number(effect.force, {**names, **sizes, "sliding": source.uniform(), "smooth_rate": 0.01})
        assert force * names["rate"] <= 0.0


def _state_history(effect: Effect, names: dict[str, object], rate: Array, step: float) -> Array:
    """The only state of an effect at the start of each step, by the midpoint rule with four substeps."""
    (state,) = effect.states
    derivative = compile(state.derivative, state.name, "eval")
    here = {"__builtins__": {}, **names, "abs": abs}
    z, path = 0.0, np.empty_like(rate)
    for k, each in enumerate(rate.tolist()):
        path[k] = z
        here["rate"] = here["actuator_rate"] = each
        for _ in range(4):
            here[state.name] = z
            here[state.name] = z + 0.125 * step * eval(derivative, here)
            z += 0.25 * step * eval(derivative, here)
    return path


def test_hysteresis_is_passive_and_dissipates_energy_in_every_loop() -> None:
    effect, step = CATALOGUE["hysteresis"], 1e-3
    time = np.arange(0.0, 4.0, step)
    sizes: dict[str, object] = {"torque": 60.0, "yield_travel": 0.002}
    source = np.random.default_rng(3)
    for scale in (1e-3, 1e-2):
        wandering = scale * sum(
            source.normal() * np.sin(2 * np.pi * f * time + source.uniform(0, 6)) for f in (0.5, 1.3, 3.1)
        )
        rate = np.gradient(wandering, step)
        force = values_at(effect.force, {**sizes, "z": _state_history(effect, sizes, rate, step)})
        supplied = np.cumsum(-0.5 * (force[1:] + force[:-1]) * rate[:-1]) * step  # z moved at rate[k] from k to k + 1
        assert supplied.min() > -1e-9 * supplied.max()
    periods = [slice(k * 1000, (k + 1) * 1000) for k in (1, 2, 3)]
    rate = 2 * np.pi * 0.01 * np.cos(2 * np.pi * time)
    force = values_at(effect.force, {**sizes, "z": _state_history(effect, sizes, rate, step)})
    dissipated = [float(np.sum(-force[period] * rate[period]) * step) for period in periods]
    # A loop through +-10 mrad, far beyond the yield travel, dissipates nearly the rectangle, 4 x 60 N m x 10 mrad.
    assert dissipated[1:] == pytest.approx(dissipated[:-1], rel=1e-3)
    assert 0.75 * 2.4 < dissipated[0] < 2.4


# --- compared with the virtual vehicle's hidden effects, which are implemented independently


STEP = 1e-3


def _record() -> tuple[Array, Array, Array, Array]:
    """Time, roll, roll rate and precession of a balanced MONOCAB under an excitation that begins gently."""
    time = np.arange(0.0, 20.0, STEP)
    roll = 0.012 * np.sin(2 * np.pi * 0.31 * time) + 0.004 * np.sin(2 * np.pi * 0.83 * time + 1.0)
    roll *= np.minimum(time, 1.0) ** 2
    precession = 0.15 * np.sin(2 * np.pi * 0.23 * time) + 0.05
    return time, roll, np.gradient(roll, time), precession


SHAPES = {
    "end_stop": {"gap": math.radians(0.5)},
    "torque_step": {"start": 8.0},
    "torque_drift": {"time_constant": 45.0},
    "periodic_disturbance": {"frequency": 1.3},
    "position_cogging": {"pitch": 5e-3},
}
HIDDEN_TORQUES = sorted(
    name for name in HIDDEN if CATALOGUE[name].place is Place.JOINT and name not in ("flexible_mode", "backlash")
)


@pytest.mark.parametrize("name", [name for name in HIDDEN_TORQUES if name != "gimbal_angle_coupling"])
def test_effect_explains_the_hidden_torque_of_the_same_name(name: str) -> None:
    effect, size = CATALOGUE[name], HIDDEN[name].size
    time, roll, rate, precession = _record()
    precession_rate = np.gradient(precession, time)
    (hidden,) = roll_effects({name: size}, inertia=1600.0, onsets={"torque_step": 8.0})
    plant = SimpleNamespace(step_size=STEP)
    torque = np.empty_like(time)
    for k in range(len(time)):
        plant.time = plant.event_clock = time[k]
        plant.roll, plant.roll_rate, plant.gyroscopic_torque = roll[k], rate[k], 3300.0 * precession_rate[k]
        plant.gimbals = [SimpleNamespace(angle=precession[k])] * 2
        torque[k] = hidden.torque(plant)  # type: ignore[arg-type]
    attached = MONOCAB.add(name).effects[0]
    names: dict[str, object] = {p.name.removeprefix(f"{name}."): p.value for p in attached.parameters}
    names |= SHAPES.get(name, {})
    if effect.states:
        names["z"] = _state_history(effect, names, rate, STEP)
    names |= {"coordinate": roll, "rate": rate, "time": time, "smooth_rate": 1e-3, "gain": 3300.0}
    names |= {"actuator_rate": precession_rate, "actuator_angle": precession}
    columns = [
        values_at(effect.force, {**names, **dict.fromkeys(effect.amplitudes, 0.0), amplitude: 1.0}) * np.ones_like(time)
        for amplitude in effect.amplitudes
    ]
    fitted, *_ = np.linalg.lstsq(np.column_stack(columns), torque, rcond=None)
    residual = torque - np.column_stack(columns) @ fitted
    # The hidden friction has damped bristles that bend by 0.1 mrad at each reversal; the catalogue's has no state.
    unexplained = 0.08 if effect.family is Family.DRY_FRICTION else 1e-3
    assert float(residual @ residual) < unexplained * float(torque @ torque)
    assert np.max(np.abs(fitted)) == pytest.approx(abs(size), rel=0.1)
    assert 0.05 * np.ptp(roll) > BRISTLE_DEFLECTION, "or the motion would be too small to slide"


@pytest.mark.parametrize("name", ["input_gain", "input_asymmetry", "input_deadband"])
def test_effect_changes_a_command_as_the_virtual_vehicle_does(name: str) -> None:
    size = HIDDEN[name].size
    (hidden,) = input_effects({name: size}, 1e-3)
    command = np.linspace(-0.1, 0.1, 41)
    (amplitude,) = CATALOGUE[name].amplitudes
    acting = values_at(CATALOGUE[name].command, {"command": command, amplitude: size})
    assert acting == pytest.approx([hidden(each) for each in command], abs=1e-15)


# --- where an effect is refused


def _refused(model: Model, name: str, what: str, at: str = "") -> None:
    with pytest.raises(ModelError, match=what) as caught:
        model.add(name, at)
    assert caught.value.remedy


def test_effect_is_refused_where_the_model_lacks_what_it_needs() -> None:
    bare = get("axis")
    _refused(bare, "backlash", "needs actuator_rate, gain, which joint axis does not have")
    _refused(bare, "gimbal_imbalance", "needs actuator_angle, which joint axis")
    _refused(bare, "gravity_nonlinearity", "needs coordinate in rad, which joint axis")
    _refused(bare, "gyro_bias", "needs rate, which sensor encoder")
    _refused(replace(bare, sensors=()), "sensor_lag", "needs a sensor, but the model has none")
    _refused(replace(bare, actuators=()), "input_delay", "needs an actuator, but the model has none")
    _refused(bare, "coulomb_friction", "there is no joint 'wheel'", at="wheel")
    _refused(bare.add("coulomb_friction"), "coulomb_friction", "has it already")
    rate_only = replace(bare, sensors=(Sensor("gyro", rate="position"),))
    _refused(rate_only, "sensor_offset", "needs angle, which sensor gyro")


def test_sensor_delay_acts_on_a_sensor_without_a_rate() -> None:
    shifted = compose(replace(axis(rate_measured=True), sensors=get("axis").sensors).add("sensor_delay"))
    delay = next(symbol for symbol in shifted.parameters if symbol.name == "sensor_delay.delay")
    assert shifted.outputs[0].diff(delay) != 0


def test_effect_is_named_with_its_place_unless_that_is_the_first_suitable_one() -> None:
    rated = axis(rate_measured=True)
    encoder = Sensor("encoder", angle="position")
    two = replace(rated, sensors=(encoder, replace(rated.sensors[0], name="gyro")))
    assert two.add("gyro_bias").effects[0].name == "gyro_bias"
    assert two.add("gyro_bias").effects[0].at == "gyro"
    both = two.add("sensor_lag").add("sensor_lag", "gyro")
    assert [attached.name for attached in both.effects] == ["sensor_lag", "sensor_lag@gyro"]
    assert both.effects[1].amplitudes == ("sensor_lag@gyro.lag",)
    _refused(two, "gyro_bias", "attach it at gyro", at="encoder")


def test_units_of_effects_follow_the_joint() -> None:
    cart = get("axis").add("viscous_friction").add("cubic_stiffness").add("input_deadband")
    units = {parameter.name: parameter.unit for parameter in cart.parameters}
    assert units["viscous_friction.coefficient"] == "N s/m"
    assert units["cubic_stiffness.coefficient"] == "N/m^3"
    assert units["input_deadband.width"] == "N"


def test_start_values_scale_with_the_place_and_need_a_known_parameter() -> None:
    model = MONOCAB.add("end_stop")
    assert starts(model, model.effects[0], "gap") == pytest.approx((0.01, 0.02 / 30, 0.002, 0.004, 0.02, 0.04))
    with pytest.raises(ModelError, match="there is no parameter 'width'"):
        starts(model, model.effects[0], "width")


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ({"force": "-torque * wind"}, "there is no 'wind'"),
        ({"command": "command"}, "is on a joint, where command has no meaning"),
        ({"force": ""}, "does nothing"),
        ({"place": Place.ACTUATOR, "force": "", "delay": "later"}, "there is no parameter 'later'"),
        ({"parameters": (replace(CATALOGUE["static_torque"].parameters[0], unit="{furlong}"),)}, "cannot be filled in"),
    ],
)
def test_inconsistent_effect_is_not_attached(change: dict[str, object], what: str) -> None:
    effect = replace(CATALOGUE["static_torque"], **change)  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=what):
        MONOCAB.add(effect)


# --- derivatives, with all effects in one kernel


@pytest.fixture(scope="module")
def full_kernel() -> tuple[Model, Kernel]:
    model = MONOCAB
    for name in CATALOGUE:
        model = model.add(name)
    return model, compile_model(model)


def _segment(model: Model, rows: int = 80, *, moving: bool = True) -> Segment:
    """An excitation that activates every effect: large, fast, of both signs, within a third of a second."""
    source = np.random.default_rng(4)
    time = 0.004 * np.arange(rows)
    phase = 5.0 * time if moving else np.ones(rows)
    smooth = {
        "precession": 0.3 + 0.1 * np.sin(2.0 * phase),
        "trim_position": 0.01 * np.sin(phase),
        "trim_rate": 0.05 * np.cos(phase),
        "gyro_bias_std": np.full(rows, 6.9e-4),
    }
    held = np.repeat(source.uniform(-0.3, 0.3, rows // 10), 10)
    inputs = np.column_stack([smooth.get(each.name, held) for each in model.inputs])
    knots = np.repeat(time[:, None], len(model.inputs), axis=1).copy()
    return Segment(time, knots, np.ascontiguousarray(inputs), np.full((rows, len(model.outputs)), np.nan))


FAST_SHAPES = {"torque_step.start": 0.1, "torque_step.rise": 0.1, "torque_drift.time_constant": 0.5}
"""Values of shape parameters that have an influence within a third of a second."""


def _initial(kernel: Kernel) -> Array:
    start = {"roll": 0.013, "roll_rate": -0.03, "precession_rate": 0.1}
    return np.array([start.get(state, 0.0) for state in kernel.states])


@pytest.mark.timeout(600)
def test_all_effects_together_have_no_influence_at_zero(full_kernel: tuple[Model, Kernel]) -> None:
    model, kernel = full_kernel
    bare = compile_model(MONOCAB)
    segment = _segment(model)
    expected = bare.run(segment, bare.vector(), _initial(bare)).predicted
    assert np.ptp(expected[:, 0]) > 1e-3
    computed = kernel.run(segment, kernel.vector(), _initial(kernel)).predicted
    assert computed == pytest.approx(expected, rel=1e-12, abs=1e-15)


@for_each_effect()
@pytest.mark.timeout(600)
def test_sensitivities_are_derivatives_at_zero_and_nonzero_amplitudes(
    name: str, full_kernel: tuple[Model, Kernel]
) -> None:
    model, kernel = full_kernel
    attached = next(each for each in model.effects if each.name == name)
    # Smooth inputs with a delay that moves a switch within a step are a matter of the kernel's own tests.
    segment, initial = _segment(model, moving=name != "input_delay"), _initial(kernel)
    for size in (0.0, 1.0):
        present = {p.name: size * p.scale for p in attached.parameters if p.name in attached.amplitudes}
        values = kernel.vector({**FAST_SHAPES, **present})
        tested = [p for p in attached.parameters if size or p.name in attached.amplitudes]
        active = [kernel.index(parameter.name) for parameter in tested]
        exact = kernel.run(segment, values, initial, active=active).sensitivity
        for column, parameter in enumerate(tested):
            step = 1e-4 * parameter.scale

            def shifted(by: float, place: int = active[column], values: Array = values) -> Array:
                moved = values.copy()
                moved[place] += by
                return kernel.run(segment, moved, initial).predicted

            if size or parameter.lower < 0.0:
                slope = (shifted(step) - shifted(-step)) / (2.0 * step)
            else:  # physics ends at zero: a one-sided formula of the same order
                slope = (4.0 * shifted(step) - shifted(2.0 * step) - 3.0 * shifted(0.0)) / (2.0 * step)
            largest = np.max(np.abs(slope))
            assert largest > 0.0, f"{parameter.name} cannot be seen"
            assert np.max(np.abs(exact[:, :, column] - slope)) < 1e-5 * largest, parameter.name
