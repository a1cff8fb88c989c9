"""Play between a motor and what it moves: what the effect does, and that it is named where it is, and only there."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from thorough import of_many

from diagnosis.diagnose import Diagnosis, Verdict, diagnose
from estimators.identify.run import with_values
from models.effects.catalogue import find
from models.library import get
from service.virtual.run import record
from simulation.monocab.gimbal import BACKLASH_STIFFNESS, LOAD_SHARE
from simulation.monocab.hidden import HIDDEN
from simulation.monocab.truth import PlantTruth
from vehicles.file import load
from vehicles.registry import nominal_model

pytestmark = pytest.mark.patient

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)
GAIN, LOAD_INERTIA = 3300.0, 24.0


@cache
def diagnosed(hide: str, seed: int) -> Diagnosis:
    return diagnose(MODEL, [record("monocab", "multisine", hide=[hide], seed=seed)], support=VEHICLE.support)


def impulse(rate: np.ndarray, actuator_rate: np.ndarray, step: float, **values: float) -> np.ndarray:
    """N m s that the effect gives up to each row, by Euler's method: an evaluator apart from the kernels."""
    names = {"width": 1e-3, "torque": 1e9, "load_inertia": LOAD_INERTIA, "closing_time": 0.01} | values
    names |= {"gain": GAIN, "smooth_rate": 1e-3, "time_scale": 0.4, "tanh": math.tanh}
    effect = find("backlash")
    codes = {state.name: compile(state.derivative, state.name, "eval") for state in effect.states}
    force = compile(effect.force, "force", "eval")
    state = dict.fromkeys(codes, 0.0)
    given, total = np.empty(len(rate)), 0.0
    for row, (each, moved) in enumerate(zip(rate.tolist(), actuator_rate.tolist(), strict=True)):
        known = {**names, **state, "rate": each, "actuator_rate": moved}
        given[row] = total = total + step * float(eval(force, {"__builtins__": {}}, known))
        for name, code in codes.items():
            state[name] += step * float(eval(code, {"__builtins__": {}}, known))
    return given


class TestFormula:
    STEP = 1e-4

    def test_what_is_moved_falls_back_by_the_play_when_the_torque_on_it_changes_its_sign(self) -> None:
        time = np.arange(0.0, 1.0, self.STEP)
        rate = np.where(time < 0.5, 0.03, -0.03)
        given = impulse(rate, np.zeros_like(time), self.STEP)
        # The reaction holds the load on one flank, then on the other: gain x width, whatever the time it takes.
        assert given[-1] - given[4999] == pytest.approx(GAIN * 1e-3, rel=1e-3)
        # A lag of 10 ms: 95 % of it are over after three times that.
        assert given[5300] - given[4999] == pytest.approx(0.95 * GAIN * 1e-3, rel=0.01)

    def test_the_motors_acceleration_decides_with_the_reaction(self) -> None:
        time = np.arange(0.0, 1.0, self.STEP)
        # 8 rad/s^2 x 24 kg m^2 outweigh the reaction, 3300 N m s x 0.03 rad/s; a quarter of it does not.
        braked = np.where(time < 0.5, 0.0, -1.0) * (time - 0.5)
        rate = np.full_like(time, 0.03)
        changed, unchanged = (impulse(rate, by * braked, self.STEP)[-1] for by in (8.0, 2.0))
        assert unchanged == pytest.approx(-0.5 * GAIN * 1e-3, rel=0.01)
        assert changed == pytest.approx(0.5 * GAIN * 1e-3, rel=0.01)

    def test_shaft_and_gear_twist_by_half_the_play_more_at_the_torque_of_that_name(self) -> None:
        time = np.arange(0.0, 0.5, self.STEP)
        rate = np.full_like(time, 0.03)
        given = impulse(rate, np.zeros_like(time), self.STEP, torque=GAIN * 0.03)
        assert given[-1] == pytest.approx(-GAIN * 1e-3, rel=1e-3)

    def test_a_motor_that_moves_evenly_from_the_first_row_on_gives_no_blow(self) -> None:
        time = np.arange(0.0, 0.5, self.STEP)
        given = impulse(np.zeros_like(time), np.full_like(time, 0.3), self.STEP, torque=30.0)
        # Half the play is what a flank gives in any case. Taken for an acceleration, 0.3 rad/s in 2 ms would be 120.
        assert np.max(np.abs(given)) < GAIN * 1e-3

    def test_the_kernels_have_it(self) -> None:
        attached = get("monocab_roll").add("backlash").effects[0]
        assert [each.unit for each in attached.parameters] == ["rad", "N m", "N m s^2/rad", "s"]


class TestRecords:
    # Four and two times the size that the old formula's record would just show; seeds that decided nothing.
    @pytest.mark.parametrize(("level", "seed"), of_many([(0.0353, 41), (0.0177, 42)], (0.0177, 42)))
    def test_play_is_named_and_sized(self, level: float, seed: int) -> None:
        found = diagnosed(f"backlash={level}", seed)
        # At four times the size the crossing, drawn as a lag, leaves so much that the rest may be called unknown.
        assert found.verdict in (Verdict.MISSING_EFFECT, Verdict.UNKNOWN)
        # What its formula leaves looks like a spring, and is no finding.
        (finding,) = found.findings
        assert finding.effect == "backlash"
        assert len(finding.tied_with) <= 1
        width, inertia = (finding.parameters[f"backlash.{name}"] for name in ("width", "load_inertia"))
        assert width.value is not None
        assert width.std is not None
        assert inertia.value is not None
        assert inertia.std is not None
        # To four standard deviations; the crossing is drawn as a lag, which leaves a tenth of the width open.
        true = level * HIDDEN["backlash"].size
        assert width.value == pytest.approx(true, abs=4.0 * width.std + 0.1 * true)
        assert inertia.value == pytest.approx(LOAD_INERTIA, abs=4.0 * inertia.std)
        # Two gears side by side: 2 stiffness x width / 2. To four of its standard deviations of a tenth or less.
        stiffness = finding.parameters["backlash.torque"].value
        assert stiffness is not None
        assert stiffness == pytest.approx(BACKLASH_STIFFNESS * true, rel=0.4)
        assert PlantTruth().gimbal_inertia * LOAD_SHARE == pytest.approx(LOAD_INERTIA)

    @pytest.mark.parametrize(
        "hide", of_many(["load_dependent_friction=0.2", "hysteresis=0.3", "flexible_mode=0.3"], "hysteresis=0.3")
    )
    def test_it_is_not_named_where_another_effect_is_the_truth(self, hide: str) -> None:
        found = diagnosed(hide, 31)
        names = {name for each in found.findings for name in (each.effect, *each.tied_with)}
        assert "backlash" not in names

    @pytest.mark.thorough
    def test_a_torque_beside_it_has_a_name_however_much_more_the_play_explains(self) -> None:
        # 2.4 N m, twice what 30 s just show without play, gain a fortieth of what the play gains.
        hide = ("backlash=0.005", f"static_torque={2.4 / HIDDEN['static_torque'].size:.4g}")
        candidates = ("backlash", "static_torque", "flexible_mode", "hysteresis")
        recording = record("monocab", "multisine", hide=hide, seed=43, duration=30.0)
        found = diagnose(MODEL, [recording], support=VEHICLE.support, candidates=candidates)
        assert {each.effect for each in found.findings} == {"backlash", "static_torque"}
