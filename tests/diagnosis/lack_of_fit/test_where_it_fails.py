"""Each view finds a planted force where it was planted, and a correct model is adequate."""

from __future__ import annotations

from collections.abc import Callable

import axis_plant
import numpy as np
import pytest

from upright.diagnosis.lack_of_fit.floor import with_nuisances
from upright.diagnosis.lack_of_fit.where_it_fails import LEVEL, VIEWS, Views, summary, views
from upright.estimators.fit.problem import problem
from upright.telemetry.recording import Recording


def views_of(*recordings: Recording, process_noise: float = 1e-3, **values: float) -> Views:
    task = problem(axis_plant.model(process_noise).change(values), recordings)
    return views(with_nuisances(task, task.kernel.vector()))


def planted(missing: Callable[[float, float, float], float]) -> Views:
    return views_of(axis_plant.record(missing))


def test_correct_model_fails_no_more_often_than_at_the_stated_level() -> None:
    """20 records: 0.2 false alarms are expected, three or more have a probability of one in a thousand."""
    alarms = 0
    for seed in range(20):
        found = views_of(axis_plant.record(seed=100 + seed, duration=8.0))
        alarms += not found.adequate
        assert found.adequate != any(found.fails.values())
    assert LEVEL == 0.01
    assert alarms <= 2


def test_p_values_of_pure_noise_are_uniform() -> None:
    """200 of them by frequency and time: the share below one half is known to 3.5 %."""
    p_values = []
    for seed in range(6):
        found = views_of(axis_plant.record(seed=200 + seed))
        p_values += [each.p_value for each in found.by_frequency]
    assert np.mean(np.array(p_values) < 0.5) == pytest.approx(0.5, abs=0.2)
    assert np.mean(np.array(p_values) < 0.02) < 0.12


def test_push_is_found_at_its_time() -> None:
    found = planted(lambda time, position, rate: 0.3 if 9.0 < time < 9.4 else 0.0)
    assert not found.adequate
    worst = found.fails["time"][0]
    assert worst["from"] <= 9.4
    assert worst["to"] >= 9.0
    assert worst["p_value"] < LEVEL / 4.0
    assert all(entry["to"] > 8.0 and entry["from"] < 12.0 for entry in found.fails["time"])


def test_tone_is_found_at_its_frequency() -> None:
    found = planted(lambda time, position, rate: 0.4 * np.sin(2.0 * np.pi * 9.0 * time))
    worst = found.fails["frequency"][0]
    assert worst["from_hz"] < 9.0 < worst["to_hz"]
    assert worst["power_over_floor"] > 2.0


def test_hardening_spring_is_found_by_position() -> None:
    found = planted(lambda time, position, rate: -300.0 * position**3)
    assert not found.adequate
    words = summary(found.fails)
    assert any("The missing force depends on position" in sentence for sentence in words)
    outer = [entry for entry in found.fails["state"] if entry["coordinate"] == "position"]
    assert outer
    assert {entry["joint"] for entry in outer} == {"axis"}
    for entry in outer:
        assert abs(entry["missing_force"]) > 3.0 * entry["std"]


def test_constant_force_is_found_in_the_equation_with_its_value() -> None:
    (equation,) = planted(lambda time, position, rate: 0.3).fails["equation"]
    assert equation["equation"] == "axis"
    assert equation["unit"] == "N"
    assert abs(equation["mean"] - 0.3) < 4.0 * equation["mean_std"]
    assert equation["mean_std"] < 0.02


def test_wrong_mass_fails_in_the_equation_but_not_by_state() -> None:
    found = views_of(axis_plant.record(), inertia=2.2)
    assert found.fails["equation"]
    assert not found.fails["state"]
    assert any("other values of the estimated parameters" in sentence for sentence in summary(found.fails))


def test_views_of_several_recordings_state_which_of_them_fails() -> None:
    pushed = axis_plant.record(lambda time, position, rate: 0.3 if 5.0 < time < 5.4 else 0.0, seed=7, source="second")
    found = views_of(axis_plant.record(), pushed)
    assert {each.recording for each in found.by_time} == {"axis", "second"}
    assert {entry["recording"] for entry in found.fails["time"]} == {"second"}


def test_every_view_is_present_and_empty_if_nothing_fails() -> None:
    found = views_of(axis_plant.record())
    assert tuple(found.fails) == VIEWS
    assert found.adequate
    assert summary(found.fails) == []
