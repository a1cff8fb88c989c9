"""The noise floor: what is estimated from a record, and what a correct model leaves above it."""

from __future__ import annotations

import axis_plant
import numpy as np
import pytest
import virtual_records

from upright.diagnosis.lack_of_fit.floor import floor, innovation_ratio, sensor_noise, with_nuisances
from upright.diagnosis.prediction.horizons import predictions
from upright.estimators.contract import EstimationError
from upright.estimators.data.white_noise import white_variance
from upright.estimators.fit.problem import Problem, problem

SUPPORT = float(np.radians(4.0))


def monocab(*hide: str, seed: int = 8) -> Problem:
    return problem(virtual_records.true_model(), [virtual_records.multisine(*hide, seed=seed)], support=SUPPORT)


@pytest.fixture(scope="module")
def clean() -> Problem:
    return monocab()


def test_white_noise_is_separated_from_motion_and_from_an_impact() -> None:
    """20,000 samples give 4,800 degrees of freedom: a standard deviation of 1 % of the noise; four are allowed."""
    random = np.random.default_rng(3)
    time = np.arange(20000) / 200.0
    motion = np.sin(2.0 * np.pi * 3.0 * time)
    motion[7000:7020] += 0.1
    signal = np.stack([motion + 1e-3 * random.standard_normal(len(time)), 2e-3 * random.standard_normal(len(time))], 1)
    variance, freedom = white_variance([signal])
    assert np.sqrt(variance) == pytest.approx([1e-3, 2e-3], rel=0.04)
    assert 4000 < freedom < 5500


def test_median_of_small_blocks_does_not_bias_the_white_noise() -> None:
    """Four million samples give it to 0.14 %. The second moment's degrees of freedom would make it 0.8 % too small."""
    variance, _ = white_variance([np.random.default_rng(2).standard_normal((4_000_000, 1))])
    assert variance == pytest.approx(1.0, abs=0.006)


def test_white_noise_is_estimated_despite_impacts_and_unknown_samples() -> None:
    """Backlash causes one or two impacts in each half second; the first samples of an actuator are not judged. With
    impacts in a third of the blocks, the median is the 78th percentile of the other blocks, a sixth above their median.
    Blocks four times as long, each of which contains an impact, give 3.3e-3."""
    signal = 1e-3 * np.random.default_rng(3).standard_normal((4000, 1))
    signal[::80] += 0.03
    signal[:45] = np.nan
    variance, _ = white_variance([signal])
    assert 1.0e-3 < np.sqrt(variance) < 1.3e-3


def test_sensor_noise_is_measured_unless_the_model_states_it_as_known(clean: Problem) -> None:
    std, freedom = sensor_noise(clean)
    roll, rate = clean.model.outputs
    assert std[0] == roll.noise
    assert np.isinf(freedom[0])
    # The virtual IMU's gyro: 0.0219 deg/s a sample, quantised.
    assert std[1] == pytest.approx(np.radians(0.0219), rel=0.05)
    assert floor(clean, clean.kernel.vector()).informative == [1]
    assert rate.noise != std[1]


def test_correct_model_is_at_the_floor_and_one_without_friction_is_not(clean: Problem) -> None:
    """9,000 innovations divided by a noise of 2,000 degrees of freedom: a standard deviation of 3.5 %."""
    found = with_nuisances(clean, clean.kernel.vector())
    assert found.ratio == pytest.approx(1.0, abs=0.12)
    assert innovation_ratio(clean, found.fit.values, found.floor) == pytest.approx(found.ratio, rel=1e-3)
    rough = monocab("coulomb_friction", seed=3)
    values = rough.kernel.vector()
    assert innovation_ratio(rough, values, floor(rough, values)) > 10.0


def test_innovations_of_a_correct_model_are_white(clean: Problem) -> None:
    (white,) = with_nuisances(clean, clean.kernel.vector()).normalised
    rate = white[:, 1] - white[:, 1].mean()
    for lag in (1, 2, 5, 50):
        correlation = np.mean(rate[lag:] * rate[:-lag]) / np.mean(rate**2)
        assert abs(correlation) < 4.0 / np.sqrt(len(rate))


def test_process_noise_is_lowered_to_what_the_record_shows_and_never_raised() -> None:
    """The axis has no process noise; a model that states 1 m/s/sqrt(s) would hide 2 N in a second."""
    data = [axis_plant.record()]
    shares = {}
    for stated in (1.0, 1e-3):
        task = problem(axis_plant.model(stated), data)
        least = floor(task, task.kernel.vector())
        shares[stated] = float(least.process_shares[1])
        assert innovation_ratio(task, task.kernel.vector(), least) == pytest.approx(1.0, abs=0.15)
    assert shares[1.0] < 1e-4
    assert max(shares.values()) <= 1.0
    heavier = problem(axis_plant.model(1e-3).change({"inertia": 3.0}), data)
    assert floor(heavier, heavier.kernel.vector()).process_shares.max() == 1.0


def test_prediction_errors_of_a_correct_model_match_the_floor_at_every_horizon(clean: Problem) -> None:
    """At 2 s there are 17 independent predictions: their RMS is known to a sixth, and the floor is an upper bound."""
    ahead = predictions(with_nuisances(clean, clean.kernel.vector()))
    assert tuple(each.horizon for each in ahead) == (0.05, 0.2, 0.5, 2.0)
    for each in ahead:
        assert 0.5 < each.rmse("roll_rate") / each.floor["roll_rate"] < 1.35
    assert ahead[-1].floor["roll"] > 100.0 * ahead[0].floor["roll"]  # the plant is unstable: exp(3 * 2)


def test_model_without_a_finite_inertia_is_refused(clean: Problem) -> None:
    values = clean.kernel.vector({"inertia": float("nan")})
    with pytest.raises((EstimationError, ArithmeticError, ValueError), match=r"monocab_roll|finite|NaN"):
        floor(clean, values)
