"""docker-compose.yml without an engine: the files that it mounts exist, the commands that it starts are valid.

The topology itself runs in test_dashboard.py, where `broker/topology` starts it from Debian's packages; here the two
are compared: they have the same broker configuration and the same options of `upright`.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import socket
import subprocess
import time
import tomllib
from pathlib import Path
from typing import Any

import pytest
import typer
import yaml

from upright.service.cli import app
from upright.vehicles.file import load

REPOSITORY = Path(__file__).resolve().parents[2]
PLAIN, CAN = "docker-compose.yml", "docker-compose.can.yml"
IMAGE = Path("/opt/upright")
"""Where the Dockerfile puts the repository."""
OURS = ("upright", "dashboard")
KEYS = {
    "build", "cap_drop", "command", "depends_on", "entrypoint", "image", "network_mode", "ports", "restart",
    "stop_grace_period", "user", "volumes",
}  # fmt: skip
"""Keys of a service that are used here, from the Compose specification."""


def read(*names: str) -> dict[str, Any]:
    """The services of these files, merged as compose does it, with the default of each `${NAME:-DEFAULT}`."""
    services: dict[str, Any] = {}
    for name in names:
        text = re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", (REPOSITORY / name).read_text())
        for service, keys in yaml.safe_load(text)["services"].items():
            there = services.setdefault(service, {})
            volumes = there.get("volumes", []) + keys.get("volumes", [])
            there.update(keys, **({"volumes": volumes} if volumes else {}))
    return services


def command(service: dict[str, Any]) -> list[str]:
    """The arguments of `upright` in the last command that the container runs."""
    given = service["command"]
    if isinstance(given, str):
        return shlex.split(given)
    assert service["entrypoint"] == ["sh", "-c"]
    words = shlex.split(given[0])
    assert words[words.index("exec") + 1] == "upright"
    return words[words.index("exec") + 2 :]


def parse(words: list[str]) -> dict[str, Any]:
    """The parameters that the program parses from a command line, without running it. Raises if it would refuse it."""
    group = typer.main.get_command(app)
    name, *rest = words
    found = group.get_command(None, name)  # type: ignore[attr-defined]
    assert found is not None, f"there is no `upright {name}`"
    return dict(found.make_context(name, rest).params)


@pytest.mark.parametrize("files", [(PLAIN,), (PLAIN, CAN)], ids=["virtual", "can"])
def test_compose_knows_every_key(files: tuple[str, ...]) -> None:
    for service in read(*files).values():
        assert set(service) <= KEYS
    docker = shutil.which("docker")
    if docker is None or subprocess.run([docker, "compose", "version"], capture_output=True).returncode:
        return  # no client, or one without compose
    words = [word for name in files for word in ("-f", name)]
    done = subprocess.run([docker, "compose", *words, "config", "-q"], cwd=REPOSITORY, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("files", [(PLAIN,), (PLAIN, CAN)], ids=["virtual", "can"])
def test_mounts_and_dependencies_exist(files: tuple[str, ...]) -> None:
    services = read(*files)
    named = yaml.safe_load((REPOSITORY / PLAIN).read_text())["volumes"]
    for name, service in services.items():
        assert ("build" in service) != ("image" in service), name
        assert set(service.get("depends_on", ())) <= services.keys()
        for volume in service["volumes"]:
            source = volume.split(":")[0]
            assert (REPOSITORY / source).exists() if source.startswith(".") else source in named, volume
    # Writer and readers of the passwords use the same volume.
    assert "secrets:/secrets" in services["passwords"]["volumes"]
    assert all("secrets:/secrets:ro" in services[name]["volumes"] for name in OURS)


@pytest.mark.parametrize("files", [(PLAIN,), (PLAIN, CAN)], ids=["virtual", "can"])
def test_service_commands_parse_and_agree_on_folders_and_ports(files: tuple[str, ...]) -> None:
    services = read(*files)
    daemon, page = (parse(command(services[name])) for name in OURS)
    assert daemon["virtual"] == (files == (PLAIN,))
    assert str(daemon["data"]) == str(page["data"]) == "/data"
    assert any(volume.startswith("recordings:/data") for volume in services["upright"]["volumes"])
    # A browser runs on the host: it reaches broker and page by the published ports, which only this machine sees.
    ports = {port.rpartition(":")[0] for name in ("broker", "dashboard") for port in services[name]["ports"]}
    assert ports == {"127.0.0.1:1883", "127.0.0.1:9001", "127.0.0.1:8765"}
    assert page["websocket"] == "ws://localhost:9001"
    assert (page["host"], page["port"]) == ("0.0.0.0", 8765)


def test_image_has_the_required_python_and_the_files_that_the_services_use() -> None:
    lines = (REPOSITORY / "Dockerfile").read_text().replace("\\\n", "").splitlines()
    words = {line.split()[0]: line.split()[1:] for line in lines}  # the last one of each
    version = re.match(r"python:(\d+\.\d+)\.\d+-slim", words["FROM"][0])
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    least = tuple(int(part) for part in project["requires-python"].removeprefix(">=").split("."))
    assert version is not None
    assert tuple(int(part) for part in version[1].split(".")) >= least
    assert words["COPY"] == [".", str(IMAGE)]
    assert words["RUN"][:2] == ["pip", "install"]
    assert str(IMAGE) in words["RUN"]
    assert words["ENTRYPOINT"] == ['["upright"]']
    assert "upright" in project["scripts"]
    ignored = (REPOSITORY / ".dockerignore").read_text().split()
    for inside in re.findall(rf"{IMAGE}/(\S+)", (REPOSITORY / PLAIN).read_text() + (REPOSITORY / CAN).read_text()):
        assert (REPOSITORY / inside).exists(), inside
        assert Path(inside).parts[0] not in ignored, inside


def test_generated_vehicle_file_loads_and_matches_the_broker(tmp_path: Path) -> None:
    text = " ".join(command_text for command_text in read(PLAIN)["upright"]["command"])
    maker, vehicle, broker, secret = shlex.split(text.split(">")[0])
    password = tmp_path / "upright"
    password.write_text("something")
    here = [str(REPOSITORY / Path(each).relative_to(IMAGE)) for each in (maker, vehicle)]
    made = subprocess.run([*here, broker, str(password)], capture_output=True, text=True, check=True).stdout
    (tmp_path / "vehicle.toml").write_text(made)
    mqtt = load(str(tmp_path / "vehicle.toml")).mqtt
    assert (mqtt.broker, mqtt.username, mqtt.commands) == ("broker:1883", "upright", True)
    # The broker of that name listens there, and its script makes the password.
    assert "broker" in read(PLAIN)
    assert "listener 1883" in (REPOSITORY / "broker" / "mosquitto.conf").read_text()
    assert Path(secret).name in (REPOSITORY / "broker" / "make-passwords").read_text()


def test_mosquitto_listens_with_the_broker_configuration(tmp_path: Path) -> None:
    """With the mounted files, except for the container's folders and the ports, which may be in use here."""
    path = f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin"
    mosquitto = shutil.which("mosquitto", path=path)
    if mosquitto is None:
        pytest.skip("no mosquitto here: apt-get install mosquitto")
    service = read(PLAIN)["broker"]
    mounts = dict(volume.split(":")[:2][::-1] for volume in service["volumes"])
    configuration = service["command"].removeprefix("mosquitto -c ")
    subprocess.run([REPOSITORY / "broker" / "make-passwords", tmp_path / "secrets"], check=True)
    text = (REPOSITORY / mounts[configuration]).read_text()
    for inside, outside in mounts.items():
        text = text.replace(inside, str(tmp_path / outside if outside == "secrets" else REPOSITORY / outside))
    with socket.socket() as first, socket.socket() as second:
        first.bind(("127.0.0.1", 0))
        second.bind(("127.0.0.1", 0))
        ports = [each.getsockname()[1] for each in (first, second)]
    for before, port in zip(("1883", "9001"), ports, strict=True):
        text = text.replace(f"listener {before}\n", f"listener {port} 127.0.0.1\n")
    (tmp_path / "mosquitto.conf").write_text(text + ("user root\n" if os.geteuid() == 0 else ""))
    with subprocess.Popen([mosquitto, "-c", tmp_path / "mosquitto.conf"], stderr=subprocess.PIPE) as process:
        try:
            _until_listening(ports, process)
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:  # happens rarely, while it waits for its WebSockets
                process.kill()


def _until_listening(ports: list[int], process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + 20.0
    for port in ports:
        while True:
            assert process.poll() is None, process.stderr and process.stderr.read().decode()
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            assert time.monotonic() < end, f"nothing listens at {port}"
            time.sleep(0.05)


def test_topology_script_starts_the_services_with_the_same_options() -> None:
    """`broker/topology`: the daemon and the page have the options of the compose file; their values may differ."""
    script = (REPOSITORY / "broker" / "topology").read_text().replace("\\\n", " ")
    for name in OURS:
        verb, *words = command(read(PLAIN)[name])
        line = next(each for each in script.splitlines() if each.startswith(f'"$upright" {verb} '))
        options = {word for word in shlex.split(line) if word.startswith("--")}
        assert options - {"--port"} == {word for word in words if word.startswith("--")} - {"--host"}
    assert "/mosquitto.conf" in script
    assert "/make-passwords" in script
    assert "/make-vehicle" in script
