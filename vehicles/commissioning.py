"""The commissioning of a vehicle as data: its steps, what was done of them, and what comes next. Pure.

The steps are a file of the kind's folder, `commissioning.toml`. A step may run an experiment; its evaluation gives
numbers, and its acceptance compares these with limits. The record is a list of entries, one for each time that a step
was carried out or skipped. The newest entry of a step since the last beginning counts.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from enum import StrEnum
from functools import cache
from importlib.resources import files
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from upright.telemetry.errors import UprightError
from upright.vehicles.sections import VehicleFile

FILE = "commissioning.toml"
Id = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$")]


class CommissioningError(UprightError):
    """The steps of a vehicle cannot be used, or a step does not exist or cannot be carried out now."""


class Data(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)


class Acceptance(Data):
    """A number of the evaluation that must lie within limits."""

    quantity: str
    """Its name in the evaluation."""
    title: str
    unit: str = "1"
    least: float | None = None
    most: float | None = None
    remedy: str
    """What to do if it does not."""

    @model_validator(mode="after")
    def _has_a_limit(self) -> Self:
        if self.least is None and self.most is None:
            raise ValueError(f"{self.quantity} needs least, most or both: else nothing could ever be wrong with it")
        return self

    @property
    def limits(self) -> str:
        """The limits in words."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        if self.least is None:
            return f"at most {self.most:g}{unit}"
        if self.most is None:
            return f"at least {self.least:g}{unit}"
        if self.least == self.most:
            return f"exactly {self.most:g}{unit}"
        return f"{self.least:g} to {self.most:g}{unit}"


class Step(Data):
    """One step. `why` it is done at all, and `why_now`: why it comes here."""

    id: Id
    title: str
    why: str
    why_now: str
    only_with: str = ""
    """A section of the vehicle file, as "flywheel": a vehicle without it does not have this step."""
    only_without: str = ""
    """A section of the vehicle file: a vehicle with it does not have this step."""
    needs: list[Id] = []
    """Steps that must be accepted, or skipped, before."""
    prepare: str = ""
    """What a person does, or makes sure of, before it begins."""
    experiment: str = ""
    """The experiment of the vehicle file that is run first."""
    evaluate: str
    """The evaluation that gives its numbers; see service.commission.evaluations."""
    of: list[Id] = []
    """Steps whose recordings, results and model it uses beside its own. No other step has any influence."""
    acceptance: list[Acceptance] = []


class Number(Data):
    """A number of an evaluation; `value` and `std` are None if they are not known."""

    value: float | None
    std: float | None = None
    unit: str = "1"


class State(StrEnum):
    """What became of a step."""

    OPEN = "open"
    WAITING = "waiting"
    """For a step that it needs."""
    ACCEPTED = "accepted"
    NOT_ACCEPTED = "not_accepted"
    FAILED = "failed"
    """It could not be carried out."""
    SKIPPED = "skipped"


DONE = (State.ACCEPTED, State.SKIPPED)


class Entry(Data):
    """A step that was carried out or skipped. Without a `step` it is the beginning of a commissioning."""

    step: str = ""
    state: State = State.OPEN
    date: str = ""
    """UTC."""
    by: str = ""
    """Who carried it out, as that client calls itself."""
    numbers: dict[str, Number] = {}
    text: list[str] = []
    """What was found, in words."""
    reason: str = ""
    """Why it was skipped, or could not be carried out."""
    recording: str = ""
    """File of its experiment."""
    files: dict[str, str] = {}
    """What was written: path to SHA-256."""
    result: str = ""
    """The one of them, a JSON document, that later steps use."""
    model: str = ""
    """The one of them that is a model with the effects that were accepted."""
    vehicle_file: str = ""
    """Hash of the vehicle file it was carried out with."""
    version: str = ""

    @model_validator(mode="after")
    def _is_justified(self) -> Self:
        if self.state is State.SKIPPED and not self.reason.strip():
            raise ValueError("a step is skipped with a reason only: it is kept in the record and in the report")
        return self


class Steps(Data):
    """The steps of a kind of vehicle, in order."""

    step: Annotated[list[Step], Field(min_length=1)]

    @model_validator(mode="after")
    def _build_on_earlier_ones(self) -> Self:
        before: list[str] = []
        for each in self.step:
            later = [name for name in (*each.needs, *each.of) if name not in before]
            if later:
                raise ValueError(f"step {each.id} builds on {later[0]}, which does not come before it")
            if each.id in before:
                raise ValueError(f"two steps have the id {each.id}")
            before.append(each.id)
        return self

    def of(self, vehicle: VehicleFile) -> Steps:
        """Those of one vehicle."""
        there = [each for each in self.step if _applies(each, vehicle)]
        names = {each.id for each in there}

        def known(of: list[str]) -> list[str]:
            return [name for name in of if name in names]

        return Steps(
            step=[each.model_copy(update={"needs": known(each.needs), "of": known(each.of)}) for each in there]
        )

    def find(self, name: str) -> Step:
        """The step of this id. Raises CommissioningError."""
        for each in self.step:
            if each.id == name:
                return each
        raise CommissioningError(
            f"there is no step {name!r}.", remedy=f"Use one of: {', '.join(each.id for each in self.step)}."
        )

    def states(self, record: Sequence[Entry]) -> dict[str, State]:
        """The state of each step by its id."""
        newest = latest(record)
        found: dict[str, State] = {}
        for each in self.step:
            entry = newest.get(each.id)
            ready = all(found[name] in DONE for name in each.needs)
            found[each.id] = entry.state if entry else State.OPEN if ready else State.WAITING
        return found

    def next(self, record: Sequence[Entry]) -> Step | None:
        """The first step that is neither accepted nor skipped; None if there is none left."""
        states = self.states(record)
        return next((each for each in self.step if states[each.id] not in DONE), None)

    def lacking(self, step: Step, record: Sequence[Entry]) -> list[str]:
        """The steps that have to be done before `step`."""
        states = self.states(record)
        return [name for name in step.needs if states[name] not in DONE]

    def to_json(self, record: Sequence[Entry]) -> dict[str, Any]:
        """For people and programs: every step with its state and its newest entry, and the one that comes next."""
        states, newest, following = self.states(record), latest(record), self.next(record)
        return {
            "began": next((each.date for each in reversed(record) if not each.step), ""),
            "next": following.id if following is not None else None,
            "steps": [
                {
                    **each.model_dump(exclude={"acceptance", "only_with", "only_without"}),
                    "state": states[each.id].value,
                    "acceptance": [_judged(one, newest.get(each.id)) for one in each.acceptance],
                    **_carried_out(newest.get(each.id)),
                }
                for each in self.step
            ],
        }


def latest(record: Sequence[Entry]) -> dict[str, Entry]:
    """The newest entry of each step since the last beginning."""
    begins = max((place for place, each in enumerate(record) if not each.step), default=-1)
    return {each.step: each for each in record[begins + 1 :]}


def is_within(acceptance: Acceptance, numbers: Mapping[str, Number]) -> bool:
    """Whether the number is known and within its limits."""
    number = numbers.get(acceptance.quantity)
    if number is None or number.value is None:
        return False
    least = acceptance.least if acceptance.least is not None else -float("inf")
    most = acceptance.most if acceptance.most is not None else float("inf")
    return least <= number.value <= most


def _judged(acceptance: Acceptance, entry: Entry | None) -> dict[str, Any]:
    number = entry.numbers.get(acceptance.quantity) if entry is not None else None
    return {
        **acceptance.model_dump(),
        "limits": acceptance.limits,
        "value": number.value if number is not None else None,
        "std": number.std if number is not None else None,
        "within": is_within(acceptance, entry.numbers) if entry is not None and entry.numbers else None,
    }


def _carried_out(entry: Entry | None) -> dict[str, Any]:
    shown = entry or Entry()
    return shown.model_dump(include={"date", "by", "numbers", "text", "reason", "recording", "files"})


def steps_for(vehicle: VehicleFile) -> Steps:
    """The steps of one vehicle. Raises CommissioningError if its kind has none, or if they cannot be used."""
    return steps_of(vehicle.vehicle.kind).of(vehicle)


def _applies(step: Step, vehicle: VehicleFile) -> bool:
    there = not step.only_with or vehicle.has(step.only_with)
    return there and not (step.only_without and vehicle.has(step.only_without))


@cache
def steps_of(kind: str) -> Steps:
    """All steps of a kind of vehicle. Raises CommissioningError if it has none, or if they cannot be used."""
    place = files(f"upright.vehicles.{kind}").joinpath(FILE)
    if not place.is_file():
        raise CommissioningError(
            f"there are no steps for a {kind}.",
            remedy=f"Write them in vehicles/{kind}/{FILE}; another kind's is an example.",
        )
    try:
        return Steps.model_validate(tomllib.loads(place.read_text("utf-8")))
    except (tomllib.TOMLDecodeError, ValidationError) as error:
        raise CommissioningError(f"vehicles/{kind}/{FILE}: {error}", remedy="Correct the file.") from error
