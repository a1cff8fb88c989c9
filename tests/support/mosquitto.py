"""A real broker: mosquitto with passwords and an access list, started and stopped on demand; for the tests of MQTT."""

from __future__ import annotations

import asyncio
import json
import os
import shutil
import socket
import subprocess
import time
from pathlib import Path
from typing import Any

import aiomqtt
import pytest

PUBLISHER, WATCHER, STRANGER, OPERATOR = "upright", "viewer", "stranger", "dashboard"
PASSWORDS = {PUBLISHER: "balance", WATCHER: "look", STRANGER: "touch", OPERATOR: "steer", "homeassistant": "see"}
ACL = Path(__file__).resolve().parents[2] / "broker" / "acl"
"""The shipped access list."""


def _command(name: str) -> str:
    path = shutil.which(name, path=f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin")
    if path is None:
        pytest.skip(f"no {name} here: apt-get install mosquitto")
    return path


class Mosquitto:
    """A broker on a free port of this machine, with the shipped access list. Nothing persists when it ends.

    With `tls` it uses TLS, with a certificate for "localhost" that `ca_file` signed.
    """

    def __init__(self, folder: Path, *, tls: bool = False) -> None:
        self._folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port: int = probe.getsockname()[1]
        passwords = folder / "passwords"
        passwords.write_text("".join(f"{user}:{password}\n" for user, password in PASSWORDS.items()))
        subprocess.run([_command("mosquitto_passwd"), "-U", passwords], check=True)
        self.ca_file = folder / "ca.pem"
        (folder / "password").write_text(PASSWORDS[PUBLISHER] + "\nignored\n")
        self._acl = folder / "acl"
        self._acl.write_text(ACL.read_text())
        self._config = folder / "mosquitto.conf"
        self._config.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous false\npassword_file {passwords}\nacl_file {self._acl}\n"
            "persistence false\nlog_dest stderr\n"
            + (_certificates(folder) if tls else "")
            + "user root\n"  # Started by root, it would become a user that cannot read this folder; else no effect.
        )

    def add_operator(self, user: str) -> None:
        """A further user who may give commands, from the next start on."""
        lines = f"user {user}\ntopic read upright/#\ntopic write upright/+/cmd/{user}/+\n"
        self._acl.write_text(f"{ACL.read_text()}\n{lines}")

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.port}"

    @property
    def login(self) -> dict[str, str]:
        """The keys of [mqtt] with which the vehicle logs in."""
        return {"username": PUBLISHER, "password_file": str(self._folder / "password")}

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self) -> None:
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen([_command("mosquitto"), "-c", self._config], stderr=log)
        limit = time.monotonic() + 10.0
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            assert time.monotonic() < limit, (self._folder / "log").read_text()
            time.sleep(0.02)

    def stop(self) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.wait(10)
            self._process = None


def _certificates(folder: Path) -> str:
    """Makes an authority and a certificate for localhost. Returns the lines of the configuration."""

    def openssl(*words: str | Path) -> None:
        subprocess.run([_command("openssl"), *words], check=True, capture_output=True, cwd=folder)

    key = ("-newkey", "rsa:2048", "-nodes")
    openssl("req", "-x509", *key, "-keyout", "ca.key", "-out", "ca.pem", "-days", "2", "-subj", "/CN=test authority",
            "-addext", "keyUsage=critical,keyCertSign,cRLSign")  # fmt: skip
    openssl("req", *key, "-keyout", "server.key", "-out", "server.csr", "-subj", "/CN=localhost")
    (folder / "extensions").write_text("subjectAltName=DNS:localhost\n")
    openssl("x509", "-req", "-in", "server.csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-CAcreateserial", "-days", "2",
            "-extfile", "extensions", "-out", "server.pem")  # fmt: skip
    return f"certfile {folder / 'server.pem'}\nkeyfile {folder / 'server.key'}\n"


class Watcher:
    """A client that subscribes to all topics. `messages` are (topic below the vehicle, payload, retained), in order."""

    def __init__(self, port: int, user: str = WATCHER) -> None:
        self.messages: list[tuple[str, Any, bool]] = []
        self._client = aiomqtt.Client("127.0.0.1", port, username=user, password=PASSWORDS[user])

    async def __aenter__(self) -> Watcher:
        await self._client.__aenter__()
        await self._client.subscribe("upright/#", qos=1)
        self._task = asyncio.create_task(self._watch())
        return self

    async def __aexit__(self, *error: Any) -> None:
        self._task.cancel()
        await asyncio.gather(self._task, return_exceptions=True)
        await self._client.__aexit__(None, None, None)

    async def _watch(self) -> None:
        async for message in self._client.messages:
            topic = str(message.topic).removeprefix("upright/monocab/")
            assert isinstance(message.payload, bytes)
            text = message.payload.decode()
            self.messages.append((topic, text if topic == "status" else json.loads(text), bool(message.retain)))

    async def publish(self, topic: str, payload: bytes | str, *, retain: bool = False) -> None:
        """Publish to a topic below the vehicle, if the broker permits it to this user."""
        await self._client.publish(f"upright/monocab/{topic}", payload, qos=1, retain=retain)

    def of(self, topic: str) -> list[Any]:
        """Payloads of a topic, in order."""
        return [payload for name, payload, _ in self.messages if name == topic]
