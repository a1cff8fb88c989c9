"""The steps of a commissioning as data, and what the record says of them."""

from __future__ import annotations

from pathlib import Path

import pytest
from flywheels import with_flywheels
from pydantic import ValidationError

from upright.service.commission.evaluations.table import EVALUATIONS
from upright.vehicles import registry
from upright.vehicles.commissioning import (
    Acceptance,
    CommissioningError,
    Entry,
    Number,
    State,
    Steps,
    is_within,
    steps_for,
    steps_of,
)
from upright.vehicles.file import load

TABLE = {"title": "t", "why": "w", "why_now": "n", "evaluate": "confirmed"}
STEPS = Steps.model_validate(
    {
        "step": [
            {"id": "one", **TABLE},
            {
                "id": "two",
                **TABLE,
                "needs": ["one"],
                "acceptance": [{"quantity": "x", "title": "x", "unit": "m", "most": 2.0, "remedy": "less"}],
            },
            {"id": "three", **TABLE, "needs": ["two"], "of": ["one"]},
        ]
    }
)


def entry(step: str, state: State = State.ACCEPTED, **keys: object) -> Entry:
    return Entry(step=step, state=state, **keys)


class TestStates:
    def test_a_step_waits_for_those_it_needs(self) -> None:
        assert STEPS.states([]) == {"one": State.OPEN, "two": State.WAITING, "three": State.WAITING}
        assert STEPS.states([entry("one")])["two"] is State.OPEN
        assert STEPS.lacking(STEPS.find("three"), [entry("one")]) == ["two"]

    def test_a_skipped_step_counts_as_done_and_a_failed_one_does_not(self) -> None:
        skipped = [entry("one", State.SKIPPED, reason="done yesterday by hand")]
        assert STEPS.next(skipped).id == "two"  # type: ignore[union-attr]
        assert STEPS.next([entry("one", State.FAILED, reason="no bus")]).id == "one"  # type: ignore[union-attr]

    def test_the_newest_entry_counts(self) -> None:
        record = [entry("one"), entry("two", State.NOT_ACCEPTED), entry("two")]
        assert STEPS.states(record)["two"] is State.ACCEPTED
        assert STEPS.next([*record, entry("three")]) is None

    def test_a_new_beginning_forgets_what_was_done_before(self) -> None:
        record = [entry("one"), entry("two"), Entry(date="2026-01-01 10:00:00"), entry("one")]
        assert STEPS.states(record) == {"one": State.ACCEPTED, "two": State.OPEN, "three": State.WAITING}
        assert STEPS.to_json(record)["began"] == "2026-01-01 10:00:00"

    def test_a_step_is_skipped_with_a_reason_only(self) -> None:
        with pytest.raises(ValidationError, match="with a reason only"):
            entry("one", State.SKIPPED, reason="  ")

    def test_an_unknown_step_is_named_with_those_there_are(self) -> None:
        with pytest.raises(CommissioningError, match=r"no step 'four'.*one, two, three"):
            STEPS.find("four")


class TestAcceptance:
    @pytest.mark.parametrize(
        ("value", "within"), [(1.0, True), (2.0, True), (2.1, False), (None, False), (float("nan"), False)]
    )
    def test_a_number_must_be_known_and_within(self, value: float | None, within: bool) -> None:
        assert is_within(STEPS.find("two").acceptance[0], {"x": Number(value=value)}) is within

    def test_a_number_that_was_not_measured_is_not_within(self) -> None:
        assert not is_within(STEPS.find("two").acceptance[0], {})

    def test_without_a_limit_there_is_nothing_to_accept(self) -> None:
        with pytest.raises(ValidationError, match="needs least, most or both"):
            Acceptance(quantity="x", title="x", remedy="r")

    def test_the_document_shows_the_number_beside_its_limits(self) -> None:
        shown = STEPS.to_json(
            [entry("one"), entry("two", State.NOT_ACCEPTED, numbers={"x": Number(value=3.0, std=0.1)})]
        )
        found = shown["steps"][1]["acceptance"][0]
        assert (found["limits"], found["value"], found["std"], found["within"]) == ("at most 2 m", 3.0, 0.1, False)
        assert shown["next"] == "two"


class TestFiles:
    def test_a_step_builds_on_earlier_ones_only(self) -> None:
        with pytest.raises(ValidationError, match="builds on two"):
            Steps.model_validate({"step": [{"id": "one", **TABLE, "of": ["two"]}, {"id": "two", **TABLE}]})

    @pytest.mark.parametrize("kind", registry.names())
    def test_every_kind_has_steps_that_its_vehicle_file_and_the_evaluations_know(self, kind: str) -> None:
        vehicle, known = load(kind), {*EVALUATIONS, *registry.of(kind).evaluations()}
        for step in steps_of(kind).step:
            assert step.evaluate in known
            assert all(text.endswith((".", "?")) for text in (step.why, step.why_now, step.prepare) if text)
            assert all(each.remedy.endswith(".") for each in step.acceptance)
        assert {step.experiment for step in steps_for(vehicle).step} <= {"", *vehicle.experiments}

    def test_a_vehicle_with_flywheels_has_the_experiments_of_its_steps(self, tmp_path: Path) -> None:
        vehicle = with_flywheels(tmp_path)
        assert {step.experiment for step in steps_for(vehicle).step} <= {"", *vehicle.experiments}

    def test_a_kind_without_steps_says_where_to_write_them(self) -> None:
        with pytest.raises(CommissioningError, match=r"no steps for a monocab\.control"):
            steps_of("monocab.control")
