"""The payloads of all MQTT topics as pydantic models, from which the schemas in docs/reference/mqtt are generated.

    python -m upright.service.mqtt.topics FOLDER     writes the schemas

Other modules build the messages of this service without pydantic, as there are many per second; tests check them
against these models. Commands come from other programs and are checked with these models at run time.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Number = float | None
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
User = Annotated[str, Field(pattern=r"^[A-Za-z0-9_.@-]{1,40}$")]
"""A user of the broker, as part of a topic."""


class Message(BaseModel):
    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class Fault(Message):
    code: str
    text: str


class Load(Message):
    """What a person is asked to have put on the vehicle."""

    torque: float
    """N m about the axis that the vehicle falls about, with the sign of its angle."""
    ramp: float
    """s in which it is put on."""
    announcement: str


class Tilt(Message):
    """How a person is asked to tilt the vehicle over to its other support."""

    duration: float
    """s that it should take."""
    announcement: str


class Spin(Message):
    """What a person is asked to do with the flywheels."""

    up: bool
    """Bring them to their speed; else switch their inverters off, so that they run down."""
    announcement: str


class State(Message):
    """The state of the vehicle, and its interlocks."""

    vehicle: str
    mode: Literal["starting", "disarmed", "running", "fault"]
    experiment: str | None
    phase: str
    load: Load | None
    """The load that the running experiment asks for, from its time on."""
    tilt: Tilt | None
    """The same of a tilt by hand."""
    spin: Spin | None
    """The same of the flywheels."""
    code: str
    reason: str
    interlocks: list[str]
    """Reasons that prevent an experiment, as sentences."""
    stays_down: list[str]
    """Reasons that prevent only those experiments in which the vehicle gets up."""
    faults: list[Fault]
    version: str
    since: float
    """Time of the last change of mode or reason, Unix seconds of the data."""
    held_by: str | None
    """The client that holds the lease on the running experiment."""
    commands: bool
    """Whether commands over MQTT are enabled."""


class BusHealth(Message):
    address: str
    load_percent: Number
    """Load in percent of the bit rate, with worst-case bit stuffing."""
    dropped: int
    error_frames: int


class NearestLimit(Message):
    code: str
    percent: Number
    """Of the limit that is used."""


class Health(Message):
    cycles: int
    missed_cycles: int
    rate: Number
    """Control cycles per second."""
    buses: list[BusHealth]
    longest_step: Number
    """s, the longest time between two cycles since the previous report."""
    nearest_limit: NearestLimit | None = None
    """The limit of which most is used while an experiment runs."""


class Force(Message):
    values: list[float]
    """In each part of the segment."""
    std: list[float]
    unit: str


class Gap(Message):
    """What the model lacks: element i belongs to the part of the segment whose middle is `t0 + i * dt`."""

    t0: float
    dt: float
    error: dict[str, list[float]]
    """RMS of the innovations, by channel."""
    floor: dict[str, float]
    """The RMS that they have from noise alone."""
    missing_force: dict[str, Force]
    """The force that explains the innovations best, by joint."""


class Prediction(Message):
    """The model's prediction from the measured state at `t0` on, and its one-step prediction errors."""

    t0: float
    dt: float
    values: dict[str, list[Number]]
    """Simulation from `t0` on without correction, by channel."""
    innovations: dict[str, list[Number]]
    """Measurement minus one-step prediction, by channel; empty if the model has no stable predictor."""
    gap: Gap | None = None


class Telemetry(BaseModel):
    """Control cycles: sample i was measured at `t0 + i * dt`. All other keys are channels, with null if not known."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)
    __pydantic_extra__: dict[str, list[Number]]

    t0: float
    """Unix seconds of the first sample."""
    dt: float
    """s between samples."""
    health: Health | None = None
    """Health of the control process, once a second."""
    predictions: list[Prediction] | None = None
    """Segments that were predicted since the previous batch."""


class Parameter(Message):
    value: Number
    std: Number
    unit: str
    status: str
    coverage_percent: Number
    reason: str
    method: str


class MethodParameter(Message):
    value: Number
    std: Number
    unit: str
    status: str


class Parting(Message):
    """Two methods whose estimates of a parameter differ by more than two standard deviations of the difference."""

    parameter: str
    methods: Annotated[list[str], Field(min_length=2, max_length=2)]
    sigmas: float
    """The difference in standard deviations of the difference of two independent estimates."""
    text: str
    """The same as a sentence."""


class Methods(Message):
    """The live estimates of all methods side by side."""

    estimates: dict[str, dict[str, MethodParameter]]
    """By method and parameter; empty for a method without a result yet."""
    parting: list[Parting]


class Disturbance(Message):
    """The random force at a joint that no effect explains: a first-order process with RMS and correlation time."""

    unit: str
    rms: float
    """An upper bound if `shown` is false."""
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
    """As `upright diagnose --json`, as far as it is known during the run."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)

    adequate: bool
    verdict: Literal["adequate", "missing_effect", "unknown", "insufficient_data"]
    findings: list[Finding]
    disturbance: dict[str, Disturbance] | None = None
    """By joint; absent or empty until it is known."""


class AcceptanceOfStep(Message):
    """A number that has to lie within limits for a step to be accepted."""

    quantity: str
    title: str
    unit: str
    least: Number
    most: Number
    limits: str
    """In words."""
    remedy: str
    value: Number
    std: Number
    within: bool | None
    """Null before the step was carried out."""


class NumberOfStep(Message):
    value: Number
    std: Number
    unit: str


class StepOfCommissioning(Message):
    """A step with what became of it."""

    id: str
    title: str
    why: str
    why_now: str
    needs: list[str]
    """Ids of steps that have to be done before."""
    prepare: str
    """What a person does, or makes sure of, before it begins."""
    experiment: str
    """The experiment that is run first; empty if there is none."""
    evaluate: str
    of: list[str]
    """Ids of steps whose recordings and results it uses."""
    state: Literal["open", "waiting", "accepted", "not_accepted", "failed", "skipped"]
    acceptance: list[AcceptanceOfStep]
    date: str
    by: str
    numbers: dict[str, NumberOfStep]
    text: list[str]
    reason: str
    """Why it was skipped, or could not be carried out."""
    recording: str
    files: dict[str, str]
    """Files that were written, with their SHA-256."""


class Commissioning(Message):
    """The steps of the commissioning, in order."""

    began: str
    next: str | None
    """The step that comes next; null if all are done."""
    steps: list[StepOfCommissioning]


class Progress(Message):
    task: str
    fraction: Annotated[float, Field(ge=0.0, le=1.0)]
    remaining: float
    """s, approximately."""


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
    """Immediate quick stop: the vehicle falls onto its supports."""


class Command(Message):
    """A command, the same for all verbs; `arguments` depend on the verb."""

    model_config = ConfigDict(extra="forbid", strict=True, use_attribute_docstrings=True)

    id: Name
    """Chosen by the sender, new for each command; the reply contains it."""
    client: Name
    """The reply goes to reply/CLIENT, and leases are held under this name."""
    timestamp: Annotated[float, Field(allow_inf_nan=False)]
    """Time of sending, Unix seconds."""
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
"""The model of `arguments` by verb."""


TOPICS: dict[str, type[BaseModel]] = {
    "state": State,
    "telemetry": Telemetry,
    "parameters": Parameter,
    "methods": Methods,
    "diagnosis": Diagnosis,
    "commissioning": Commissioning,
    "progress": Progress,
    "event": Event,
    "cmd": Command,
    "reply": Reply,
}
"""The model by topic; `parameters` is an object of these by name, `status` is plain text."""


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
        whole["title"] = f"cmd/USER/{verb}"
        whole["properties"]["arguments"] = model.model_json_schema()
        if model.model_json_schema().get("required"):
            whole["required"] = [*whole["required"], "arguments"]
        made[f"cmd.{verb}"] = whole
    del made["cmd"]
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return {topic: {**dialect, **schema} for topic, schema in sorted(made.items())}


def write(folder: Path) -> None:
    """Write a file for each topic."""
    folder.mkdir(parents=True, exist_ok=True)
    for topic, schema in schemas().items():
        (folder / f"{topic}.schema.json").write_text(json.dumps(schema, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    write(Path(sys.argv[1]))
