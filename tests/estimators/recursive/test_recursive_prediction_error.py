"""Recursive prediction error on the virtual vehicle and on the small one, and tests of its parts.

The truth is the mechanical inertia, since the measured precession rate is the input.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from functools import cache

import golden
import numpy as np
import pytest
import small_vehicle
from monocab_channels import MONOCAB
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from upright.estimators.contract import Estimate, EstimationError, Status
from upright.estimators.data.segments import DataError, segments
from upright.estimators.fit.problem import jacobian
from upright.estimators.identify.run import with_values
from upright.estimators.methods.prediction_error import prediction_error
from upright.estimators.recursive.frame_chunks import Chunk, FrameChunks, join
from upright.estimators.recursive.gauss_newton import RecursiveGaussNewton
from upright.estimators.recursive.prediction_error import (
    GROWTH,
    WINDOW,
    Method,
    RecursivePredictionError,
    at_rest,
    longest_window,
)
from upright.models import library
from upright.models.model import Model
from upright.models.parts import Hold
from upright.service.observer.live.online_estimators import STARTING, EstimatorBank, online_estimators
from upright.telemetry.channels import ChannelTable
from upright.telemetry.recording import Recording
from upright.telemetry.samples import Frame
from upright.vehicles.file import load
from upright.vehicles.registry import channels_of, names, nominal_model

Array = NDArray[np.float64]

VEHICLE = load("monocab")
CAD, SPREAD = VEHICLE.parameters.values, VEHICLE.parameters.deviations
TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0}
ESTIMATED = [*TRUTH, "drive_offset", "static_torque.torque"]


def made(method: Method = Method.PREDICTION_ERROR, **changes: float) -> RecursivePredictionError:
    """An estimator of the shipped vehicle, with `changes` of its CAD values."""
    return RecursivePredictionError(
        nominal_model("monocab"),
        parameters={**CAD, **changes},
        deviations=SPREAD,
        support=VEHICLE.support,
        channels=MONOCAB,
        method=method,
    )


def after(estimator: RecursivePredictionError, frames: Iterable[Frame]) -> Estimate:
    for frame in frames:
        estimator.update(frame)
    return estimator.result()


@cache
def multisine() -> Recording:
    """15 s of a multisine, from rest to rest."""
    return golden.recorded("monocab", "multisine", seed=11, duration=15.0)


@cache
def frames() -> tuple[Frame, ...]:
    return tuple(multisine().frames(MONOCAB))


def changed(frame: Frame, **values: float) -> Frame:
    row = list(frame.values)
    for name, value in values.items():
        row[MONOCAB.index_of(name)] = value
    return Frame(frame.timestamp_ns, tuple(row))


def assert_near(estimate: Estimate, share: float = 0.01) -> None:
    for name, true in TRUTH.items():
        assert estimate.values[name] == pytest.approx(true, rel=share), name


# On the virtual vehicle, from the CAD values of its file


@pytest.mark.parametrize("method", Method)
def test_true_parameters_are_found_with_valid_standard_deviations(method: Method) -> None:
    estimate = after(made(method), frames())
    assert (estimate.method, estimate.status, estimate.reason) == (method.value, Status.OK, "")
    assert list(estimate.parameters) == ESTIMATED
    assert_near(estimate)
    for name, true in TRUTH.items():
        found = estimate.parameters[name]
        assert found.value is not None
        assert found.std is not None
        assert abs(found.value - true) < 1.96 * found.std, name
    # The angular momentum is known to 15 of 3300 N m s, which limits the parameters that are proportional to it.
    assert estimate.parameters["inertia"].std == pytest.approx(1650.0 * 15.0 / 3300.0, rel=0.15)
    assert 15.0 < estimate.span < multisine().duration


def test_final_result_matches_the_batch_fit() -> None:
    model = with_values(nominal_model("monocab"), CAD, SPREAD)
    batch = prediction_error(model, [multisine()], support=VEHICLE.support)
    live = after(made(), frames())
    for name in ESTIMATED:
        there, here = batch.parameters[name], live.parameters[name]
        assert there.value is not None
        assert here.value is not None
        assert there.std is not None
        # A quarter of a standard deviation, for the effect of 0.1 s more or less at the ends of the record.
        assert abs(here.value - there.value) < 0.25 * there.std, name
        assert here.std == pytest.approx(there.std, rel=0.2), name


@pytest.mark.parametrize(("inertia", "stiffness"), [(0.8, 1.2), (1.2, 0.8), (1.2, 1.2)])
def test_wrong_start_values_are_corrected_within_seconds(inertia: float, stiffness: float) -> None:
    """CAD values changed by 20 %, in different directions. After rise and settling (4 s) this is 6 s of multisine."""
    estimator = made(inertia=1450.0 * inertia, gravity_stiffness=12600.0 * stiffness)
    for frame in frames():
        estimator.update(frame)
        if frame.timestamp_ns % 500_000_000 < 4_000_000 and estimator.result().span > 10.0:
            break
    assert_near(estimator.result())


def test_no_intermediate_value_is_far_from_the_truth() -> None:
    estimator = made()
    shown = 0
    for place, frame in enumerate(frames()):
        estimator.update(frame)
        if place % 125 == 0:
            for name, true in TRUTH.items():
                found = estimator.result().parameters[name]
                assert (found.value is None) == (found.std is None) == (found.reason != "")
                if found.value is not None and found.std is not None:
                    shown += 1
                    assert abs(found.value - true) < 4.0 * found.std, f"{name} after {place} cycles"
    assert shown > 40


def test_same_cycles_after_a_reset_give_the_same_result_bit_for_bit() -> None:
    estimator = made()
    once = after(estimator, frames()[:5000])
    estimator.reset()
    assert estimator.result().status is Status.TOO_FEW_SAMPLES
    again = after(estimator, frames()[:5000])
    assert again.to_json() == once.to_json()
    assert again.samples > 1000


def _unknown(frames: Iterable[Frame]) -> list[Frame]:
    return [changed(f, roll_rate=math.nan) if i % 500 == 499 else f for i, f in enumerate(frames)]


def _gaps(frames: Iterable[Frame]) -> list[Frame]:
    return [f for i, f in enumerate(frames) if i % 700 > 20]


def _late(frames: Iterable[Frame]) -> list[Frame]:
    doubled = [pair for i, f in enumerate(frames) for pair in ((f, f) if i % 50 == 0 else (f,))]
    return [doubled[0], *doubled]


def _old_drives(frames: Iterable[Frame]) -> list[Frame]:
    return [changed(f, drive_age=5.0) if i % 900 < 5 else f for i, f in enumerate(frames)]


@pytest.mark.parametrize("damage", [_unknown, _gaps, _late, _old_drives])
@pytest.mark.parametrize("method", Method)
def test_unknown_missing_doubled_and_stale_cycles_do_not_bias_the_estimates(
    method: Method, damage: Callable[[Iterable[Frame]], list[Frame]]
) -> None:
    estimate = after(made(method), damage(frames()))
    assert estimate.status is Status.OK
    assert_near(estimate)


def test_impossible_reading_is_left_out_and_reported() -> None:
    """A gyro that shows 4 rad/s once in four seconds, on a vehicle that turns at 0.05."""
    estimate = after(made(), (changed(f, roll_rate=4.0) if i % 1000 == 500 else f for i, f in enumerate(frames())))
    assert_near(estimate)
    assert estimate.status is Status.OK
    assert "lost the vehicle" in estimate.reason


@pytest.mark.parametrize("channel", ["roll_rate", "precession_rate"])
def test_reversed_sign_gives_no_value_and_no_nan(channel: str) -> None:
    place = MONOCAB.index_of(channel)
    estimate = after(made(), (changed(f, **{channel: -f.values[place]}) for f in frames()))
    assert not set(estimate.values) & set(TRUTH)
    assert all(p.reason and math.isfinite(p.coverage_percent) for p in estimate.parameters.values() if p.value is None)


def test_two_recordings_with_overlapping_times_are_both_used() -> None:
    """The clock of the second recording starts before the end of the first."""
    estimator = made()
    once = after(estimator, frames())
    twice = after(estimator, frames())
    assert twice.samples > 1.9 * once.samples
    assert_near(twice)


# On the small vehicle, with another roll filter, noise and sampling


def small(estimator: RecursivePredictionError, duration: float, **settings: object) -> Estimate:
    stamps, table = small_vehicle.run(1, duration, **settings)  # type: ignore[arg-type]
    return after(estimator, small_vehicle.frames(stamps, table, 0))


def test_standard_deviations_match_the_actual_errors() -> None:
    """Of 2 x 12 errors 1.2 are expected beyond 1.96 standard deviations, more than 4 with a probability of 0.6 %."""
    stamps, table = small_vehicle.run(12, 10.0, reference=lambda t: small_vehicle.sweep(t, 10.0))
    known = {**SPREAD, "angular_momentum": 0.0, "trim_mass": 0.0, "trim_height": 0.0}
    errors = []
    for seed in range(12):
        estimator = RecursivePredictionError(
            nominal_model("monocab"), parameters=CAD, deviations=known, support=VEHICLE.support, channels=MONOCAB
        )
        found = after(estimator, small_vehicle.frames(stamps, table, seed)).parameters
        for name, true in TRUTH.items():
            value, std = found[name].value, found[name].std
            assert value is not None
            assert std is not None
            errors.append((value - true) / std)
    assert np.count_nonzero(np.abs(errors) > 1.96) <= 4
    # Nor are they too large: the root mean square of 24 standard normal numbers is below 0.6 twice in 1000 cases.
    assert np.sqrt(np.mean(np.square(errors))) > 0.6


def test_without_excitation_there_is_a_reason_instead_of_a_value() -> None:
    estimate = small(made(), 3.0)
    assert estimate.span > 2.0
    for name in TRUTH:
        found = estimate.parameters[name]
        assert found.value is None
        assert found.status in (Status.TOO_LITTLE_EXCITATION, Status.UNIDENTIFIABLE)
        assert "the record determines" in found.reason
        assert 0.0 < found.coverage_percent < 100.0


def test_vehicle_that_only_balances_gives_no_wrong_values() -> None:
    """The feedback loop turns noise into motion, from which parameters follow with a large standard deviation."""
    stamps, table = small_vehicle.run(2, 15.0)
    for seed in range(2):
        estimate = after(made(), small_vehicle.frames(stamps, table, seed))
        for name, true in TRUTH.items():
            found = estimate.parameters[name]
            if found.value is not None and found.std is not None:
                assert abs(found.value - true) < 4.0 * found.std
                assert found.std > 0.02 * true


def test_vehicle_on_its_support_is_reported_as_too_few_samples() -> None:
    estimate = small(made(), 1.0, from_support=True)
    assert estimate.status is Status.TOO_FEW_SAMPLES
    assert "hardly left its supports" in estimate.reason
    assert "no control cycle" in made().result().reason


def test_true_parameters_are_found_from_the_support_and_at_100_hz_with_jitter() -> None:
    assert_near(small(made(), 8.0, from_support=True), 0.03)
    sweep = small(made(), 16.0, spacing=0.01, jitter=0.0005, reference=lambda t: small_vehicle.sweep(t, 15.0))
    assert_near(sweep)


def test_forgetting_increases_the_standard_deviations() -> None:
    """10 s of sweep, then 20 s of rest, with a memory of 2 s: motion by noise alone is far less informative."""
    stamps, table = small_vehicle.run(1, 30.0, reference=lambda t: small_vehicle.sweep(t, 10.0))
    estimator = RecursivePredictionError(
        nominal_model("monocab"),
        parameters=CAD,
        deviations=SPREAD,
        support=VEHICLE.support,
        channels=MONOCAB,
        memory=2.0,
    )
    cycles = list(small_vehicle.frames(stamps, table, 0))
    excited = after(estimator, cycles[:2450])
    assert_near(excited)
    rested = after(estimator, cycles[2450:])
    for name in TRUTH:
        before, later = excited.parameters[name], rested.parameters[name]
        assert before.coverage_percent == 100.0
        assert before.std is not None
        assert later.std is None or later.std > 5.0 * before.std


# Models and settings that are refused


def test_missing_channel_no_parameter_and_invalid_memory_are_refused() -> None:
    with pytest.raises(DataError, match="drive_age") as caught:
        RecursivePredictionError(
            nominal_model("monocab"), channels=ChannelTable(c for c in MONOCAB if c.name != "drive_age")
        )
    assert caught.value.status is Status.MISSING_CHANNEL
    with pytest.raises(EstimationError, match="no parameter"):
        RecursivePredictionError(library.get("monocab_roll").change(estimated=[]), channels=MONOCAB)
    with pytest.raises(EstimationError, match="time constant"):
        RecursivePredictionError("monocab_roll", channels=MONOCAB, memory=0.0)


# Parts of the estimator


def _chunks(model: Model, recording: Recording, rows: int = 25) -> list[Chunk]:
    cutter = FrameChunks(model, MONOCAB, support=VEHICLE.support, rows=rows)
    return [chunk for frame in recording.frames(MONOCAB) if (chunk := cutter.update(frame))]


@pytest.mark.parametrize("name", ["monocab_roll", "monocab_reduced"])
@pytest.mark.parametrize("joined", [1, 7])
def test_chunks_equal_the_segments_of_a_batch_fit(name: str, joined: int) -> None:
    model = library.get(name)
    (whole,) = segments(model, [multisine()], support=VEHICLE.support)
    chunks = list(join(_chunks(model, multisine()), joined))
    assert [chunk.begins for chunk in chunks] == [True] + [False] * (len(chunks) - 1)
    rows = 0
    for chunk in chunks:
        here = chunk.rows
        count = here.stop - here.start
        there = slice(rows, rows + count)
        np.testing.assert_allclose(chunk.segment.time[here], whole.time[there], atol=1e-9)
        np.testing.assert_allclose(chunk.segment.measured[here], whole.measured[there], atol=1e-12)
        # A batch fit leaves inputs at zero that no equation of its model needs; live data keep them for effects.
        used = [place for place, each in enumerate(model.inputs) if each.name not in ("precession", "gyro_bias_std")]
        np.testing.assert_allclose(chunk.segment.knots[here][:, used], whole.row_knots[there][:, used], atol=1e-9)
        lines = [place for place in used if model.inputs[place].hold is Hold.CUBIC]
        # Inputs before and after these samples are included, too, as far as any delay reaches, also on the support.
        reach = slice(max(0, here.start - 10), here.stop + 10)
        back = here.start - reach.start
        first = whole.earlier + rows - back
        np.testing.assert_allclose(
            chunk.segment.inputs[reach][:, lines],
            whole.inputs[first : first + (reach.stop - reach.start)][:, lines],
            rtol=1e-14,
        )
        rows += count
    assert 0 <= len(whole) - rows < 60


def test_input_that_no_device_reports_has_its_usual_value() -> None:
    """As in a batch fit of a recording without the channel; any other unknown value ends the segment."""
    model = library.get("monocab_reduced")
    (place,) = [place for place, each in enumerate(model.inputs) if each.usual is not None]
    for lost, kept in ((model.inputs[place].name, True), ("precession", False)):
        cutter = FrameChunks(model, MONOCAB, support=VEHICLE.support, rows=25)
        column, chunks = MONOCAB.index_of(lost), []
        for frame in multisine().frames(MONOCAB):
            row = tuple(math.nan if number == column else value for number, value in enumerate(frame.values))
            if chunk := cutter.update(Frame(frame.timestamp_ns, row)):
                chunks.append(chunk)
        assert bool(chunks) is kept
        assert all((chunk.segment.inputs[:, place] == model.inputs[place].usual).all() for chunk in chunks)


def _regression(own: int, held: int, **settings: bool) -> tuple[RecursiveGaussNewton, Callable[[Array, Array], None]]:
    """Three unknowns, two of them estimated; prior precisions 1, 4, 9."""
    wide = np.full(3, np.inf)
    made = RecursiveGaussNewton(np.array([1.0, 4.0, 9.0]), -wide, wide, estimated=2, own=own, held=held, **settings)

    def learn(residual: Array, columns: Array) -> None:
        made.add(residual - columns[:, :3] @ made.z, columns, 1.0)
        made.move(made.z, wide)

    return made, learn


def test_linear_problem_is_solved_exactly_with_prior_and_held_parameters() -> None:
    random = np.random.default_rng(5)
    columns, residual = random.standard_normal((40, 4)), 0.1 * random.standard_normal(40)
    regression, learn = _regression(own=0, held=1)
    for part in np.split(np.arange(40), 4):
        learn(residual[part], columns[part])
    unknowns = columns[:, :3]
    information = unknowns.T @ unknowns + np.diag([1.0, 4.0, 9.0])
    np.testing.assert_allclose(regression.z, np.linalg.solve(information, unknowns.T @ residual), rtol=1e-9)
    inverse = np.linalg.inv(information)
    moved = inverse @ unknowns.T @ columns[:, 3:]
    found = regression.uncertainty()
    np.testing.assert_allclose(found.total, (inverse + moved @ moved.T)[:2, :2], rtol=1e-9)
    alone = np.linalg.inv(unknowns.T @ unknowns + np.diag([0.0, 0.0, 9.0]))
    np.testing.assert_allclose(found.alone, alone[:2, :2], rtol=1e-9)


def test_each_segment_has_unknowns_of_its_own() -> None:
    """Two segments with a start each equal one problem with five unknowns, with priors of variance 1 for the starts."""
    random = np.random.default_rng(6)
    columns, residual = random.standard_normal((40, 4)), 0.1 * random.standard_normal(40)
    regression, learn = _regression(own=1, held=0)
    joint = np.zeros((40, 5))
    joint[:, :3] = columns[:, :3]
    for segment in range(2):
        regression.begin(np.ones(1))
        for half in range(2):
            part = slice(20 * segment + 10 * half, 20 * segment + 10 * half + 10)
            learn(residual[part], columns[part])
            joint[part, 3 + segment] = columns[part, 3]
    information = joint.T @ joint + np.diag([1.0, 4.0, 9.0, 1.0, 1.0])
    np.testing.assert_allclose(regression.z, np.linalg.solve(information, joint.T @ residual)[:3], rtol=1e-9)
    np.testing.assert_allclose(regression.uncertainty().total, np.linalg.inv(information)[:2, :2], rtol=1e-9)


def test_residuals_correlated_within_a_chunk_increase_the_variance() -> None:
    """Chunks of ten samples with the same residual contain ten times less data than they seem to."""
    random = np.random.default_rng(7)
    independent, learn_independent = _regression(own=0, held=0)
    clustered_chunks, learn_clustered = _regression(own=0, held=0, clustered=True)
    for _ in range(400):
        columns = np.repeat(random.standard_normal((1, 3)), 10, axis=0)
        residual = np.repeat(random.standard_normal(1), 10)
        learn_independent(residual, columns)
        learn_clustered(residual, columns)
    ratio = np.diag(clustered_chunks.uncertainty().alone) / np.diag(independent.uncertainty().alone)
    # A variance from 400 chunks is accurate to 7 %.
    np.testing.assert_allclose(ratio, 10.0, rtol=0.3)


def test_move_is_limited_by_reach_and_bounds() -> None:
    regression = RecursiveGaussNewton(np.ones(2), np.array([-9.0, -0.1]), np.array([9.0, 9.0]), estimated=2)
    regression.add(np.array([100.0, -100.0]), 10.0 * np.eye(2), 1.0)
    solution = 1000.0 / 101.0
    assert regression.move(np.zeros(2), np.array([0.5, 20.0]))
    # The first moves by its reach, the second by the same share of its way to the bound.
    np.testing.assert_allclose(regression.z, [0.5, -0.1 * 0.5 / 9.0])
    assert not regression.move(np.zeros(2), np.full(2, 20.0))
    np.testing.assert_allclose(regression.z, [9.0, -0.1])
    assert regression.move(np.array([9.0, 0.0]), np.array([solution, 0.05]))
    np.testing.assert_allclose(regression.z[1], -0.05)


def _quadratic(
    information: Array, solution: Array, lower: Array, upper: Array, nuisance: tuple[int, ...] = ()
) -> RecursiveGaussNewton:
    """Equations whose unbounded solution is `solution`, with a negligible prior."""
    size = len(solution)
    made = RecursiveGaussNewton(np.full(size, 1e-12), lower, upper, estimated=size, nuisance=nuisance)
    columns = np.linalg.cholesky(information).T
    made.add(columns @ solution, columns, 1.0)
    return made


@pytest.mark.parametrize("seed", range(20))
def test_solution_at_bounds_matches_bounded_least_squares(seed: int) -> None:
    """The best point of a box, as found by bounded least squares; nearly collinear unknowns are the hard case."""
    random = np.random.default_rng(seed)
    columns = random.standard_normal((12, 6)) @ np.diag([1.0, 1.0, 3.0, 0.1, 1.0, 1.0])
    columns[:, 1] = columns[:, 0] + 0.05 * columns[:, 1]
    solution, width = 3.0 * random.standard_normal(6), random.uniform(0.1, 2.0, 6)
    made = _quadratic(columns.T @ columns, solution, -width, width)
    assert not made.move(np.zeros(6), np.full(6, 9.0))
    best = lsq_linear(columns, columns @ solution, bounds=(-width, width), method="bvls", tol=1e-14)
    np.testing.assert_allclose(made.z, best.x, atol=1e-6)


def test_nuisance_parameter_of_little_effect_does_not_limit_the_others() -> None:
    """The nuisance parameter moves as far as its own reach; the estimated parameter moves all the way."""
    wide = np.full(2, 99.0)
    made = _quadratic(np.diag([100.0, 1e-4]), np.array([0.3, 9.0]), -wide, wide, nuisance=(1,))
    assert not made.move(np.zeros(2), np.full(2, 0.5)), "a two-hundredth of its deviation"
    np.testing.assert_allclose(made.z, [0.3, 0.5])
    assert made.side_deviations(np.zeros(2)) == pytest.approx(0.005)
    matters = _quadratic(np.diag([100.0, 100.0]), np.array([0.3, 9.0]), -wide, wide, nuisance=(1,))
    assert matters.move(np.zeros(2), np.full(2, 0.5))


# The window of a simulation


@pytest.mark.parametrize("kind", names())
def test_initial_error_grows_little_within_a_window(kind: str) -> None:
    vehicle = load(kind)
    estimator = RecursivePredictionError(
        nominal_model(kind),
        parameters=vehicle.parameters.values,
        channels=channels_of(kind),
        method=Method.OUTPUT_ERROR,
    )
    problem = estimator._problem
    pole = float(np.max(np.linalg.eigvals(jacobian(problem.kernel, problem.kernel.vector(), problem.segments)).real))
    assert pole > 1.0, "it falls"
    assert longest_window(problem) * pole == pytest.approx(GROWTH)


def test_stable_model_is_simulated_for_a_second() -> None:
    assert longest_window(at_rest(library.get("axis"), 0.01)) == WINDOW


def test_variances_of_correlated_errors_stay_positive_where_the_data_determine_hardly_anything() -> None:
    """Scores of very different magnitude, and a direction that only rounding sees."""
    random, wide = np.random.default_rng(1), np.full(3, np.inf)
    regression = RecursiveGaussNewton(np.ones(3), -wide, wide, estimated=3, own=2, clustered=True)
    for place in range(60):
        regression.begin(np.ones(2))
        known = random.standard_normal((30, 2)) * 10.0 ** (5 - 4 * (place > 5))
        columns = np.column_stack(
            (known, known @ [1.0, 2.0], np.exp(0.3 * np.arange(30))[:, None] * random.random((1, 2)))
        )
        regression.add(random.standard_normal(30), columns, 1.0)
        found = regression.uncertainty()
        assert (np.diag(found.alone) > 0.0).all()
        assert (np.diag(found.total) > 0.0).all()


# In the bank of live estimators


def _bank(**changes: Mapping[str, float]) -> EstimatorBank:
    given = {"parameters": CAD, "deviations": SPREAD, **changes}
    return online_estimators("monocab", given["parameters"], given["deviations"], VEHICLE.support, MONOCAB)


def test_estimator_that_joins_late_gives_the_same_result_bit_for_bit() -> None:
    early, late = _bank(), _bank()
    early.join()
    for place in range(0, 5000, 8):
        part = frames()[place : place + 8]
        early.update(part)
        late.update(part)
        if place == 4000:
            assert late.results()["recursive_prediction_error"] == STARTING
            assert late.results()["recursive_output_error"] == STARTING
            assert late.results()["recursive_least_squares"]["samples"] > 10
            late.join()
            assert late.complete
    assert list(late.results())[-1] == "recursive_prediction_error"
    assert late.results() == early.results()
    assert late.results()["recursive_output_error"]["samples"] > 1000
    assert late.results()["recursive_prediction_error"]["samples"] > 1000


def test_estimator_that_cannot_be_created_does_not_affect_the_others() -> None:
    def broken() -> RecursivePredictionError:
        raise ImportError("no compiler")

    bank = EstimatorBank([made(Method.OUTPUT_ERROR)], {"recursive_prediction_error": broken})
    bank.update(frames()[:3000])
    bank.join()
    bank.update(frames()[3000:5000])
    results = bank.results()
    assert results["recursive_prediction_error"]["status"] == "failed"
    assert results["recursive_prediction_error"]["reason"] == "ImportError: no compiler"
    assert results["recursive_output_error"]["samples"] > 500


def test_estimator_that_fails_while_running_does_not_affect_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    bank = _bank()
    bank.join()

    def overflow(self: object, frame: Frame) -> None:
        raise OverflowError("it ran away")

    monkeypatch.setattr(RecursivePredictionError, "update", overflow)
    bank.update(frames()[:5000])
    results = bank.results()
    assert results["recursive_prediction_error"]["reason"] == "OverflowError: it ran away"
    assert results["recursive_least_squares"]["samples"] > 10
