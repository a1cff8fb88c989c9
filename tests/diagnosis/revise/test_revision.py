"""Revision by an effect: the held-out error falls, a wrong neighbour is recognised, an unneeded effect is dropped."""

from __future__ import annotations

import importlib.util
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from upright.diagnosis.prediction.ahead import errors, on, sensor_floors
from upright.diagnosis.report.figures.revision import revision_figure
from upright.diagnosis.report.revision_words import in_words, odds_text
from upright.diagnosis.revise.drop_tests import drop_tests
from upright.diagnosis.revise.result import Budget, Neighbour, Revision
from upright.diagnosis.revise.revision import horizons_of, revise
from upright.diagnosis.revise.split import split
from upright.diagnosis.revise.with_and_without import Estimated, alone
from upright.diagnosis.revise.with_and_without import training as samples
from upright.estimators.contract import Status
from upright.estimators.data.segments import DataError
from upright.estimators.fit.problem import problem
from upright.models import library
from upright.models.library.axis import axis
from upright.models.model import Model
from upright.models.parts import ModelError
from upright.service.virtual.run import record
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording

CHANNELS = ChannelTable((Channel("position", "m", ""), Channel("force", "N", "")))
NOISE, SMOOTH = 3e-4, 1e-2
"""m, and the rate, m/s, below which dry friction is nearly proportional to it."""


def carriage(*, coulomb: float, seed: int, seconds: float = 16.0, viscous: float = 3.0) -> Recording:
    """2 kg with dry and viscous friction under a multisine; its position is measured at 200 Hz; ten steps a sample."""
    rows, steps, spacing = round(200.0 * seconds), 10, 0.005
    time = spacing * np.arange(rows)
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 5)
    force = 4.0 * sum(
        np.sin(2.0 * np.pi * f * time + p) for f, p in zip((0.3, 0.5, 0.8, 1.3, 2.1), phases, strict=True)
    )
    position, rate, track, step = 0.0, 0.0, [], spacing / steps

    def acceleration(rate: float, pushed: float) -> float:
        return (pushed - viscous * rate - coulomb * math.tanh(rate / SMOOTH)) / 2.0

    for pushed in force:
        track.append(position)
        for _ in range(steps):
            middle = rate + 0.5 * step * acceleration(rate, pushed)
            position += step * middle
            rate += step * acceleration(middle, pushed)
    measured = np.array(track) + NOISE * np.random.default_rng(seed + 1).standard_normal(rows)
    stamps = np.round(time * 1e9).astype(np.int64)
    return Recording(CHANNELS, stamps, {"position": measured, "force": force}, source=f"carriage {seed}")


def bare() -> Model:
    return axis(inertia=1.8, position_noise=NOISE, process_noise=1e-3, smooth_rate=SMOOTH).change(
        deviations={"inertia": 0.3}
    )


@pytest.fixture(scope="module")
def base() -> Model:
    return library.get("monocab_roll").add("static_torque")


@pytest.fixture(scope="module")
def hidden() -> tuple[Recording, Recording]:
    """The virtual MONOCAB with a hidden dry friction of 60 N m (LuGre bristles): one record to fit, one held out."""
    hide = ["coulomb_friction"]
    return (
        record("monocab", "multisine", hide=hide, seed=3, duration=15.0),
        record("monocab", "sweep", hide=hide, seed=4, duration=20.0),
    )


@pytest.fixture(scope="module")
def right(base: Model, hidden: tuple[Recording, Recording]) -> Revision:
    return revise(base, "coulomb_friction", [hidden[0]], [hidden[1]])


@pytest.fixture(scope="module")
def wrong(base: Model, hidden: tuple[Recording, Recording]) -> Revision:
    return revise(base, "viscous_friction", [hidden[0]], [hidden[1]])


def test_missing_effect_reduces_the_held_out_error(right: Revision) -> None:
    # Measured: 91 %. The plant's friction is LuGre and the model's a tanh, so a few percent remain.
    assert right.budget.fall > 0.8
    assert right.budget.effect > 0.95
    assert right.needed
    for side in ("training", "held_out"):
        for channel in ("roll", "roll_rate"):
            before, after = getattr(right.before, side)[channel], getattr(right.after, side)[channel]
            assert all(a < 0.5 * b for a, b in zip(after, before, strict=True)), (side, channel)
    assert right.after.bic < right.before.bic
    # Both ratios are computed with the disturbance that absorbs the error of the friction's formula, and at least 1.
    assert right.after.innovation_ratio - 1.0 < 0.1 * (right.before.innovation_ratio - 1.0)


def test_estimates_agree_with_the_plant(right: Revision) -> None:
    torque = right.after.parameters["coulomb_friction.torque"]
    assert torque.status == Status.OK
    # 60 N m of bristles; the tanh of the model is flatter near zero and compensates for it by a few percent.
    assert torque.value == pytest.approx(60.0, rel=0.1)
    # 1650 kg m^2 and 14500 N m/rad are the plant's.
    assert right.after.parameters["inertia"].value == pytest.approx(1650.0, rel=0.03)
    assert right.after.parameters["gravity_stiffness"].value == pytest.approx(14500.0, rel=0.03)
    assert right.model.values["coulomb_friction.torque"] == torque.value
    assert right.model.parameter("coulomb_friction.torque").std == torque.std


def test_parameters_that_imitated_the_effect_move_back(right: Revision) -> None:
    """Without friction in the model, its disturbance imitates most of it, and the drives' offset the rest."""
    offset = right.moved["drive_offset"]
    assert offset.back
    assert abs(offset.before) > 0.5 > 0.25 > abs(offset.after)
    (before,), (after,) = right.before.disturbance, right.after.disturbance
    assert before.std > 2.0 * after.std


def test_fall_of_the_error_by_a_wrong_neighbour_is_said_to_prove_little(wrong: Revision) -> None:
    assert 0.1 < wrong.budget.fall < 0.6
    assert wrong.needed, "by itself it looks well founded"
    dry = next(each for each in wrong.neighbours if each.effect == "coulomb_friction")
    assert dry.better
    assert dry.fall > 0.8
    text = " ".join(in_words(wrong))
    assert "viscous_friction imitates it" in text
    assert "proves little" in text
    assert "What would separate viscous_friction" in text
    assert "score directions correlate by 0." in text


def test_fall_of_the_error_at_a_short_horizon_alone_is_reported_as_such(right: Revision) -> None:
    """As with backlash in a robot's gear: after a late impact the motion is a different one half a second later."""
    rising = Budget.of(right.budget.before, 1.2 * right.budget.before)
    text = " ".join(in_words(replace(right, budget=rising)))
    assert "At 0.05 s ahead the error falls: roll by" in text
    assert "explains only the records" not in text
    worse = replace(right.after, held_out=right.before.held_out)
    assert "explains only the records" in " ".join(in_words(replace(right, budget=rising, after=worse)))


def test_correct_effect_is_distinguished_from_a_wrong_neighbour(right: Revision) -> None:
    viscous = next(each for each in right.neighbours if each.effect == "viscous_friction")
    assert not viscous.better
    assert not viscous.tied
    assert viscous.fall > 0.1
    # Asymmetric friction has Coulomb friction as a special case: on a record of the latter they are indistinguishable.
    asymmetric = next(each for each in right.neighbours if each.effect == "asymmetric_friction")
    assert asymmetric.correlation == pytest.approx(1.0, abs=1e-6)
    assert "viscous_friction (by" in " ".join(in_words(right))


def test_shares_of_the_budget_add_up_to_one(right: Revision) -> None:
    budget = right.budget
    assert budget.sensors + budget.effect + budget.unexplained == pytest.approx(1.0)
    assert min(budget.sensors, budget.effect, budget.unexplained) >= 0.0
    assert budget.before > budget.after > 1.0


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        (100.0, 4.0, (0.01, 0.96, 0.03)),
        (100.0, 0.8, (0.008, 0.992, 0.0)),
        (4.0, 9.0, (0.25, 0.0, 0.75)),
        (0.9, 0.9, (1.0, 0.0, 0.0)),
    ],
)
def test_budget_of_energies_before_and_after(before: float, after: float, expected: tuple[float, ...]) -> None:
    budget = Budget.of(before, after)
    assert (budget.sensors, budget.effect, budget.unexplained) == pytest.approx(expected)
    assert budget.fall == pytest.approx(1.0 - np.sqrt(after / before))


def test_document_can_be_written_as_json(right: Revision) -> None:
    document = json.loads(json.dumps(right.to_json(), allow_nan=False))
    assert document["effect"] == "coulomb_friction"
    assert document["held_out_error_closed_percent"] > 80.0
    assert [each["effect"] for each in document["neighbours"] if each["tied"] or each["better"]] == [
        each.effect for each in right.neighbours if each.tied or each.better
    ]
    assert document["before"]["parameters"].keys() < document["after"]["parameters"].keys()


def test_figure_has_a_panel_for_each_channel_and_the_budget(right: Revision) -> None:
    roll, rate, budget = revision_figure(right).axes
    assert "roll, deg" in roll.get_ylabel()
    assert "roll_rate, deg/s" in rate.get_ylabel()
    assert sum(bar.get_width() for bar in budget.patches) == pytest.approx(1.0)
    held_out = next(line for line in roll.lines if line.get_label() == "with coulomb_friction, held out")
    assert held_out.get_ydata() == pytest.approx(np.degrees(right.after.held_out["roll"]))


def test_drop_tests_keep_the_correct_effect_and_not_an_unneeded_one(base: Model, hidden: tuple[Recording, ...]) -> None:
    model = base.add("coulomb_friction").add("viscous_friction")
    tests = {each.effect: each for each in drop_tests(model, [hidden[0]])}
    assert tests["coulomb_friction"].needed
    assert not tests["viscous_friction"].needed
    assert tests["viscous_friction"].degrees == 1
    assert tests["viscous_friction"].likelihood_ratio < 20.0 < tests["coulomb_friction"].likelihood_ratio


def test_with_one_recording_its_last_third_is_held_out() -> None:
    recording = carriage(coulomb=4.0, seed=1, seconds=10.0)
    training, validation = split(bare(), [recording], [])
    known = [np.isfinite(each["position"]) for each in (training[0], validation[0])]
    assert np.array_equal(known[0], ~known[1])
    assert np.mean(known[0]) == pytest.approx(2.0 / 3.0, abs=0.01)
    assert not known[0][-1]
    # Time still counts from the first sample, as a step or a drift in the model requires.
    assert problem(bare(), validation).segments[0].time[0] == pytest.approx(2.0 / 3.0 * recording.duration, abs=0.02)
    answer = revise(bare().add("viscous_friction"), "coulomb_friction", [recording])
    assert answer.held_out == ("last third of carriage 1",)
    assert answer.after.parameters["coulomb_friction.torque"].value == pytest.approx(4.0, rel=0.02)
    assert answer.budget.fall > 0.9


def test_absent_effect_is_not_needed() -> None:
    recording = carriage(coulomb=0.0, seed=5)
    answer = revise(bare().add("viscous_friction"), "coulomb_friction", [recording])
    assert not answer.needed
    assert "do not support it" in " ".join(in_words(answer))
    assert answer.budget.effect < 0.2


def test_error_of_a_correct_model_is_that_of_the_sensors() -> None:
    recording = carriage(coulomb=0.0, seed=7)
    training, validation = split(bare(), [recording], [])
    model = bare().add("viscous_friction")
    fitted = alone(model, samples(model, training, None))
    applied = on(fitted.fit, problem(model, validation))
    horizons = horizons_of(applied)
    rms = np.array([np.sqrt(np.mean(each**2, axis=0)) for each in errors(applied, horizons)])
    # About 10 s of held-out data, with errors correlated over the horizon: a third is two standard deviations.
    assert rms == pytest.approx(sensor_floors(applied, horizons), rel=0.35)


def test_effect_with_a_fixed_amplitude_has_an_infinite_t_ratio() -> None:
    """An effect with a fixed amplitude has no standard deviation that could be too large."""
    recording = carriage(coulomb=0.0, seed=7)
    model = bare().add("viscous_friction")
    held = model.change(estimated=[each.name for each in bare().parameters if each.estimated])
    fitted = Estimated.of(alone(held, samples(held, [recording], None)))
    assert fitted.t_ratio("viscous_friction") == math.inf
    assert Estimated.of(alone(model, samples(model, [recording], None))).t_ratio("viscous_friction") < math.inf


def test_the_initial_state_of_held_out_data_is_fitted() -> None:
    recording = carriage(coulomb=0.0, seed=7)
    training, validation = split(bare(), [recording], [])
    model = bare().add("viscous_friction")
    fitted = alone(model, samples(model, training, None))
    task = problem(model, validation)
    assert task.initials[0][1] == 0.0, "the rate is not measured"
    applied = on(fitted.fit, task)
    time, position = recording.time, recording["position"]
    begin = int(np.searchsorted(time, task.segments[0].time[0]))
    measured = (position[begin + 8] - position[begin - 8]) / (time[begin + 8] - time[begin - 8])
    # The rate from two positions 80 ms apart is off by 5 mm/s by noise, and by up to 7 by the multisine's curvature.
    assert applied.starts[0][1] == pytest.approx(measured, abs=3e-2)
    assert abs(measured) > 0.1


def test_unknown_effect_and_constant_channel_are_refused() -> None:
    recording = carriage(coulomb=0.0, seed=5, seconds=4.0)
    with pytest.raises(ModelError, match="no effect of this name"):
        revise(bare(), "no_such_effect", [recording])
    stuck = Recording(CHANNELS, recording.timestamp_ns, {**recording.values, "position": np.zeros(len(recording))})
    with pytest.raises(DataError, match="position"):
        revise(bare(), "coulomb_friction", [stuck])


def test_better_neighbour_needs_held_out_evidence_and_a_tied_one_does_not() -> None:
    def neighbour(bic_difference: float, t_ratio: float) -> Neighbour:
        return Neighbour("other", bic_difference, 0.5, t_ratio, None, "")

    assert neighbour(-50.0, 5.0).better
    assert not neighbour(-50.0, 1.0).better
    assert neighbour(-50.0, 1.0).tied
    assert neighbour(5.9, 0.0).tied
    assert not neighbour(6.1, 9.0).tied
    assert odds_text(1.0 / 30.0) == "1 to 30"
    assert odds_text(1e9) == "more than 10000 to 1"
    assert odds_text(1e-9) == "less than 1 to 10000"


@pytest.mark.measured
def test_emps_dry_friction_explains_most_of_the_error(measured_data: Path) -> None:
    recording, model = _emps(measured_data)
    answer = revise(model.add("static_torque"), "coulomb_friction", [recording])
    # Measured: 71 %. The remainder is not sensor noise: the axis has more than the four terms of the benchmark.
    assert 0.6 < answer.budget.fall < 0.8
    assert answer.budget.effect > 0.85
    assert answer.after.parameters["coulomb_friction.torque"].value == pytest.approx(20.39, rel=0.03)
    assert answer.after.parameters["viscous_friction.coefficient"].value == pytest.approx(203.5, rel=0.03)
    assert answer.before.parameters["viscous_friction.coefficient"].value > 300.0, "it stood in for dry friction"


@pytest.mark.measured
def test_emps_without_its_offset_suggests_asymmetric_friction(measured_data: Path) -> None:
    """Without the constant force, dry friction removes 30 % of the error, and the record shows that this is not all."""
    recording, model = _emps(measured_data)
    answer = revise(model, "coulomb_friction", [recording])
    assert 0.2 < answer.budget.fall < 0.4
    assert next(each.effect for each in answer.neighbours if each.better) == "asymmetric_friction"
    assert answer.budget.unexplained > 0.3


def _emps(folder: Path) -> tuple[Recording, Model]:
    """The record, and a bare inertia with viscous friction."""
    path = Path(__file__).resolve().parents[3] / "examples" / "emps.py"
    spec = importlib.util.spec_from_file_location("emps", path)
    assert spec is not None
    assert spec.loader is not None
    emps = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(emps)
    model: Model = emps.model()
    for name in ("coulomb_friction", "static_torque"):
        model = model.remove(name)
    return emps.load(folder), model
