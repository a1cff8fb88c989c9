"""Commands over MQTT: the gate by itself, then through a real broker with the shipped access list, and over TLS."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiomqtt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mosquitto import OPERATOR, STRANGER, WATCHER, Mosquitto, Watcher
from observer_harness import cycles, hello, record, until

from upright.service.mqtt.commands import (
    LARGEST,
    MOST_A_SECOND,
    MOST_CLIENTS,
    MOST_STOPS_A_SECOND,
    OLDEST,
    CommandGate,
    Passed,
    Refused,
)
from upright.service.mqtt.home_assistant import discovery
from upright.service.mqtt.topics import ARGUMENTS, TOPICS, Parameter, schemas
from upright.service.observer.client import ObserverClient
from upright.telemetry.samples import Frame

REFERENCE = Path(__file__).resolve().parents[3] / "docs" / "reference"
NOW = 1_800_000_000.0


def command(identity: str = "1", *, client: str = "page", at: float = NOW, **arguments: Any) -> bytes:
    return json.dumps({"id": identity, "client": client, "timestamp": at, "arguments": arguments}).encode()


def judge(gate: CommandGate, payload: bytes, verb: str = "experiment", **more: Any) -> str:
    """The verdict on a command: "passed" or the code of the refusal."""
    user, retained, now = more.get("user", "me"), more.get("retained", False), more.get("now", NOW)
    found = gate.judge(user, verb, payload, retained=retained, now=now)
    return "passed" if isinstance(found, Passed) else found.code


# --- the gate


def test_command_passes_with_its_arguments() -> None:
    gate = CommandGate()
    found = gate.judge("me", "experiment", command(name="step"), retained=False, now=NOW)
    assert found == Passed("experiment", "me/page", "1", {"name": "step"})
    assert gate.counts == {**dict.fromkeys(gate.counts, 0), "passed": 1}


def test_retained_commands_are_refused_even_a_stop() -> None:
    gate = CommandGate()
    assert judge(gate, command(name="step"), retained=True) == "retained"
    assert judge(gate, command(), "stop", retained=True) == "retained"
    assert gate.counts["retained"] == 2


@pytest.mark.parametrize("seconds", [OLDEST + 0.1, -OLDEST - 0.1, 86400.0])
def test_late_command_or_wrong_clock_is_refused_except_for_a_stop(seconds: float) -> None:
    gate = CommandGate()
    assert judge(gate, command("1", name="step"), now=NOW + seconds) == "stale"
    assert judge(gate, command("2"), "stop", now=NOW + seconds) == "passed"


def test_repetition_is_refused_and_marked() -> None:
    gate = CommandGate()
    assert judge(gate, command(name="step")) == "passed"
    again = gate.judge("me", "experiment", command(name="step"), retained=False, now=NOW)
    assert isinstance(again, Refused)
    assert (again.code, again.again) == ("duplicate", True)
    assert judge(gate, command(client="other", name="step")) == "passed"  # ids are per client


def test_out_of_order_command_is_refused_except_for_a_stop() -> None:
    gate = CommandGate()
    assert judge(gate, command("1", at=NOW), "renew") == "passed"
    assert judge(gate, command("2", at=NOW - 0.5, name="step")) == "reordered"
    assert judge(gate, command("3", at=NOW - 0.5), "stop") == "passed"
    assert judge(gate, command("4", at=NOW - 0.5, client="other"), "renew") == "passed"


def test_clients_of_different_users_are_different_whatever_they_call_themselves() -> None:
    gate = CommandGate()
    assert judge(gate, command("1", name="step")) == "passed"
    assert judge(gate, command("1", at=NOW - 1.0), "renew", user="you") == "passed"  # neither repeated nor out of order
    for user in ("", "you/page", "+", "#", "x" * 41, "\n"):
        assert judge(gate, command("2"), "stop", user=user) == "malformed"


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"no json",
        b"[]",
        b"\xff\xfe",
        b"[" * 4000,
        b'{"id": "1"}',
        command("a/b"),
        command(client="#"),
        command(client="+/x"),
        command("x" * 41),
        command(name=""),
        command(name=3),
        command(name="step", more=1),
        command(name="step").replace(b"1800000000.0", b"NaN"),
        command(name="step").replace(b"1800000000.0", b'"now"'),
    ],
)
def test_malformed_command_is_refused(payload: bytes) -> None:
    gate = CommandGate()
    assert judge(gate, payload) == "malformed"
    assert gate.counts["malformed"] == 1


def test_too_large_command_is_refused() -> None:
    assert judge(CommandGate(), command(name="x" * LARGEST)) == "huge"


def test_unknown_verb_is_refused() -> None:
    assert judge(CommandGate(), command(), "self_destruct") == "malformed"


def test_flood_of_commands_is_limited_but_a_stop_passes() -> None:
    gate = CommandGate()
    said = [judge(gate, command(str(number)), "renew") for number in range(3 * MOST_A_SECOND)]
    assert said.count("passed") == MOST_A_SECOND
    assert judge(gate, command("stop"), "stop") == "passed"
    assert judge(gate, command("next", at=NOW + 1.0), "renew", now=NOW + 1.0) == "passed"


def test_flood_of_stops_is_limited_but_the_other_kind_of_stop_passes() -> None:
    gate = CommandGate()
    verdicts = [judge(gate, command(str(number)), "stop") for number in range(3 * MOST_STOPS_A_SECOND)]
    assert verdicts.count("passed") == MOST_STOPS_A_SECOND
    assert judge(gate, command("now", now=True), "stop") == "passed"
    assert judge(gate, command("later", at=NOW), "stop", now=NOW + 1.0) == "passed"


def test_number_of_remembered_clients_is_bounded() -> None:
    gate = CommandGate()
    for number in range(10 * MOST_CLIENTS):
        judge(gate, command(client=f"c{number}", at=NOW + number), "renew", now=NOW + number)
    assert len(gate._clients) == MOST_CLIENTS


@given(st.sampled_from([*ARGUMENTS, "other", ""]), st.binary(max_size=300), st.booleans())
def test_no_payload_raises(verb: str, payload: bytes, retained: bool) -> None:
    gate = CommandGate()
    gate.judge("me", verb, payload, retained=retained, now=NOW)
    assert sum(gate.counts.values()) == 1


# --- schemas


def test_shipped_schemas_equal_those_of_the_models() -> None:
    shipped = {
        file.name.removesuffix(".schema.json"): json.loads(file.read_text()) for file in (REFERENCE / "mqtt").iterdir()
    }
    assert shipped == schemas(), "write them anew: python -m upright.service.mqtt.topics docs/reference/mqtt"


def test_reference_names_every_topic_verb_and_schema() -> None:
    page = (REFERENCE / "mqtt.md").read_text()
    for topic in TOPICS:
        assert f"`{topic}" in page
    for verb in ARGUMENTS:
        assert f"`{verb}`" in page
    for topic in schemas():
        assert f"(mqtt/{topic}.schema.json)" in page


def test_home_assistant_discovery_has_only_sensors() -> None:
    entities = dict(discovery("upright/monocab", "monocab", "1.0", {"inertia": "kg m^2"}))
    assert len({entity["unique_id"] for entity in entities.values()}) == len(entities)
    for topic, entity in entities.items():
        assert topic.startswith(
            ("homeassistant/sensor/upright-monocab/", "homeassistant/binary_sensor/upright-monocab/")
        )
        assert not [key for key in entity if "command" in key]
        assert entity["state_topic"].startswith("upright/monocab/")


# --- through a broker


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    broker = Mosquitto(tmp_path)
    broker.start()
    yield broker
    broker.stop()


class Control:
    """Takes the role of the control process: an observer, and the commands that it passes on."""

    def __init__(self, folder: Path, broker: Mosquitto, **mqtt: Any) -> None:
        self.client = ObserverClient(hello(folder, broker.address, **broker.login, **mqtt))
        self.commands: list[dict[str, Any]] = []
        self.client.on_command = self.commands.append

    @property
    def mqtt(self) -> dict[str, Any]:
        return self.client.statistics().get("mqtt") or {}

    async def start(self) -> None:
        await self.client.start()
        await until(lambda: self.mqtt.get("connected"))


@pytest.fixture
async def control(tmp_path: Path, broker: Mosquitto) -> AsyncIterator[Control]:
    control = Control(tmp_path, broker, commands=True, home_assistant=True)
    await control.start()
    yield control
    await control.client.stop()


async def test_command_passes_once_and_its_client_gets_the_reply(control: Control, broker: Mosquitto) -> None:
    async with Watcher(broker.port, OPERATOR) as page:
        payload = command("17", at=time.time(), name="step")
        await page.publish(f"cmd/{OPERATOR}/experiment", payload)
        await until(lambda: control.commands)
        (passed,) = control.commands
        assert (passed["verb"], passed["client"], passed["id"]) == ("experiment", "dashboard/page", "17")
        assert passed["arguments"] == {"name": "step"}
        reply = {"id": "17", "ok": True, "code": "accepted", "text": "", "done": False}
        control.client.reply("dashboard/page", reply)
        await until(lambda: page.of("reply/dashboard/page") == [reply])
        await page.publish(f"cmd/{OPERATOR}/experiment", payload)  # a repetition: answered again, not executed again
        await until(lambda: page.of("reply/dashboard/page") == [reply, reply])
        assert len(control.commands) == 1
        await page.publish(f"cmd/{OPERATOR}/experiment", command("18", at=time.time() - 60.0, name="step"))
        await until(lambda: page.of("reply/dashboard/page")[-1]["code"] == "stale")
        for junk in (b"junk", b"x" * 2 * LARGEST, b'{"id": 1}'):
            await page.publish(f"cmd/{OPERATOR}/stop", junk)
        await page.publish(f"cmd/{OPERATOR}/stop", command("19", at=time.time()))
        await until(lambda: len(control.commands) == 2)
        assert control.commands[-1]["verb"] == "stop"
        await until(lambda: control.mqtt["commands"]["malformed"] == 2)
        counts = control.mqtt["commands"]
        assert (counts["passed"], counts["duplicate"], counts["stale"], counts["huge"]) == (2, 1, 1, 1)
        assert all(TOPICS["reply"].model_validate(each) for each in page.of("reply/dashboard/page"))
        assert all(not retained for topic, _, retained in page.messages if topic.startswith("reply"))


async def test_retained_command_at_the_broker_is_refused(tmp_path: Path, broker: Mosquitto) -> None:
    async with Watcher(broker.port, OPERATOR) as page:
        await page.publish(f"cmd/{OPERATOR}/experiment", command(at=time.time(), name="step"), retain=True)
        control = Control(tmp_path, broker, commands=True)
        await control.start()
        await until(lambda: control.mqtt["commands"]["retained"] == 1)
        assert control.commands == []
        await control.client.stop()


async def test_commands_are_off_unless_enabled(tmp_path: Path, broker: Mosquitto) -> None:
    control = Control(tmp_path, broker)
    await control.start()
    async with Watcher(broker.port, OPERATOR) as page:
        await page.publish(f"cmd/{OPERATOR}/experiment", command(at=time.time(), name="step"))
        control.client.event("info", "marker", "after it")
        await until(lambda: page.of("event"))
        await asyncio.sleep(0.3)
    assert control.commands == []
    assert sum(control.mqtt["commands"].values()) == 0
    await control.client.stop()


async def test_viewer_cannot_send_commands_and_no_client_can_forge_the_state(
    control: Control, broker: Mosquitto
) -> None:
    async with Watcher(broker.port, WATCHER) as viewer, Watcher(broker.port, OPERATOR) as page:
        await viewer.publish("cmd/viewer/stop", command("1", client="viewer", at=time.time()))
        await viewer.publish("state", json.dumps({"mode": "forged"}))
        await page.publish("state", json.dumps({"mode": "forged"}))
        await page.publish(f"cmd/{OPERATOR}/stop", command("2", at=time.time()))
        await until(lambda: control.commands)
        assert [each["client"] for each in control.commands] == ["dashboard/page"]
        assert not [state for state in page.of("state") if state["mode"] == "forged"]
        assert not [topic for topic, _, _ in viewer.messages if topic.startswith(("cmd", "reply"))]


async def test_commands_and_replies_of_another_user_cannot_be_forged(control: Control, broker: Mosquitto) -> None:
    """A further operator, with a line of its own, as broker/acl says; an operator may not use the topics of before."""
    broker.stop()
    broker.add_operator(STRANGER)
    broker.start()
    await until(lambda: control.mqtt["connections"] == 2)
    async with Watcher(broker.port, OPERATOR) as page, Watcher(broker.port, STRANGER) as other:
        for topic in (f"cmd/{OPERATOR}/renew", "cmd/renew", f"cmd/{STRANGER}/{OPERATOR}/renew", "cmd/+/renew"):
            with suppress(aiomqtt.MqttError, ValueError):
                await other.publish(topic, command("1", at=time.time()))
        await other.publish(f"cmd/{STRANGER}/renew", command("2", at=time.time()))
        await page.publish(f"reply/{STRANGER}/page", json.dumps({"id": "2", "ok": True}))
        await until(lambda: control.commands)
        await page.publish(f"cmd/{OPERATOR}/renew", command("3", at=time.time()))
        await until(lambda: len(control.commands) == 2)
        assert [each["client"] for each in control.commands] == ["stranger/page", "dashboard/page"]
        assert not [topic for topic, _, _ in page.messages if topic.startswith("reply")]


async def test_tls_connects_only_to_a_broker_with_a_trusted_certificate(tmp_path: Path) -> None:
    broker = Mosquitto(tmp_path, tls=True)
    broker.start()
    address = f"localhost:{broker.port}"
    section = {**broker.login, "tls": True}
    good = ObserverClient(hello(tmp_path, address, **section, ca_file=str(broker.ca_file)))
    await good.start()
    await until(lambda: (good.statistics().get("mqtt") or {}).get("connected"))
    await good.stop()
    for ca_file, word in ((str(tmp_path / "absent.pem"), "ca_file"), ("", "certificate")):
        untrusted = ObserverClient(hello(tmp_path, address, **section, ca_file=ca_file))
        await untrusted.start()

        def trouble(client: ObserverClient = untrusted) -> str:
            said = client.statistics()
            return str(said.get("trouble", "")) + str((said.get("mqtt") or {}).get("trouble", ""))

        await until(lambda word=word, trouble=trouble: word in trouble())
        await untrusted.stop()
    broker.stop()


async def test_everything_published_conforms_to_the_schemas(control: Control, broker: Mosquitto) -> None:
    state = {
        "vehicle": "monocab", "mode": "disarmed", "experiment": None, "phase": "none", "code": "disarmed", "reason": "",
        "load": {"torque": 550.0, "ramp": 1.0, "announcement": "Sit down now"},
        "tilt": {"duration": 5.0, "announcement": "Tilt it over now"},
        "spin": {"up": True, "announcement": "Switch them on now"},
        "interlocks": [], "stays_down": [],
        "faults": [], "version": "1", "since": 1.0, "held_by": None, "commands": True,
    }  # fmt: skip
    health = {
        "cycles": 5, "missed_cycles": 0, "rate": 250.0,
        "buses": [{"address": "virtual:x", "load_percent": 12.0, "dropped": 0, "error_frames": 0}],
    }  # fmt: skip
    async with Watcher(broker.port) as watcher:
        await asyncio.sleep(0.5)
        control.client.retain("state", state)
        control.client.progress("sweep", 0.25, 30.0)
        control.client.event("info", "code", "text")
        await record(control.client, cycles())
        control.client.health(health)
        for frame in cycles()[:100]:  # a minute later, few enough for none to be dropped
            control.client.offer(Frame(frame.timestamp_ns + 60_000_000_000, frame.values))
        await until(lambda: any("health" in each for each in watcher.of("telemetry")))
        for topic in ("state", "progress", "event", "diagnosis", "telemetry", "parameters", "methods"):
            await until(lambda topic=topic: watcher.of(topic))
            model = Parameter if topic == "parameters" else TOPICS[topic]
            for message in watcher.of(topic):
                for document in message.values() if topic == "parameters" else [message]:
                    model.model_validate(document)


async def test_published_predictions_are_close_to_the_measurement(control: Control, broker: Mosquitto) -> None:
    """The segments that the model predicts, half a second each, compared with the cycles that they predict."""
    frames = cycles()
    roll = {round(frame.timestamp_ns * 1e-9, 3): frame.values[0] for frame in frames}
    async with Watcher(broker.port) as watcher:
        await asyncio.sleep(0.5)
        await until(lambda: control.client.ready)
        segments: list[dict[str, Any]] = []
        # A model that was compiled before is ready within seconds; the first half of the run yields the estimates.
        for place in range(0, len(frames), 50):
            for frame in frames[place : place + 50]:
                control.client.offer(frame)
            await asyncio.sleep(0.1)
        await until(lambda: [each for batch in watcher.of("telemetry") for each in batch.get("predictions", [])])
        segments = [each for batch in watcher.of("telemetry") for each in batch.get("predictions", [])]
    errors, magnitudes = [], []
    for segment in segments:
        for place, predicted in enumerate(segment["values"]["roll"]):
            measured = roll.get(round(segment["t0"] + place * segment["dt"], 3))
            if measured is not None:
                errors.append(abs(predicted - measured))
                magnitudes.append(abs(measured))
        assert max(map(abs, segment["innovations"]["roll_rate"])) < 0.05
    assert len(errors) > 100
    # With CAD values that are 15 % off, half a second ahead, on a plant with an unstable pole at 3/s, the error is a
    # fraction of the motion.
    assert sum(errors) < 0.5 * sum(magnitudes)


async def test_home_assistant_finds_its_sensors(control: Control, broker: Mosquitto) -> None:
    from mosquitto import PASSWORDS

    name = "homeassistant"
    async with aiomqtt.Client("127.0.0.1", broker.port, username=name, password=PASSWORDS[name]) as assistant:
        await assistant.subscribe("homeassistant/#", qos=1)
        found: dict[str, Any] = {}
        async with asyncio.timeout(20.0):
            async for message in assistant.messages:
                assert isinstance(message.payload, bytes)
                assert message.retain
                found[str(message.topic)] = json.loads(message.payload)
                if any("inertia" in topic for topic in found):
                    break
    assert "homeassistant/sensor/upright-monocab/inertia/config" in found
