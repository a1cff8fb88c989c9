"""The motion of actuators by a model of their own in a simulated closed loop, with the effects on a setpoint's way."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from upright.diagnosis.prediction.actuator_motion import ActuatorMotion, motion_of
from upright.diagnosis.prediction.closed_loop import simulate
from upright.diagnosis.prediction.compare import compare
from upright.estimators.data.ramp import RampLimiter
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.service.virtual.run import record
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.file import load
from upright.vehicles.monocab.control.controller import design
from upright.vehicles.monocab.file import MonocabFile
from upright.vehicles.monocab.gimbals import COMMAND, MONOCAB_GIMBALS, MONOCAB_GIMBALS_LAG
from upright.vehicles.monocab.model import MONOCAB_ROLL

SHIPPED = load("monocab")
assert isinstance(SHIPPED, MonocabFile)
VEHICLE: MonocabFile = SHIPPED
PERIOD, LAG = 0.004, 0.04


def gimbals(effect: str = "", base: Model = MONOCAB_GIMBALS, **values: float) -> Model:
    model = base.add(effect) if effect else base
    return model.change({f"{effect}.{name}": value for name, value in values.items()})


def step_response(model: Model, count: int = 30, *, sent: float = 0.0, size: float = 1.0) -> list[float]:
    """The precession rate after a step of the setpoint, sample by sample, of gimbals on a vehicle at rest."""
    motion = ActuatorMotion(model, PERIOD, count, 0.0, sent)
    return [motion.step(size, {"roll_rate": 0.0})["precession_rate"] for _ in range(count)]


def lagging(late: float, count: int = 30) -> np.ndarray:
    """The step response of one lag, `late` s after the setpoint."""
    return np.asarray(1.0 - np.exp(-np.maximum(PERIOD * np.arange(1, count + 1) - late, 0.0) / LAG))


class TestMotion:
    @pytest.mark.parametrize(
        ("effect", "values", "expected"),
        [
            ("", {}, lagging(0.0)),
            ("input_delay", {"delay": 0.0128}, lagging(0.0128)),
            ("input_gain", {"gain": -0.1}, 0.9 * lagging(0.0)),
            ("input_deadband", {"width": 0.1}, 0.9 * lagging(0.0)),
        ],
    )
    def test_setpoint_acts_as_its_effects_say(
        self, effect: str, values: dict[str, float], expected: np.ndarray
    ) -> None:
        model = gimbals(effect, MONOCAB_GIMBALS_LAG, **values).change({"gimbal_reaction": 0.0})
        np.testing.assert_allclose(step_response(model), expected, atol=2e-4)

    def test_setpoint_that_is_sent_later_acts_later(self) -> None:
        model = MONOCAB_GIMBALS_LAG.change({"gimbal_reaction": 0.0})
        np.testing.assert_allclose(step_response(model, sent=0.001), lagging(0.001), atol=2e-4)

    def test_rolling_vehicle_turns_them(self) -> None:
        motion = ActuatorMotion(MONOCAB_GIMBALS_LAG, PERIOD, 200, 0.0)
        for _ in range(200):
            rate = motion.step(0.0, {"roll_rate": 0.01})["precession_rate"]
        reaction = MONOCAB_GIMBALS_LAG.parameter("gimbal_reaction").value
        assert rate == pytest.approx(-LAG * reaction * 0.01, rel=0.02)

    def test_ramp_of_the_drives_is_followed_sample_by_sample(self) -> None:
        model = MONOCAB_GIMBALS_LAG.change({"gimbal_reaction": 0.0, "ramp_share": 1.0})
        limiter = RampLimiter(30.0, 0.0)
        reached, expected = 0.0, []
        for _ in range(30):
            acting = 1.0 + limiter.step(1.0, PERIOD)
            reached = acting + (reached - acting) * np.exp(-PERIOD / LAG)
            expected.append(reached)
        np.testing.assert_allclose(step_response(model), expected, atol=2e-4)

    def test_a_model_belongs_to_the_axis_whose_command_it_has(self) -> None:
        model = replace(MONOCAB_ROLL, actuators_model=MONOCAB_GIMBALS)
        assert motion_of(model, COMMAND) is MONOCAB_GIMBALS
        assert motion_of(model, "trim_rate_setpoint") is None
        assert motion_of(MONOCAB_ROLL, COMMAND) is None

    def test_more_samples_than_said_are_an_error(self) -> None:
        motion = ActuatorMotion(MONOCAB_GIMBALS, PERIOD, 1, 0.0)
        motion.step(1.0, {})
        with pytest.raises(ModelError, match="there are no samples"):
            motion.step(1.0, {})


@cache
def delayed() -> Recording:
    """A sweep of a vehicle whose setpoints act 6 ms late."""
    return record("monocab", "sweep", hide=["disturbance=8,0.3", "input_delay=0.5"], seed=5)


class TestClosedLoop:
    def test_error_falls_with_the_delay_of_the_setpoints(self) -> None:
        """6 ms, and 0.8 ms that bus and drive take anyway; nothing is fitted."""
        bare = registry.nominal_model("monocab").change({"inertia": 1650.0, "gravity_stiffness": 14500.0})
        models = {
            name: replace(bare, actuators_model=gimbals("input_delay", delay=delay))
            for name, delay in {"without": 0.0, "half": 0.0034, "with": 0.0068}.items()
        }
        loop = registry.recorded_loop(VEHICLE, delayed())
        errors = {}
        for each in compare(models, [delayed()], support=VEHICLE.support, loops=[loop]):
            assert each.closed_loop is not None
            errors[each.name] = each.closed_loop.over_floor("precession_rate")
        assert errors["without"] > errors["half"] > errors["with"]
        assert errors["with"] < 0.55 * errors["without"]

    @pytest.mark.parametrize("name", ["sweep", "full_sweep"])
    def test_experiment_is_predicted_with_it(self, name: str) -> None:
        """With both controllers the vehicle swings more, the later the setpoints act."""
        bare = registry.nominal_model("monocab")
        experiment = registry.of("monocab").prediction().of(VEHICLE)(name)
        courses = [
            simulate(replace(bare, actuators_model=gimbals("input_delay", delay=delay)), experiment)
            for delay in (0.0, 0.002, 0.004)
        ]
        assert [each.broken for each in courses] == ["", "", ""]
        moved = [float(np.std(each.rows.measured[:, 1])) for each in courses]
        assert moved[2] > 1.003 * moved[1] > 1.006 * moved[0]

    def test_delay_with_which_the_vehicle_swings_is_predicted_to_come_too_close_to_a_limit(self) -> None:
        late = 1.2 * design(VEHICLE).margins["precession_rate_setpoint"].delay
        model = replace(registry.nominal_model("monocab"), actuators_model=gimbals("input_delay", delay=late))
        found = simulate(model, registry.of("monocab").prediction().of(VEHICLE)("sweep"))
        assert "precession_rate_setpoint would reach" in found.broken
