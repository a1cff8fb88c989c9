"""Compiled models: a pass predicts correctly, and its sensitivities are the derivatives of its predictions.

At the steps used here, central differences of a pass in float64 are accurate to about 1e-9 of the largest slope; the
bound of 1e-6 leaves room for curvature.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from small_model import GAIN, INITIAL, PLANT, ROWS, SHIFTED, segment

from upright.models.compiler.curves import read
from upright.models.compiler.kernel import Kernel, compile_model
from upright.models.model import Model
from upright.models.parts import Hold, Input, ModelError, Output, Parameter, State
from upright.models.segment import Segment
from upright.models.text.expressions import number

Array = NDArray[np.float64]

NEUTRAL = replace(
    PLANT,
    inputs=tuple(replace(each, delays=(), lag="") for each in PLANT.inputs),
    base_parameters=PLANT.base_parameters[:4],
)


@pytest.fixture(scope="module")
def plant() -> Kernel:
    return compile_model(PLANT)


def predicted(kernel: Kernel, data: Segment, unknowns: Array, substeps: int = 1) -> Array:
    """A pass with `unknowns`: parameters, initial state and gain in one vector."""
    values, initial, gain = np.split(unknowns, np.cumsum([len(kernel.parameters), len(kernel.states)]))
    return kernel.run(data, values, initial, gain=gain.reshape(GAIN.shape), substeps=substeps).predicted


def assert_exact(kernel: Kernel, data: Segment, sided: Sequence[str] = (), substeps: int = 1, **given: float) -> None:
    """Every sensitivity equals a second-order difference, one-sided (from above) for the parameters in `sided`."""
    values = kernel.vector(given)
    everything = np.concatenate((values, INITIAL, GAIN.ravel()))
    active = range(len(everything))
    exact = kernel.run(data, values, INITIAL, gain=GAIN, active=active, substeps=substeps).sensitivity
    for place in active:
        name = kernel.parameters[place] if place < len(kernel.parameters) else f"unknown {place}"
        size = 1e-7 if name in sided else 1e-6
        step = np.zeros_like(everything)
        step[place] = size

        def at(steps: float, step: Array = step) -> Array:
            return predicted(kernel, data, everything + steps * step, substeps)

        if name in sided:
            slope = (4.0 * at(1.0) - at(2.0) - 3.0 * at(0.0)) / (2.0 * size)
        else:
            slope = (at(1.0) - at(-1.0)) / (2.0 * size)
        largest = np.max(np.abs(slope))
        assert largest > 1e-4, f"{name} cannot be seen"
        assert np.max(np.abs(exact[:, :, place] - slope)) < 1e-6 * max(largest, 1.0), name


# --- derivatives


SHIFTED |= {"motor_lag": 0.013, "wind_lag": 0.021}


@pytest.mark.parametrize("substeps", [1, 3])
def test_sensitivities_with_all_delays_and_lags(plant: Kernel, substeps: int) -> None:
    assert_exact(plant, segment(), substeps=substeps, **SHIFTED)


def test_sensitivities_at_negative_delays_without_lags(plant: Kernel) -> None:
    lags = ("motor_lag", "wind_lag")
    moved = {"push_delay": -0.0034, "both_delay": -0.0021, "wind_delay": -0.0057, "seen_delay": -0.002}
    assert_exact(plant, segment(), sided=lags, **moved)


def test_sensitivities_where_held_inputs_change_exactly_at_a_sample(plant: Kernel) -> None:
    # At delay 0 a change at a sample acts from there on; at a negative delay it also affects that sample's prediction.
    delays, lags = ("push_delay", "both_delay"), ("motor_lag", "wind_lag")
    moved = {"wind_delay": 0.003, "seen_delay": 0.003}
    assert_exact(plant, segment(regular=True), sided=(*delays, *lags), **moved)
    assert_exact(plant, segment(regular=True), sided=delays, motor_lag=0.02, wind_lag=0.03, **moved)


def test_sensitivities_where_a_delay_is_a_whole_sampling_interval(plant: Kernel) -> None:
    delays = {"push_delay": 0.0, "both_delay": 1.0 / 128.0}
    assert_exact(plant, segment(regular=True), sided=tuple(delays), **{**SHIFTED, **delays})


def test_active_columns_equal_those_of_the_full_sensitivity(plant: Kernel) -> None:
    values, size = plant.vector(SHIFTED), len(plant.parameters) + len(INITIAL) + GAIN.size
    whole = plant.run(segment(), values, INITIAL, gain=GAIN, active=range(size)).sensitivity
    some = [3, size - 1, 0, len(plant.parameters) + 1, 5]
    part = plant.run(segment(), values, INITIAL, gain=GAIN, active=some)
    assert np.array_equal(part.sensitivity, whole[:, :, some])
    assert np.array_equal(part.predicted, plant.run(segment(), values, INITIAL, gain=GAIN).predicted)


EXPRESSIONS = (
    "sin(a) + cos(b) + tan(a * b)",
    "asin(a / 2) + acos(b / 3) + atan(a - b)",
    "sinh(a) + cosh(b) + tanh(a * b)",
    "exp(-(a / b) ** 2) + log(a + b) + sqrt(a * b)",
    "abs(a - 1) * sign(b - a) + min(a, b) * max(a - 2, max(b, 0.1))",
    "a ** 3 - b ** -2 + a ** 0.5 + b ** 2.5 + a ** b - (a + b) ** 9 / 1e3 + 2 ** a",
    "1 / (1 + a) / b - pi * a / (3 - b) * 0.1",
    "min(a, b * x) - x",
)


def test_every_operation_has_the_right_value_and_derivatives() -> None:
    """Compared with the interpreter of models.text.expressions, which shares nothing with the compiler."""
    names = ("a", "b")
    model = Model(
        name="test-operations",
        title="",
        base_states=(State("x", "", "0 * x"),),
        inputs=(),
        outputs=tuple(Output(f"y{place}", "", text, noise=1.0) for place, text in enumerate(EXPRESSIONS)),
        base_parameters=tuple(Parameter(name, "", 1.0) for name in names),
    )
    kernel = compile_model(model)
    data = Segment(np.zeros(1), np.zeros((1, 0)), np.zeros((1, 0)), np.zeros((1, len(EXPRESSIONS))))
    for point in ({"a": 0.7, "b": 1.3}, {"a": 1.4, "b": 0.6}):
        run = kernel.run(data, kernel.vector(point), np.array([0.8]), active=(0, 1, 2))
        for place, text in enumerate(EXPRESSIONS):
            known = {**point, "x": 0.8}
            assert run.predicted[0, place] == pytest.approx(number(text, known), rel=1e-14), text
            for column, name in enumerate((*names, "x")):
                up, down = ({**known, name: known[name] + by} for by in (1e-6, -1e-6))
                slope = (number(text, up) - number(text, down)) / 2e-6
                assert run.sensitivity[0, place, column] == pytest.approx(slope, rel=1e-8, abs=1e-8), (text, name)


# --- values


def test_zero_lags_and_delays_give_bit_identical_results(plant: Kernel) -> None:
    bare = compile_model(NEUTRAL)
    for data in (segment(), segment(regular=True)):
        with_them = plant.run(data, plant.vector(), INITIAL, gain=GAIN, active=range(4))
        without = bare.run(data, bare.vector(), INITIAL, gain=GAIN, active=range(4))
        assert np.array_equal(with_them.predicted, without.predicted)
        assert np.array_equal(with_them.sensitivity, without.sensitivity)


def cart(hold: Hold, *, lag: float = 0.0, delay: float = 0.0) -> tuple[Kernel, Array]:
    """A free mass of 1 kg: rate and position are the integrals of the force."""
    force = Input("force", "N", hold, delays=("delay",), lag="lag")
    model = Model(
        name="test-cart",
        title="",
        base_states=(State("x", "m", "v"), State("v", "m/s", "force")),
        inputs=(force,),
        outputs=(Output("position", "m", "x", noise=1.0), Output("rate", "m/s", "v", noise=1.0)),
        base_parameters=(Parameter("delay", "s", delay), Parameter("lag", "s", lag)),
    )
    return compile_model(model), np.array([delay, lag])


TIME = 0.1 * np.arange(40)
KNOTS = np.array([-0.05, 0.33, 0.34, 1.0, 2.5])
FORCES = np.array([1.0, -2.0, 3.0, 0.5, -1.0])


def cart_segment(knots: Array, forces: Array) -> Segment:
    """Beyond the last knot its force is held."""
    later = TIME[-1] + 1.0 + np.arange(len(TIME) - len(knots))
    column = np.concatenate((knots, later))[:, None]
    filled = np.concatenate((forces, np.full(len(later), forces[-1])))[:, None]
    return Segment(TIME, column, filled, np.zeros((len(TIME), 2)))


@pytest.mark.parametrize("delay", [0.0, 0.123])
def test_held_force_is_integrated_exactly(delay: float) -> None:
    kernel, values = cart(Hold.ZERO_ORDER, delay=delay)
    run = kernel.run(cart_segment(KNOTS, FORCES), values, np.array([0.3, -0.2]))
    jumps = np.diff(FORCES)
    since = np.maximum(TIME[:, None] - KNOTS[1:] - delay, 0.0)
    rate = -0.2 + FORCES[0] * TIME + since @ jumps
    position = 0.3 - 0.2 * TIME + 0.5 * FORCES[0] * TIME**2 + 0.5 * since**2 @ jumps
    assert run.predicted == pytest.approx(np.column_stack((position, rate)), abs=1e-13)


@pytest.mark.parametrize("hold", Hold)
@pytest.mark.parametrize("delay", [-0.05, 0.123, 0.9])
def test_inputs_before_the_first_sample_still_act(hold: Hold, delay: float) -> None:
    """A segment that begins later, from the state of the whole one at that time, continues identically."""
    kernel, values = cart(hold, delay=delay)
    whole = cart_segment(KNOTS, FORCES)
    expected = kernel.run(whole, values, np.array([0.3, -0.2])).predicted[15:]
    part = Segment(TIME[15:], whole.knots, whole.inputs, whole.measured[15:])
    assert part.earlier == 15
    assert np.shares_memory(part.row_inputs, part.inputs)
    assert kernel.run(part, values, expected[0]).predicted == pytest.approx(expected, abs=1e-12)


def sampled_cart_segment(knots: Array, forces: Array) -> Segment:
    """One sample of the force for each sample of the segment."""
    return Segment(TIME, knots[:, None].copy(), forces[:, None].copy(), np.zeros((len(TIME), 2)))


def test_measured_force_is_integrated_along_its_interpolating_curve() -> None:
    """SciPy makes this curve from the slopes of parabolas; Simpson's rule is exact for its cubics."""
    forces = np.sin(TIME) + np.cos(3.0 * TIME)
    kernel, values = cart(Hold.CUBIC)
    run = kernel.run(sampled_cart_segment(TIME, forces), values, np.zeros(2))
    chords = np.diff(forces) / 0.1
    slopes = np.concatenate((chords[:1], 0.5 * (chords[1:] + chords[:-1]), chords[-1:]))
    rate = CubicHermiteSpline(TIME, forces, slopes).antiderivative()
    assert run.predicted[:, 1] == pytest.approx(rate(TIME), abs=1e-13)
    # Integrated twice, it has fifth degree; per step, Runge-Kutta misses h^5 / 720 times the force's third derivative.
    # That is 28 at most for the force, and three times as much for these cubics.
    assert run.predicted[:, 0] == pytest.approx(rate.antiderivative()(TIME), abs=len(TIME) * 0.1**5 / 720 * 84.0)


@pytest.mark.parametrize("before", [0.0, 0.25, 0.5, 0.9])
def test_force_sampled_a_fraction_of_an_interval_earlier_is_as_accurate(before: float) -> None:
    """A sine with 31 samples per period. Half an interval earlier, straight lines would err by (w h)^2 / 24, 0.17 %."""
    kernel, values = cart(Hold.CUBIC)
    w = 2.0
    knots = TIME - 0.1 * before
    rate = kernel.run(sampled_cart_segment(knots, np.sin(w * knots)), values, np.zeros(2)).predicted[:, 1]
    inner = slice(2, -3)  # at either end there is no parabola for the slope
    expected = (1.0 - np.cos(w * TIME)) / w
    error = rate - expected
    assert np.ptp(error[inner]) < 0.5 * (0.1 * w) ** 3 / 24.0 / w


def test_pass_integrates_the_curve_of_the_interpolation() -> None:
    """Also for unequally spaced knots."""
    kernel, values = cart(Hold.CUBIC)
    source = np.random.default_rng(4)
    knots = TIME + source.uniform(0.0, 0.08, len(TIME))
    forces = source.normal(size=len(TIME))
    fine = np.linspace(knots[0], knots[-1], 4001)
    rate = kernel.run(sampled_cart_segment(knots, forces), values, np.zeros(2), substeps=64).predicted[:, 1]
    drawn = read(fine, knots, forces)
    through = np.concatenate(([0.0], np.cumsum(0.5 * (drawn[1:] + drawn[:-1]) * np.diff(fine))))
    inside = (knots[0] < TIME) & (knots[-1] > TIME)
    expected = forces[0] * knots[0] + np.interp(TIME, fine, through)
    # Trapezoids of one millisecond and linear interpolation: a second derivative of some hundreds times h^2 / 8.
    assert rate[inside] == pytest.approx(expected[inside], abs=1e-4)


@pytest.mark.parametrize("lag", [0.0, 0.004, 0.25, 3.0])
def test_lag_responds_exactly_to_steps(lag: float) -> None:
    """The integral of the lagged force is that of the force, less lag times the rise of the lagged force."""
    kernel, values = cart(Hold.ZERO_ORDER, lag=lag)
    rate = kernel.run(cart_segment(KNOTS, FORCES), values, np.zeros(2)).predicted[:, 1]
    since = np.maximum(TIME[:, None] - KNOTS[1:], 0.0)
    through = 1.0 - np.exp(-since / lag) if lag else (since > 0.0).astype(float)
    expected = FORCES[0] * TIME + (since - lag * through) @ np.diff(FORCES)
    assert rate == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("lag", [0.004, 0.25, 3.0])
def test_position_driven_through_a_lag_is_exact(lag: float) -> None:
    """Within a step, the lagged force is a straight line of the same mean and the same first moment."""
    kernel, values = cart(Hold.ZERO_ORDER, lag=lag)
    position = kernel.run(cart_segment(KNOTS, FORCES), values, np.zeros(2)).predicted[:, 0]
    since = np.maximum(TIME[:, None] - KNOTS[1:], 0.0)
    through = 0.5 * since**2 - lag * since + lag**2 * (1.0 - np.exp(-since / lag))
    expected = 0.5 * FORCES[0] * TIME**2 + through @ np.diff(FORCES)
    assert position == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("delay", [-0.05, 0.123, 0.87])
@pytest.mark.parametrize("lag", [0.0, 0.004, 0.25, 3.0])
def test_lag_includes_the_inputs_held_before_the_first_sample(lag: float, delay: float) -> None:
    """A segment that begins later continues like the whole one, with the right sensitivities to lag and delay."""
    kernel, values = cart(Hold.ZERO_ORDER, lag=lag, delay=delay)
    whole = cart_segment(KNOTS, FORCES)
    expected = kernel.run(whole, values, np.array([0.3, -0.2])).predicted[15:]
    part = Segment(TIME[15:], whole.knots, whole.inputs, whole.measured[15:])
    begin = expected[0]
    assert kernel.run(part, values, begin).predicted == pytest.approx(expected, abs=1e-12)
    if lag:
        found = kernel.run(part, values, begin, active=(0, 1)).sensitivity
        for place, size in enumerate((1e-6, 1e-6 * lag)):
            step = np.where(np.arange(2) == place, size, 0.0)
            up, down = (kernel.run(part, values + sign * step, begin).predicted for sign in (1.0, -1.0))
            assert found[:, :, place] == pytest.approx((up - down) / (2.0 * size), abs=1e-5 / lag)


@pytest.mark.parametrize("lag", [0.0, 0.004, 0.25, 3.0])
def test_lag_responds_exactly_to_ramps(lag: float) -> None:
    """The ramp lasts from the first sample to the last."""
    kernel, values = cart(Hold.CUBIC, lag=lag)
    rate = kernel.run(sampled_cart_segment(TIME, 1.0 - 3.0 * TIME), values, np.zeros(2)).predicted[:, 1]
    through = TIME - lag * (1.0 - np.exp(-TIME / lag)) if lag else TIME
    expected = TIME - 3.0 * (0.5 * TIME**2 - lag * through)
    assert rate == pytest.approx(expected, abs=1e-12)


def test_integration_error_is_of_fourth_order(plant: Kernel) -> None:
    data = segment(regular=True, rows=40)
    data = replace(data, time=8.0 * data.time, knots=8.0 * data.knots)
    values = plant.vector()
    best = plant.run(data, values, INITIAL, substeps=64).predicted
    errors = [np.max(np.abs(plant.run(data, values, INITIAL, substeps=n).predicted - best)) for n in (8, 16)]
    assert 12.0 < errors[0] / errors[1] < 20.0  # 16 in the limit of small steps


def test_unmeasured_sample_corrects_nothing(plant: Kernel) -> None:
    data = segment(rows=3)
    unknown = replace(data, measured=np.array([[math.nan, math.nan], [0.1, math.nan], [0.0, 0.0]]))
    run = plant.run(unknown, plant.vector(), INITIAL, gain=GAIN, active=(0, 9))
    free = plant.run(data, plant.vector(), INITIAL, active=(0, 9))
    assert np.array_equal(run.predicted[:2], free.predicted[:2])
    assert np.array_equal(run.sensitivity[:2], free.sensitivity[:2])
    assert not np.any(run.predicted[2] == free.predicted[2])
    assert np.all(np.isfinite(run.sensitivity))


@pytest.mark.parametrize("given", [{}, SHIFTED], ids=["plain", "shifted"])
def test_pass_in_parts_gives_bit_identical_results(plant: Kernel, given: Mapping[str, float]) -> None:
    data, values, active = segment(), plant.vector(given), (0, 3, 4, 5, 6, 7, 8, 9, 12, 14)
    whole = plant.run(data, values, INITIAL, gain=GAIN, active=active)
    memory = plant.memory(INITIAL, active)
    outputs, sensitivity = np.full_like(whole.predicted, math.nan), np.full_like(whole.sensitivity, math.nan)
    ends = [0, 1, 2, 40, 41, 77, ROWS - 1]
    for first, last in zip([0, *ends], ends, strict=False):
        place = {"first": first, "last": last, "skip": first < last or first > 0}
        plant.proceed(data, values, memory, GAIN, active, outputs, sensitivity, **place)
    assert np.array_equal(outputs, whole.predicted)
    assert np.array_equal(sensitivity, whole.sensitivity)
    assert np.array_equal(memory.x, whole.final)


def test_diverging_state_raises_no_error() -> None:
    model = Model(
        name="test-runaway",
        title="",
        base_states=(State("x", "", "p * x + x**3"),),
        inputs=(),
        outputs=(Output("y", "", "x", noise=1.0),),
        base_parameters=(Parameter("p", "", 50.0),),
    )
    kernel = compile_model(model)
    data = Segment(0.1 * np.arange(400), np.zeros((400, 0)), np.zeros((400, 0)), np.zeros((400, 1)))
    run = kernel.run(data, kernel.vector(), np.array([0.1]), active=(0, 1))
    assert np.isfinite(run.predicted[0]).all()
    assert not np.isfinite(run.predicted[-1, 0])


# --- refused arguments


def test_unsuitable_arrays_columns_and_samples_are_refused(plant: Kernel) -> None:
    data, values = segment(rows=10), plant.vector()
    for wrong in (
        replace(data, time=data.time[:-1]),
        replace(data, knots=np.asfortranarray(data.knots)),
        replace(data, inputs=data.inputs[:, :2].copy()),
        replace(data, measured=data.measured.astype(np.float32)),
    ):
        with pytest.raises(ModelError, match="C-contiguous"):
            plant.run(wrong, values, INITIAL)
    with pytest.raises(ModelError, match="values"):
        plant.run(data, values[:-1], INITIAL)
    with pytest.raises(ModelError, match="state"):
        plant.run(data, values, INITIAL[:-1])
    with pytest.raises(ModelError, match="gain"):
        plant.run(data, values, INITIAL, gain=GAIN.T)
    for active in ((-2,), (len(values) + len(INITIAL) + GAIN.size,)):
        with pytest.raises(ModelError, match="are not possible"):
            plant.run(data, values, INITIAL, active=active)
    memory = plant.memory(INITIAL)
    with pytest.raises(ModelError, match="there are no samples"):
        plant.proceed(data, values, memory, None, (), np.empty((10, 2)), np.empty((10, 2, 0)), last=10)


def test_unknown_parameter_error_lists_the_parameters(plant: Kernel) -> None:
    with pytest.raises(ModelError, match=r"parameter mass.*use one of: m, k"):
        plant.vector({"mass": 1.0})
