"""MQTT against a real broker with passwords and an access list: what is published, and operation without a broker."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import aiomqtt
import numpy as np
import pytest
from monocab_channels import MONOCAB
from mosquitto import Mosquitto, Watcher
from observer_harness import cycles, hello, record, until

from upright.estimators.disturbance_estimate import DisturbanceEstimate
from upright.service.mqtt import topics as mqtt_topics
from upright.service.mqtt.client import MOST_EVENTS, MOST_TELEMETRY, MqttConfig, MqttConfigError, MqttPublisher
from upright.service.mqtt.embedded_broker import USER, EmbeddedBroker
from upright.service.mqtt.payloads import TelemetryBatches, methods, parameters
from upright.service.observer.client import ObserverClient
from upright.telemetry.samples import Frame
from upright.vehicles.sections import MqttSection

STATE = {"vehicle": "monocab", "mode": "disarmed", "interlocks": ["The vehicle does not rest."], "faults": []}


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    broker = Mosquitto(tmp_path)
    broker.start()
    yield broker
    broker.stop()


@pytest.fixture
async def client(tmp_path: Path, broker: Mosquitto) -> AsyncIterator[ObserverClient]:
    """An observer that publishes to the broker."""
    client = ObserverClient(hello(tmp_path, broker.address, **broker.login))
    await client.start()
    yield client
    await client.stop()


async def connected(client: ObserverClient) -> None:
    await until(lambda: (client.statistics().get("mqtt") or {}).get("connected"))


async def test_experiment_publishes_state_events_progress_and_results(
    client: ObserverClient, broker: Mosquitto
) -> None:
    client.retain("state", {"mode": "starting"})
    client.retain("state", STATE)
    await connected(client)
    frames = cycles()
    async with Watcher(broker.port) as watcher:
        await until(lambda: watcher.of("state"))
        assert ("status", "online", True) in watcher.messages
        assert ("state", STATE, True) in watcher.messages
        client.event("warning", "end", "an operator requested the end")
        client.progress("sweep", 0.25, 30.0)
        summary = await record(client, frames)
        await until(lambda: watcher.of("parameters") and watcher.of("telemetry"))
        await until(lambda: watcher.of("parameters")[-1] == parameters(summary["estimates"]))
        await until(lambda: watcher.of("methods")[-1:] == [methods(summary["estimates"])])
        await until(lambda: watcher.of("diagnosis") and watcher.of("diagnosis")[-1] == summary["diagnosis"])
        published = {each["code"]: each for each in watcher.of("event")}
        assert published.pop("end") == {"severity": "warning", "code": "end", "text": "an operator requested the end"}
        # The effects named at the end, and perhaps others before: each is published once.
        named = summary["diagnosis"]["findings"]
        events = [each["text"] for each in watcher.of("event") if each["code"] == "missing_effect"]
        assert published.keys() <= {"missing_effect"}
        assert len(events) == len(set(events))
        assert all(any(each["effect"] in text for text in events) for each in named)
        assert watcher.of("progress") == [{"task": "sweep", "fraction": 0.25, "remaining": 30.0}]
    async with Watcher(broker.port) as late:
        await until(lambda: late.of("parameters") and late.of("diagnosis"))
        name, entry = next(iter(late.of("parameters")[0].items()))
        assert name == "inertia"
        assert entry.keys() >= {"value", "std", "unit", "status", "method"}
        assert late.of("diagnosis")[0] == summary["diagnosis"]
        assert not late.of("telemetry")


async def test_telemetry_publishes_the_cycles_in_batches(client: ObserverClient, broker: Mosquitto) -> None:
    frames = cycles()[:500]
    await connected(client)
    async with Watcher(broker.port) as watcher:
        for frame in frames:
            client.offer(frame)
            if frame.timestamp_ns % 200_000_000 == 0:
                await asyncio.sleep(0.02)  # a little slower than the broker can process
        await until(lambda: sum(len(batch["roll"]) for batch in watcher.of("telemetry")) >= 450)
    batches = watcher.of("telemetry")
    assert len(batches) >= 36  # 20 per second for 2 s, less those that are not full yet
    rows = 0
    for batch in batches:
        assert set(batch) - {"predictions"} == {"t0", "dt", *MONOCAB.names}
        assert batch["dt"] == pytest.approx(0.004)
        for name in ("roll", "excitation"):
            place = MONOCAB.index_of(name)
            sent = [frame.values[place] for frame in frames[rows : rows + len(batch[name])]]
            np.testing.assert_allclose(batch[name], sent, rtol=1e-6)
        assert batch["t0"] == pytest.approx(frames[rows].timestamp_ns * 1e-9, abs=1e-6)
        rows += len(batch["roll"])


async def test_killed_observer_is_published_as_offline_and_a_new_one_as_online(
    client: ObserverClient, broker: Mosquitto
) -> None:
    client.retain("state", STATE)
    await connected(client)
    assert client.pid is not None
    async with Watcher(broker.port) as watcher:
        await until(lambda: watcher.of("status"))
        os.kill(client.pid, signal.SIGKILL)
        await until(lambda: watcher.of("status") == ["online", "offline"])
        await until(lambda: not client.alive)
        await client.restart()
        await until(lambda: watcher.of("status") == ["online", "offline", "online"])
        await until(lambda: watcher.of("state") == [STATE, STATE])


async def test_offline_status_is_published_on_stop(client: ObserverClient, broker: Mosquitto) -> None:
    await connected(client)
    async with Watcher(broker.port) as watcher:
        await until(lambda: watcher.of("status"))
        await client.stop()
        await until(lambda: watcher.of("status") == ["online", "offline"])
    async with Watcher(broker.port) as late:
        await until(lambda: late.of("status"))
        assert late.messages == [("status", "offline", True)]


async def test_recording_continues_without_the_broker_and_publishing_resumes(
    client: ObserverClient, broker: Mosquitto
) -> None:
    frames = cycles()
    client.retain("state", STATE)
    await connected(client)
    broker.stop()
    summary = await record(client, frames)  # as if there had never been a broker
    assert (summary["failure"], summary["rows"]) == ("", len(frames))
    await until(lambda: client.statistics()["mqtt"]["trouble"])
    client.event("info", "while_away", "told later")
    client.retain("state", {**STATE, "mode": "running"})
    broker.start()
    async with Watcher(broker.port) as watcher:
        await until(lambda: watcher.of("status") == ["online"])
        await until(lambda: watcher.of("state") == [{**STATE, "mode": "running"}])
        await until(lambda: watcher.of("parameters") == [parameters(summary["estimates"])])
        for frame in frames[:100]:
            client.offer(Frame(frame.timestamp_ns + 60_000_000_000, frame.values))
        await until(lambda: watcher.of("telemetry"))
        # Old telemetry is not sent later, except for the batch that was not full yet.
        assert watcher.of("telemetry")[0]["t0"] >= frames[-1].timestamp_ns * 1e-9 - 0.05
    await until(lambda: client.statistics()["mqtt"]["connections"] == 2)
    assert client.statistics()["mqtt"]["dropped"] > 0


async def test_hanging_broker_affects_neither_recording_nor_shutdown(client: ObserverClient, broker: Mosquitto) -> None:
    frames = cycles()
    await connected(client)
    os.kill(broker.pid, signal.SIGSTOP)
    try:
        summary = await record(client, frames)
        assert (summary["failure"], summary["rows"]) == ("", len(frames))
        assert client.statistics()["frames_dropped"] == 0
        await client.stop()
        assert not client.alive
    finally:
        os.kill(broker.pid, signal.SIGCONT)


async def test_wrong_or_missing_password_is_reported_and_recording_still_works(
    tmp_path: Path, broker: Mosquitto
) -> None:
    wrong = tmp_path / "wrong"
    wrong.write_text("guess\n")
    client = ObserverClient(hello(tmp_path, broker.address, username="upright", password_file=str(wrong)))
    await client.start()
    await until(lambda: "uthor" in (client.statistics().get("mqtt") or {}).get("trouble", ""))
    wrong.unlink()
    await client.stop()
    client = ObserverClient(hello(tmp_path, broker.address, username="upright", password_file=str(wrong)))
    await client.start()
    await until(lambda: "password_file" in client.statistics().get("trouble", ""))
    summary = await record(client, cycles()[:100])
    assert summary["failure"] == ""
    await client.stop()


def section(**changes: Any) -> dict[str, Any]:
    return {**MqttSection().model_dump(), "broker": "localhost:1883", **changes}


def test_settings_are_parsed_and_invalid_ones_are_refused() -> None:
    assert MqttConfig.of(section(broker=""), "monocab") is None
    config = MqttConfig.of(section(base="hall/7"), "monocab")
    assert config is not None
    assert (config.host, config.port, config.topic, config.username) == ("localhost", 1883, "hall/7/monocab", None)
    for wrong in ({"broker": "localhost:0"}, {"broker": "localhost:70000"}, {"password_file": "/absent/file"}):
        with pytest.raises(MqttConfigError) as caught:
            MqttConfig.of(section(**wrong), "monocab")
        assert caught.value.remedy


async def test_queues_are_bounded_without_a_broker() -> None:
    config = MqttConfig.of(section(broker="localhost:1"), "monocab")
    assert config is not None
    publisher = MqttPublisher(config)
    for i in range(3 * MOST_EVENTS):
        publisher.publish("event", {"number": i})
        publisher.telemetry(b"{}")
    assert publisher.statistics.dropped == 2 * MOST_EVENTS + 3 * MOST_EVENTS
    publisher.statistics.connected = True
    for _ in range(3 * MOST_TELEMETRY):
        publisher.telemetry(b"{}")
    assert publisher.statistics.dropped == 5 * MOST_EVENTS + 2 * MOST_TELEMETRY


@pytest.mark.parametrize("host", ["no-such-host.invalid", "x" * 70 + ".invalid"])
async def test_unknown_host_is_reported_and_the_publisher_can_be_closed(host: str) -> None:
    config = MqttConfig.of(section(broker=f"{host}:1883"), "monocab")
    assert config is not None
    publisher = MqttPublisher(config)
    running = asyncio.create_task(publisher.run())
    await until(lambda: publisher.statistics.trouble != "not connected yet")
    publisher.close()
    await running
    assert not publisher.statistics.connected


async def test_embedded_broker_keeps_retained_messages() -> None:
    async with EmbeddedBroker() as broker:
        host, _, port = broker.address.partition(":")
        config = MqttConfig.of(section(broker=broker.address), "monocab")
        assert config is not None
        publisher = MqttPublisher(config)
        publisher.retain("state", STATE)
        running = asyncio.create_task(publisher.run())
        await until(lambda: publisher.statistics.published == 1)
        # Over websockets, as a browser would.
        place, _, websocket = broker.websocket.removeprefix("ws://").partition(":")
        assert (host, int(port)) != (place, int(websocket))
        async with aiomqtt.Client(place, int(websocket), transport="websockets") as watcher:
            await watcher.subscribe("upright/#")
            seen: dict[str, bytes] = {}
            async for message in watcher.messages:
                assert isinstance(message.payload, bytes)
                seen[str(message.topic)] = message.payload
                if len(seen) == 2:
                    break
        assert seen["upright/monocab/status"] == b"online"
        assert json.loads(seen["upright/monocab/state"]) == STATE
        publisher.close()
        await running


async def test_embedded_broker_takes_commands_with_its_password_only() -> None:
    taken: list[tuple[str, str]] = []
    topic = f"upright/monocab/cmd/{USER}/stop"
    async with EmbeddedBroker() as broker:
        config = MqttConfig.of(section(broker=broker.address, commands=True), "monocab")
        assert config is not None
        publisher = MqttPublisher(config, lambda user, verb, payload, retained: taken.append((verb, payload.decode())))
        running = asyncio.create_task(publisher.run())
        await until(lambda: publisher.statistics.connected)
        host, _, port = broker.address.partition(":")
        password = broker.password
        for who in ((None, None), ("other", password), (USER, None), (USER, "guess"), (USER, password)):
            with suppress(aiomqtt.MqttError):
                async with aiomqtt.Client(host, int(port), username=who[0], password=who[1]) as client:
                    await client.publish(topic, f"{who}", qos=1)
        will = aiomqtt.Will(topic, "a last will", qos=1)
        with pytest.raises(aiomqtt.MqttError):
            await aiomqtt.Client(host, int(port), will=will).__aenter__()
        await until(lambda: taken)
        publisher.close()
        await running
    assert taken == [("stop", f"{(USER, password)}")]


def batches(stamps: list[int], rate: float = 250.0) -> list[dict[str, Any]]:
    cutter = TelemetryBatches(("roll", "pitch"), rate, 20.0)
    frames = [Frame(stamp, (float(i), float("nan"))) for i, stamp in enumerate(stamps)]
    return [json.loads(document) for document in cutter.add(frames)]


def test_batch_ends_at_a_gap_and_where_time_goes_back() -> None:
    ms = 1_000_000
    regular = batches([4 * ms * i for i in range(40)])
    assert [len(batch["roll"]) for batch in regular] == [13, 13, 13]
    assert regular[0]["pitch"] == [None] * 13
    gap = batches([0, 4 * ms, 8 * ms, 20 * ms, 24 * ms, 10 * ms, 14 * ms, 100 * ms])
    assert [batch["roll"] for batch in gap] == [[0, 1, 2], [3, 4], [5, 6]]
    assert [batch["t0"] for batch in gap] == [0.0, 0.02, 0.01]
    assert batches([0, 100 * ms])[0]["dt"] == 0.004


def test_parameters_are_those_of_the_last_method_that_has_them() -> None:
    def entry(value: float | None) -> dict[str, Any]:
        keys = {"std": None, "unit": "kg m^2", "status": "ok", "coverage_percent": 100.0, "reason": ""}
        return {"value": value, "identifiable": value is not None, **keys}

    both = {"plain": {"parameters": {"inertia": entry(1.0)}}, "instrumental": {"parameters": {"inertia": entry(2.0)}}}
    assert parameters(both)["inertia"]["method"] == "instrumental"
    both["instrumental"]["parameters"]["inertia"] = entry(None)
    assert (parameters(both)["inertia"]["method"], parameters(both)["inertia"]["value"]) == ("plain", 1.0)
    both["plain"]["parameters"]["inertia"] = entry(None)
    assert parameters(both)["inertia"]["value"] is None


@pytest.mark.parametrize("shown", [True, False])
def test_disturbance_is_published_with_the_parameters(shown: bool) -> None:
    estimate = DisturbanceEstimate("roll", "N m", 8.1, *((0.4, 0.31, 0.03) if shown else (None,) * 3), shown=shown)
    published = parameters({"recursion": {"parameters": {}, "disturbance": {"roll": estimate.to_json()}}})
    for entry in published.values():
        mqtt_topics.Parameter.model_validate(entry)
    rms, time = published["disturbance.roll.rms"], published["disturbance.roll.correlation_time"]
    assert (rms["value"], time["value"]) == ((8.1, 0.31) if shown else (None, None))
    assert (rms["unit"], time["unit"]) == ("N m", "s")
    assert rms["reason"] == ("" if shown else "no disturbance shows: less than 8.1 N m RMS")
    mqtt_topics.Diagnosis.model_validate(
        {"adequate": True, "verdict": "adequate", "findings": [], "disturbance": {"roll": estimate.to_json()}}
    )


def test_methods_are_published_side_by_side_with_where_they_part() -> None:
    def of(value: float) -> dict[str, Any]:
        entry = {"value": value, "std": 0.1, "unit": "kg m^2", "status": "ok", "coverage_percent": 9.0, "reason": ""}
        return {"parameters": {"inertia": entry}}

    disturbance = DisturbanceEstimate("roll", "N m", 8.1, 0.4, 0.31, 0.03, shown=True)
    second = {**of(2.0), "disturbance": {"roll": disturbance.to_json()}}
    published = methods({"starting": {"parameters": {}, "status": "starting"}, "first": of(1.0), "second": second})
    mqtt_topics.Methods.model_validate(published)
    assert published["estimates"]["starting"] == {}
    assert published["estimates"]["first"] == {"inertia": {"value": 1.0, "std": 0.1, "unit": "kg m^2", "status": "ok"}}
    assert published["estimates"]["second"]["disturbance.roll.rms"]["value"] == 8.1
    (parting,) = published["parting"]
    assert (parting["parameter"], parting["methods"], parting["sigmas"]) == ("inertia", ["first", "second"], 7.07)
    assert parting["text"].startswith("inertia: first and second part, by 7.1 standard deviations")
