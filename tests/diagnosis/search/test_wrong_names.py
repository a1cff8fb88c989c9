"""No confident wrong name: indistinguishable effects are tied, and one outside the catalogue is unknown."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from upright.diagnosis.diagnose import Diagnosis, Verdict, diagnose
from upright.diagnosis.lack_of_fit.adequacy import CHANCE, LEFT_BY_IMPACTS, SHAPED, Adequacy
from upright.diagnosis.lack_of_fit.shapes import Shape
from upright.diagnosis.lack_of_fit.where_it_fails import VIEWS, Views
from upright.estimators.identify.run import with_values
from upright.models import library
from upright.models.attach import check_names
from upright.models.compiler.kernel import compile_model
from upright.models.effect import Effect
from upright.models.effects.catalogue import find
from upright.models.parts import ModelError
from upright.models.segment import Segment
from upright.service.virtual.run import record
from upright.simulation.monocab.hidden import HIDDEN
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)
CANCELLING = {"gimbal_imbalance": 31.0, "load_dependent_friction": 2.0e-3}
"""N m, and the share of the actuators' torque."""


def found_in(*hide: str) -> Diagnosis:
    """The diagnosis of a record of 20 s, a little more than the gate requires."""
    return diagnose(MODEL, [record("monocab", "multisine", hide=hide, seed=8, duration=20.0)], support=VEHICLE.support)


class TestNames:
    @pytest.mark.thorough
    def test_sensor_lag_is_not_reported_as_a_sprung_cabin(self) -> None:
        found = found_in("sensor_lag=0.5")
        (finding,) = found.findings
        assert found.verdict is Verdict.MISSING_EFFECT
        assert finding.effect == "sensor_lag"
        assert finding.tied_with == ()
        # Half of 20 ms, to four standard deviations and the effect of the 2 ms in the root, a fiftieth of the lag.
        lag = finding.parameters["sensor_lag.lag"]
        assert lag.value is not None
        assert lag.std is not None
        assert lag.value == pytest.approx(0.010, abs=4.0 * lag.std + 0.2e-3)

    @pytest.mark.thorough
    def test_bristle_friction_is_named_as_or_tied_with_dry_friction(self) -> None:
        (finding,) = found_in("coulomb_friction=0.3").findings
        assert "coulomb_friction" in {finding.effect, *finding.tied_with}
        assert len(finding.tied_with) <= 1

    def test_drag_outside_the_catalogue_is_unknown(self) -> None:
        # Eight times the minimum detectable amplitude: quadratic drag closes four fifths of the gap.
        found = found_in("test_cubic_drag=0.041")
        assert found.verdict is Verdict.UNKNOWN
        assert found.unexplained is not None
        assert found.unexplained.shape is not None
        assert found.unexplained.shape.joint == "roll"
        assert "roll_rate" in found.unexplained.shape.name
        assert "of no known shape" in found.reason

    @pytest.mark.thorough
    def test_stiffness_varying_between_frequencies_of_a_coarse_grid_is_unknown(self) -> None:
        # Twice the minimum detectable amplitude. A cubic stiffness imitates a tenth of it. The record resolves 0.03 Hz,
        # so the spectral line next to it shows nothing.
        recording = record("monocab", "multisine", hide=("test_varying_stiffness=0.036",), seed=8, duration=30.0)
        candidates = ("cubic_stiffness", "viscous_friction")
        found = diagnose(MODEL, [recording], support=VEHICLE.support, candidates=candidates)
        assert found.verdict is Verdict.UNKNOWN
        assert found.unexplained is not None
        assert found.unexplained.shape is not None
        assert found.unexplained.shape.name == "roll times a sinusoid in time"

    @pytest.mark.thorough
    def test_one_sided_damping_is_not_reported_as_a_step(self) -> None:
        # Four times the minimum detectable amplitude, which a step and backlash together had explained. One term of the
        # Taylor series shows what a curve of eight corners is too flexible to show.
        recording = record("monocab", "multisine", hide=("test_one_sided_damping=0.038",), seed=11, duration=30.0)
        found = diagnose(MODEL, [recording], support=VEHICLE.support, candidates=("torque_step", "torque_drift"))
        assert found.verdict is Verdict.UNKNOWN
        assert found.unexplained is not None
        assert found.unexplained.shape is not None
        assert {"roll", "roll_rate"} <= set(found.unexplained.shape.name.split())

    def test_two_effects_that_cancel_each_other_are_found(self) -> None:
        # Friction removes what the leakage of the gimbals' weight adds: each at twice its minimum detectable amplitude.
        hide = tuple(f"{name}={size / HIDDEN[name].size:.4g}" for name, size in CANCELLING.items())
        recording = record("monocab", "multisine", hide=hide, seed=12, duration=30.0)
        found = diagnose(MODEL, [recording], support=VEHICLE.support)
        assert {each.effect for each in found.findings} == set(CANCELLING)
        assert found.verdict is Verdict.MISSING_EFFECT


def adequacy(rise: float, p_value: float, log_ratio: float = 100.0) -> Adequacy:
    fine = Views((), (), (), (), (), dict.fromkeys(VIEWS, ()))
    return Adequacy(1.5, 1.0, fine, Shape("roll", "roll_rate", rise, p_value), log_ratio)


class TestRemainder:
    def test_small_or_insignificant_shape_is_adequate_and_a_large_one_is_not(self) -> None:
        assert adequacy(0.9 * 100.0 * SHAPED, 0.1 * CHANCE).adequate
        assert not adequacy(1.1 * 100.0 * SHAPED, 0.1 * CHANCE).adequate
        assert adequacy(1.1 * 100.0 * SHAPED, 2.0 * CHANCE).adequate

    def test_effects_with_impacts_may_leave_more_of_the_energy(self) -> None:
        fails = Views((), (), (), (), (), dict.fromkeys(VIEWS, ({"from": 0.0},)))
        rest = replace(adequacy(0.0, 1.0), left=fails, before=11.0, after=1.0 + 10.0 * 0.9 * LEFT_BY_IMPACTS)
        assert not rest.adequate
        assert replace(rest, impacts=True).adequate
        assert not replace(rest, impacts=True, after=1.0 + 10.0 * 1.1 * LEFT_BY_IMPACTS).adequate

    def test_nothing_is_named_if_more_is_left_than_was_found(self) -> None:
        assert adequacy(50.0, 0.1 * CHANCE).named
        assert not adequacy(150.0, 0.1 * CHANCE).named
        assert not replace(adequacy(0.0, 1.0), after=1.3).named


class TestSensorLag:
    def test_reading_of_a_sine_is_its_response_through_a_low_pass(self) -> None:
        lag, frequency = 0.02, 5.0
        model = library.get("axis").add("sensor_lag")
        kernel = compile_model(model)
        time = np.arange(0.0, 2.0, 0.002)
        turn = 2.0 * np.pi * frequency
        inputs = np.repeat(np.sin(turn * time)[:, None], len(kernel.inputs), axis=1)
        knots = np.repeat(time[:, None], len(kernel.inputs), axis=1)
        segment = Segment(time, knots, inputs, np.full((len(time), len(kernel.outputs)), np.nan))

        def shown(value: float) -> np.ndarray:
            values = kernel.vector({"sensor_lag.lag": value})
            run = kernel.run(segment, values, np.zeros(len(kernel.states)), substeps=8)
            return np.asarray(run.predicted[:, 0])

        plain, late = shown(0.0), shown(lag)
        exact = np.zeros_like(plain)
        decay = np.exp(-0.002 / lag)
        for row in range(1, len(time)):  # first-order hold of the plain reading
            slope = (plain[row] - plain[row - 1]) / 0.002
            exact[row] = decay * exact[row - 1] + (1.0 - decay) * (plain[row - 1] - lag * slope) + slope * 0.002
        # The root that keeps the memory finite lengthens the lag by half a percent, in its second order alone.
        assert np.max(np.abs(late - exact)) < 0.01 * np.max(np.abs(plain - exact))

    def test_only_an_effect_of_a_sensor_may_start_at_its_reading(self) -> None:
        hysteresis = find("hysteresis")
        (state,) = hysteresis.states
        moved: Effect = replace(hysteresis, states=(replace(state, initial="angle"),))
        with pytest.raises(ModelError, match="cannot begin with"):
            check_names(moved)
