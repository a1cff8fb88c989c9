"""The broker's password is in no recording, log, message, status or error: vehicle files and messages hold its path."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from observer_harness import VEHICLE, cycles, hello, record

from upright.service.mqtt.client import MqttConfig
from upright.service.observer.client import ObserverClient
from upright.telemetry.errors import UprightError
from upright.vehicles.file import load
from upright.vehicles.sections import MqttSection

SECRET = "a-password-that-is-nowhere-else"


@pytest.fixture
def login(tmp_path: Path) -> dict[str, Any]:
    """The keys of [mqtt] with which the vehicle logs in, at a broker that is not there."""
    file = tmp_path / "password"
    file.write_text(f"{SECRET}\n")
    return {"broker": "127.0.0.1:9", "username": "upright", "password_file": str(file)}


def test_password_is_read_from_its_file_and_not_shown(login: dict[str, Any]) -> None:
    config = MqttConfig.of({**VEHICLE.mqtt.model_dump(), **login}, "monocab")
    assert config is not None
    assert config.password == SECRET
    assert SECRET not in f"{config} {config!r}"


def test_vehicle_file_has_no_key_for_a_secret_and_its_error_does_not_repeat_it(tmp_path: Path) -> None:
    assert [key for key in MqttSection.model_fields if "password" in key] == ["password_file"]
    text = Path(VEHICLE.path).read_text().partition("[mqtt]")[0]
    (tmp_path / "mine.toml").write_text(f'{text}\n[mqtt]\nbroker = "localhost:1883"\npassword = "{SECRET}"\n')
    with pytest.raises(UprightError, match="password") as caught:
        load(str(tmp_path / "mine.toml"))
    assert SECRET not in f"{caught.value} {caught.value!r}"


async def test_password_is_in_nothing_that_the_observer_writes_or_reports(
    tmp_path: Path, login: dict[str, Any], capfd: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"
    data.mkdir()
    told = hello(data, **login)
    assert SECRET not in json.dumps(told)
    client = ObserverClient(told)
    await client.start()
    summary = await record(client, cycles()[:500])
    async with asyncio.timeout(20.0):
        while not (statistics := client.statistics()).get("mqtt", {}).get("trouble"):
            await asyncio.sleep(0.02)  # it has not tried yet
    await client.stop()
    written = {path: path.read_bytes() for path in data.rglob("*") if path.is_file()}
    assert {path.suffix for path in written} >= {".arrow", ".log"}
    everything = [*written.values(), json.dumps([summary, statistics], default=str).encode()]
    everything.append("".join(capfd.readouterr()).encode())
    assert [content for content in everything if SECRET.encode() in content] == []
