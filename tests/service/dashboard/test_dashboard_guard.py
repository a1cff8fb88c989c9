"""What stands before the dashboard: hosts, origins, token, sizes, times, links, and who gets the broker's password."""

from __future__ import annotations

import http.client
import json
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import typer
from served import TOKEN, served

from upright.service.cli import dashboard as command
from upright.service.dashboard import guard
from upright.service.dashboard.app import Dashboard, Settings
from upright.service.dashboard.recordings import Folder, UnknownRecording
from upright.service.offline.export import export
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording
from upright.telemetry.storage import save
from upright.vehicles.file import load

PASSWORD = "a-password-of-the-broker"
JOB = b'{"kind": "compare", "recordings": []}'
MINE = {guard.TOKEN: TOKEN}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def address(data: Path) -> Iterator[str]:
    settings = Settings(load("monocab"), data, "ws://127.0.0.1:9001", "dashboard", PASSWORD, token=TOKEN)
    assert TOKEN not in repr(settings)
    assert PASSWORD not in repr(settings)
    with served(Dashboard(settings)) as made:
        yield made


def connection(address: str) -> socket.socket:
    made = socket.create_connection(("127.0.0.1", urlsplit(address).port or 0), timeout=10.0)
    made.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return made


def ask(address: str, method: str, path: str, body: bytes | None = None, **headers: str) -> tuple[int, Any]:
    """Status and document of the answer. `path` is sent as it is."""
    place = http.client.HTTPConnection("127.0.0.1", urlsplit(address).port or 0, timeout=10.0)
    given = {"host": urlsplit(address).netloc, **headers}
    place.request(method, path, body, {key.replace("_", "-"): value for key, value in given.items() if value})
    answer = place.getresponse()
    text = answer.read()
    place.close()
    return answer.status, json.loads(text) if text.startswith(b"{") else text


@pytest.mark.parametrize("host", ["evil.example", "evil.example:8765", "localhost.evil.example", "[::2]:80", "1.2.3.4"])
def test_other_host_names_are_refused(address: str, host: str) -> None:
    assert ask(address, "GET", "/api/recordings", host=host)[0] == 421


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1:8765", "[::1]:8765", "[::1]", "LOCALHOST:1"])
def test_names_of_this_machine_are_served(address: str, host: str) -> None:
    assert ask(address, "GET", "/api/recordings", host=host)[0] == 200


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://localhost:1", "https://localhost"])
@pytest.mark.parametrize("method", ["GET", "POST"])
def test_pages_of_other_origins_are_refused(address: str, method: str, origin: str) -> None:
    status, answer = ask(address, method, "/api/recordings", JOB, origin=origin, **MINE)
    assert (status, answer) == (403, {"error": "a page from elsewhere may not use this one."})


@pytest.mark.parametrize(("method", "path"), [("POST", "/api/jobs"), ("DELETE", "/api/jobs/1"), ("PUT", "/api/config")])
@pytest.mark.parametrize("token", ["", "1", TOKEN[:-1], TOKEN + "x", "\xe9"])
def test_changes_need_the_token(address: str, method: str, path: str, token: str) -> None:
    status, answer = ask(address, method, path, JOB, x_upright_token=token)
    assert status == 403
    assert "open the page by the address" in answer["error"]


def test_page_itself_may_change_something(address: str) -> None:
    origin = address.rstrip("/")
    status, answer = ask(address, "POST", "/api/jobs", JOB, origin=origin, **MINE)
    assert (status, answer) == (400, {"error": "give one to eight recordings"})
    assert ask(address, "DELETE", "/api/jobs/1", **MINE) == (404, {"error": "no such job"})


def test_only_pages_with_the_token_get_the_password_of_the_broker(address: str) -> None:
    for token, password in ((TOKEN, PASSWORD), ("guess", ""), ("", "")):
        config = ask(address, "GET", "/api/config", x_upright_token=token)[1]
        assert (config["password"], config["trusted"]) == (password, bool(password))
        assert TOKEN not in str(config)


def test_endless_chunked_body_is_cut_off(address: str) -> None:
    head = f"POST /api/jobs HTTP/1.1\r\nhost: localhost\r\n{guard.TOKEN}: {TOKEN}\r\ntransfer-encoding: chunked\r\n\r\n"
    chunk = b"10000\r\n" + bytes(0x10000) + b"\r\n"
    sent = 0
    with connection(address) as made:
        made.sendall(head.encode())
        answer = b""
        try:
            while sent < 64 << 20:
                made.sendall(chunk)
                sent += len(chunk)
        except ConnectionError:
            pass
        with suppress(ConnectionError):  # the answer is lost if the connection is reset with data on the way
            answer = made.recv(200)
    assert sent < 32 << 20  # what the kernel keeps on the way
    assert not answer or b" 413 " in answer.splitlines()[0]
    status, document = ask(address, "POST", "/api/jobs", b" " * (guard.LARGEST_BODY + 1), **MINE)
    assert status == 413
    assert "at most 10000 bytes" in document["error"]


@pytest.mark.parametrize("start", [b"", b"GET / HTTP/1.1\r\nhost: loc", b"GET / HTTP/1.1\r\nhost: localhost\r\n\r\n"])
def test_connections_without_a_complete_head_are_closed(
    address: str, start: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guard, "HEAD_TIME", 0.4)
    with connection(address) as made:
        began = time.monotonic()
        made.sendall(start)
        made.settimeout(0.05)
        while time.monotonic() < began + 10.0:  # a byte now and then does not prolong it
            try:
                made.sendall(b"x")
                if made.recv(1 << 16) == b"":
                    break
            except TimeoutError:
                continue
            except ConnectionError:
                break
        assert 0.3 < time.monotonic() - began < 5.0


def test_body_that_does_not_come_is_not_waited_for(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "BODY_TIME", 0.2)
    with connection(address) as made:
        head = f"POST /api/jobs HTTP/1.1\r\nhost: localhost\r\n{guard.TOKEN}: {TOKEN}\r\ncontent-length: 9\r\n\r\n"
        made.sendall(head.encode() + b"{")
        assert b" 408 " in made.recv(1000).splitlines()[0]


def _closed(connection: socket.socket) -> bool:
    """Whether the server ends the connection, without an answer."""
    try:
        return connection.recv(1) == b""
    except ConnectionError:
        return True


def test_number_of_connections_is_limited(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "MOST_CONNECTIONS", 3)
    made = [connection(address) for _ in range(4)]
    try:
        assert _closed(made[3])
        made[0].sendall(b"GET /api/recordings HTTP/1.1\r\nhost: localhost\r\n\r\n")
        assert b" 200 " in made[0].recv(1000).splitlines()[0]
    finally:
        for each in made:
            each.close()


def test_server_speaks_no_websockets(address: str) -> None:
    upgrade = {"connection": "Upgrade", "upgrade": "websocket", "sec_websocket_version": "13"}
    status, _ = ask(address, "GET", "/", **upgrade, sec_websocket_key="dGhlIHNhbXBsZSBub25jZQ==")
    assert status == 200  # the page, as without an upgrade


@pytest.mark.parametrize(
    "path",
    [
        "/../app.py", "/%2e%2e/app.py", "/..%2fapp.py", "/vendor/../../app.py", "/%2fetc/passwd", "//etc/passwd",
        "/api/recordings/..%2f..%2fetc%2fpasswd", "/api/recordings/%2e%2e/recording", "/reports/..%2fapp.py",
        "/api/recordings/good.csv/..%2f..%2fsecret",
    ],
)  # fmt: skip
def test_paths_do_not_leave_the_folders(address: str, path: str) -> None:
    status, answer = ask(address, "GET", path)
    assert status in (400, 404)
    assert b"import" not in (answer if isinstance(answer, bytes) else b"")


def test_links_in_the_folder_are_not_followed(address: str, data: Path, tmp_path: Path) -> None:
    secret = tmp_path / "secret.csv"
    secret.write_text("time,roll\n0,0\n")
    (data / "good.csv").write_text("time,roll\n0,0\n")
    for folder in ("reports", "commissioning"):
        (data / folder).mkdir()
        (data / folder / "link.html").symlink_to(secret)
        assert ask(address, "GET", f"/{folder}/link.html")[0] == 404
    (data / "link.csv").symlink_to(secret)
    for suffix in (".log", ".estimates.json"):
        (data / f"good{suffix}").symlink_to(secret)
    listed = Folder(data).list()
    assert [(each["name"], each["log"], each["estimates"]) for each in listed] == [("good.csv", False, False)]
    with pytest.raises(UnknownRecording):
        Folder(data).find("link.csv")
    for what in ("log", "estimates"):
        assert ask(address, "GET", f"/api/recordings/good.csv/{what}")[0] == 404
    assert ask(address, "GET", "/api/recordings/good.csv/recording")[0] == 200


def test_recordings_of_every_format_are_listed_and_opened(tmp_path: Path) -> None:
    """As the readers know them, whatever the case of the suffix; other files of the folder are left out."""
    column = np.linspace(0.0, 0.1, 5)
    channels = ChannelTable((Channel("roll", "rad", "of the body"),))
    recording = Recording(channels, np.arange(5) * 10_000_000, {"roll": column})
    save(recording, tmp_path / "run.arrow")
    export(recording, tmp_path / "run.mat")
    (tmp_path / "RUN.CSV").write_bytes(b"time;roll\n0,00;0,00\n0,01;0,01\n0,02;0,03\n")
    for other in ("run.log", "run.png", "run.estimates.json", "notes.md"):
        (tmp_path / other).touch()
    folder = Folder(tmp_path)
    assert {each["name"] for each in folder.list()} == {"run.arrow", "run.mat", "RUN.CSV"}
    for name, expected in (("run.arrow", column), ("run.mat", column), ("RUN.CSV", [0.0, 0.01, 0.03])):
        assert folder.open(name, 100)["channels"]["roll"]["values"] == pytest.approx(expected)
        assert folder.download(name, "recording") == tmp_path / name


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The options with which the server would have been started."""
    found: list[Any] = []
    monkeypatch.setattr("uvicorn.run", lambda app, **options: found.append(options))
    return found


def test_token_is_printed_or_kept_in_a_file_of_its_owner(
    tmp_path: Path, started: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    command.dashboard(data=tmp_path)
    first = capsys.readouterr().err.partition("#token=")[2].strip()
    command.dashboard(data=tmp_path)
    assert len(first) >= command.SHORTEST_TOKEN
    assert first not in capsys.readouterr().err
    file = tmp_path / "token"
    command.dashboard(data=tmp_path, token_file=file)
    printed = capsys.readouterr().err
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert f"#token=$(cat {file})" in printed
    assert file.read_text().strip() not in printed
    assert all(options["http"] is guard.Bounded and options["ws"] == "none" for options in started)
    file.write_text("short\n")
    with pytest.raises(typer.BadParameter, match="at least 16 characters"):
        command.dashboard(data=tmp_path, token_file=file)
