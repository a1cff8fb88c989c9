"""What every MQTT topic carries, as pydantic models: the JSON Schemas under docs/reference/mqtt are made from these.

    python -m service.mqtt.topics FOLDER     writes the schemas

Messages of this service are made by other modules, without pydantic, as they come many times a second; tests hold them
against these models. Commands come from others and are checked against them here.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Number = float | None
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]


class Message(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class Fault(Message):
    code: str
    text: str


class State(Message):
    """What the vehicle does, and what keeps it from more."""

    vehicle: str
    mode: Literal["starting", "disarmed", "running", "fault"]
    experiment: str | None
    phase: str
    code: str
    reason: str
    interlocks: list[str]
    """What keeps an experiment from being started, each in words."""
    faults: list[Fault]
    version: str
    since: float
    """Unix seconds of the data."""
    held_by: str | None
    """Whoever holds the lease on the running experiment."""
    commands: bool
    """Whether commands are taken over MQTT."""


class BusHealth(Message):
    address: str
    load_percent: Number
    """Of the bit rate, stuffing counted as badly as can be."""
    dropped: int
    error_frames: int


class Health(Message):
    cycles: int
    missed_cycles: int
    rate: Number
    """Control cycles a second."""
    buses: list[BusHealth]
    longest_step: Number
    """s, the longest time between two cycles since the report before."""


class Prediction(Message):
    """What the model predicts from the measured state at `t0` on, and how far off it is one step ahead."""

    t0: float
    dt: float
    values: dict[str, list[Number]]
    """Channel to what the model says, left alone from `t0` on."""
    innovations: dict[str, list[Number]]
    """Channel to measured less predicted one step ahead."""


class Telemetry(BaseModel):
    """Control cycles: row i was measured at `t0 + i * dt`. Every other key is a channel, null where not known."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)
    __pydantic_extra__: dict[str, list[Number]]

    t0: float
    """Unix seconds of the first row."""
    dt: float
    """s between rows."""
    health: Health | None = None
    """Once a second: how the control process does."""
    predictions: list[Prediction] | None = None
    """Stretches that were predicted since the batch before."""


class Parameter(Message):
    value: Number
    std: Number
    unit: str
    status: str
    coverage_percent: Number
    reason: str
    method: str


class Disturbance(Message):
    """The random force at a joint that no effect explains: first order, with these two numbers."""

    unit: str
    rms: float
    """Where none shows, a bound that it is less than."""
    rms_std: Number
    correlation_time: Number
    """s."""
    correlation_time_std: Number
    shown: bool


class Finding(BaseModel):
    model_config = ConfigDict(extra="allow")

    effect: str
    explanation: str


class Diagnosis(BaseModel):
    """As `upright diagnose --json`, as far as the run shows it."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)

    adequate: bool
    verdict: Literal["adequate", "missing_effect", "unknown", "insufficient_data"]
    findings: list[Finding]
    disturbance: dict[str, Disturbance] | None = None
    """By joint; absent or empty until something is known."""


class Progress(Message):
    task: str
    fraction: Annotated[float, Field(ge=0.0, le=1.0)]
    remaining: float
    """s, roughly."""


class Event(Message):
    severity: Literal["info", "warning", "error"]
    code: str
    text: str


class NoArguments(Message):
    pass


class ExperimentArguments(Message):
    name: Annotated[str, Field(min_length=1, max_length=64)]


class StopArguments(Message):
    now: bool = False
    """Quick stop at once: the vehicle falls onto its supports."""


class Command(Message):
    """A command, the same for every verb; `arguments` are the verb's own."""

    model_config = ConfigDict(extra="forbid", strict=True, use_attribute_docstrings=True)

    id: Name
    """Chosen by the sender, new for each command; the reply carries it."""
    client: Name
    """The reply goes to reply/CLIENT, and leases are held in this name."""
    timestamp: Annotated[float, Field(allow_inf_nan=False)]
    """Unix seconds when it was sent."""
    arguments: dict[str, Any] = {}


class Reply(Message):
    """The answer to a command. An experiment has two: accepted, and done."""

    id: str
    ok: bool
    code: str
    text: str
    done: bool
    recording: str | None = None
    interlocks: list[str] | None = None


ARGUMENTS: dict[str, type[Message]] = {
    "experiment": ExperimentArguments,
    "stop": StopArguments,
    "reset": NoArguments,
    "renew": NoArguments,
    "release": NoArguments,
}
"""Verb to what its `arguments` are."""


TOPICS: dict[str, type[BaseModel]] = {
    "state": State,
    "telemetry": Telemetry,
    "parameters": Parameter,
    "diagnosis": Diagnosis,
    "progress": Progress,
    "event": Event,
    "cmd": Command,
    "reply": Reply,
}
"""Topic to its model; `parameters` is an object of these by name, `status` is plain text."""


def schemas() -> dict[str, dict[str, Any]]:
    """JSON Schema of each topic's payload."""
    made = {topic: model.model_json_schema() for topic, model in TOPICS.items()}
    definitions = made["parameters"].pop("$defs", {})
    made["parameters"] = {
        "title": "Parameters",
        "description": "Parameters by name.",
        "type": "object",
        "additionalProperties": made["parameters"],
        **({"$defs": definitions} if definitions else {}),
    }
    made["status"] = {"title": "Status", "description": "Plain text, no JSON.", "enum": ["online", "offline"]}
    for verb, model in ARGUMENTS.items():
        whole = json.loads(json.dumps(made["cmd"]))
        whole["title"] = f"cmd/{verb}"
        whole["properties"]["arguments"] = model.model_json_schema()
        if model.model_json_schema().get("required"):
            whole["required"] = [*whole["required"], "arguments"]
        made[f"cmd.{verb}"] = whole
    del made["cmd"]
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {topic: {**dialect, **schema} for topic, schema in sorted(made.items())}


def write(folder: Path) -> None:
    """A file for each topic."""
    folder.mkdir(parents=True, exist_ok=True)
    for topic, schema in schemas().items():
        (folder / f"{topic}.schema.json").write_text(json.dumps(schema, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
