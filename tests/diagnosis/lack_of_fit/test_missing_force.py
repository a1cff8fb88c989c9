"""A known force is recovered with its size, over time and over coordinates, within the band that is reported."""

from __future__ import annotations

from collections.abc import Callable

import axis_plant
import numpy as np
import pytest
import virtual_records
from axis_plant import MASS
from scipy.linalg import solve_discrete_are

from upright.diagnosis.lack_of_fit.floor import Innovations, with_nuisances
from upright.diagnosis.lack_of_fit.force_bins import Binned, binned_forces, mean_forces
from upright.diagnosis.lack_of_fit.force_probe import Probe, probe, recurrence
from upright.diagnosis.lack_of_fit.missing_force import FADING, MissingForce, _settled, missing_force
from upright.estimators.contract import EstimationError
from upright.estimators.fit.problem import problem
from upright.models.model import Model
from upright.telemetry.recording import Recording


def seen(model: Model, recording: Recording) -> tuple[Innovations, Probe]:
    task = problem(model, [recording], support=float(np.radians(4.0)) if model.name == "monocab_roll" else None)
    found = with_nuisances(task, task.kernel.vector())
    return found, probe(found)


def force_of(missing: Callable[[float, float, float], float]) -> MissingForce:
    found, probed = seen(axis_plant.model(), axis_plant.record(missing))
    (force,) = missing_force(found, probed)
    return force


class TestSteadyStateCovariance:
    OUTPUT = np.array([[1.0, 0.0, 1.0]])
    DRIVEN = np.diag([0.0, 0.0, 1.0])

    def test_decaying_states_have_the_covariance_of_a_filter_that_has_converged(self) -> None:
        transition = np.array([[0.9, 0.1, 0.2], [0.0, 0.8, 0.0], [0.0, 0.0, 1.0]])
        covariance = np.eye(3)
        for _ in range(2000):
            gain = covariance @ self.OUTPUT.T / (self.OUTPUT @ covariance @ self.OUTPUT.T + 1.0)
            covariance = transition @ (covariance - gain @ self.OUTPUT @ covariance) @ transition.T + self.DRIVEN
        assert _settled(transition, self.OUTPUT, self.DRIVEN, np.ones(3)) == pytest.approx(covariance, abs=1e-9)

    def test_state_that_does_not_decay_gets_a_little_process_noise(self) -> None:
        """A constant state that no noise drives: without the added noise SciPy finds no solution."""
        still = np.array([[0.9, 0.0, 0.2], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        output = np.array([[1.0, 0.0, 1.0], [0.0, 1e-3, 0.0]])
        with pytest.raises(np.linalg.LinAlgError):
            solve_discrete_are(still.T, output.T, self.DRIVEN, np.eye(2))
        found = _settled(still, output, self.DRIVEN, np.ones(3))
        # P = Q / 2 + sqrt(Q^2 / 4 + Q R) of a random walk of variance Q per sample in a noise R.
        assert found[1, 1] == pytest.approx(0.5 * FADING + (0.25 * FADING**2 + FADING * 1e6) ** 0.5)
        assert found[0, 1] == pytest.approx(0.0, abs=1e-9)

    def test_unobservable_growing_state_is_refused(self) -> None:
        growing = np.array([[0.9, 0.0, 0.2], [0.0, 1.1, 0.0], [0.0, 0.0, 1.0]])
        with pytest.raises(EstimationError, match="cannot be estimated with this predictor"):
            _settled(growing, self.OUTPUT, self.DRIVEN, np.ones(3))


def test_recurrence_equals_a_loop() -> None:
    random = np.random.default_rng(5)
    matrix = np.array([[0.9, 0.2, 0.0], [-0.3, 0.8, 0.1], [0.0, 0.0, 0.99]])
    pushes = random.standard_normal((1000, 3))
    expected, state = [], np.zeros(3)
    for push in pushes:
        state = matrix @ state + push
        expected.append(state)
    assert recurrence(matrix, pushes) == pytest.approx(np.array(expected), abs=1e-9)


def test_response_to_a_force_obeys_newtons_law() -> None:
    _, probed = seen(axis_plant.model(), axis_plant.record())
    spacing = 0.005
    assert probed.response.drive[:, 0] == pytest.approx([0.5 * spacing**2 / MASS, spacing / MASS], rel=1e-3)
    assert not probed.response.direct.any()
    assert {each.name for each in probed.coordinates} == {"position", "rate", "force"}


@pytest.mark.parametrize(
    "planted",
    [
        lambda time, position, rate: 0.3,
        lambda time, position, rate: 0.2 * np.sin(2.0 * np.pi * 0.3 * time),
        lambda time, position, rate: 0.2 if time > 9.0 else 0.0,
    ],
    ids=["constant", "slow", "step"],
)
def test_known_force_is_inside_its_band(planted: Callable[[float, float, float], float]) -> None:
    """Two standard deviations cover 95 % of a random walk; a step is not one, and is missed briefly at its edge."""
    force = force_of(planted)
    truth = np.array([planted(time, 0.0, 0.0) for time in force.time[0]])
    error = force.force[0] - truth
    assert np.mean(np.abs(error) < 2.0 * force.std) > 0.85
    assert np.sqrt(np.mean(error**2)) < 0.35 * np.sqrt(np.mean(truth**2))
    assert force.std < 0.1


def test_band_without_a_missing_force_is_narrow_and_contains_zero() -> None:
    force = force_of(axis_plant.nothing)
    assert np.mean(np.abs(force.force[0]) < 2.0 * force.std) > 0.9
    assert 0.0 < force.std < 0.02
    assert force.p_value > 1e-3


def test_dry_friction_shows_over_the_rate_with_its_size() -> None:
    """0.1 N against the motion. Bins that contain the reversal itself show less; the outer ones must show all of it."""
    found, probed = seen(axis_plant.model(), axis_plant.record(lambda t, x, v: -0.1 * np.tanh(v / 1e-3)))
    by_rate = next(each for each in binned_forces(found, probed) if each.coordinate.name == "rate")
    (mean,) = mean_forces(found, probed)
    assert mean is not None
    assert abs(mean.force) < 4.0 * mean.std
    for term, sign in ((by_rate.terms[1], 1.0), (by_rate.terms[-2], -1.0)):
        assert term is not None
        assert abs(term.force - 0.1 * sign) < 4.0 * term.std
        assert term.std < 0.02
        assert term.p_value < 1e-4
    assert by_rate.explained > 0.6


def test_wrong_parameter_value_does_not_show_as_a_shape() -> None:
    found, probed = seen(axis_plant.model().change({"inertia": 1.05 * MASS}), axis_plant.record())
    terms = [term for each in binned_forces(found, probed) for term in each.terms if term is not None]
    assert min(term.p_value for term in terms) > 1e-3 / len(terms)
    (force,) = missing_force(found, probed)
    assert force.p_value < 1e-6


def test_constant_torque_of_the_virtual_vehicle_is_recovered() -> None:
    """The plant has 120 N m. The mean is known to 0.5 N m; four of these are allowed."""
    found, probed = seen(virtual_records.true_model(), virtual_records.multisine("static_torque", seed=5))
    (mean,) = mean_forces(found, probed)
    (force,) = missing_force(found, probed)
    assert mean is not None
    assert mean.std < 1.0
    assert abs(mean.force - 120.0) < 4.0 * mean.std
    assert np.mean(np.abs(force.force[0] - 120.0) < 2.0 * force.std) > 0.9
    # A static torque is a parameter of this model: no shape is left.
    assert not [each for each in binned_forces(found, probed) if _least_p_value(each) < 1e-4]


def _least_p_value(binned: Binned) -> float:
    return min((term.p_value for term in binned.terms if term is not None), default=1.0) * len(binned.terms)
