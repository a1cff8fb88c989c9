"""The control socket: answers arrive line by line, and every failure is reported."""

from __future__ import annotations

import asyncio
import socket
import stat
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.control.api import ApiError, ExitCode, Message, call, result
from service.control.server import ApiServer


async def answer(request: Message) -> AsyncIterator[Message]:
    if request["verb"] == "vanish":
        raise ConnectionResetError
    for number in range(3):
        yield {"type": "progress", "fraction": number / 3}
    yield result(ExitCode.DONE, text=request["verb"])


@pytest.fixture
async def path(tmp_path: Path) -> AsyncIterator[Path]:
    server = ApiServer(tmp_path / "run" / "x.sock", answer)
    await server.start()
    yield tmp_path / "run" / "x.sock"
    await server.close()


async def ask(path: Path, request: Message) -> list[Message]:
    return await asyncio.to_thread(lambda: list(call([path], request)))


async def test_answer_ends_with_its_result(path: Path) -> None:
    messages = await ask(path, {"verb": "status"})
    assert [message["type"] for message in messages] == ["progress"] * 3 + ["result"]
    assert messages[-1] == {"type": "result", "exit_code": 0, "code": "", "text": "status"}


async def test_only_owner_and_group_may_use_the_socket(path: Path) -> None:
    assert stat.S_IMODE(path.stat().st_mode) == 0o660
    assert stat.S_IMODE(path.parent.stat().st_mode) & 0o007 == 0


@pytest.mark.parametrize("line", [b"not json\n", b"[]\n", b'{"verb": 3}\n'])
async def test_malformed_request_is_refused(path: Path, line: bytes) -> None:
    reader, writer = await asyncio.open_unix_connection(str(path))
    writer.write(line)
    assert b'"exit_code": 2' in await reader.readline()
    writer.close()


async def test_client_that_sends_endless_garbage_does_not_disturb_others(path: Path) -> None:
    _, writer = await asyncio.open_unix_connection(str(path))
    writer.write(b"x" * 1_000_000)
    await asyncio.sleep(0.05)
    assert (await ask(path, {"verb": "status"}))[-1]["exit_code"] == 0
    writer.close()


async def test_daemon_that_ends_before_it_answers_is_reported(path: Path) -> None:
    with pytest.raises(ApiError, match="ended before it answered"):
        await ask(path, {"verb": "vanish"})


def test_daemon_that_is_killed_with_a_request_unread_is_reported_alike(tmp_path: Path) -> None:
    """The kernel then resets the connection instead of closing it."""
    place = tmp_path / "x.sock"
    with socket.create_server(str(place), family=socket.AF_UNIX) as daemon, ThreadPoolExecutor(1) as pool:
        asked = pool.submit(lambda: list(call([place], {"verb": "status"})))
        connection, _ = daemon.accept()
        while not connection.recv(1, socket.MSG_PEEK):
            pass
        connection.close()
        with pytest.raises(ApiError, match="ended before it answered"):
            asked.result(timeout=10.0)


async def test_two_daemons_do_not_share_a_socket(path: Path) -> None:
    with pytest.raises(ApiError, match=r"another daemon serves this vehicle.*--socket"):
        await ApiServer(path, answer).start()
    assert (await ask(path, {"verb": "status"}))[-1]["exit_code"] == 0


async def test_socket_left_by_a_killed_daemon_is_taken_over(tmp_path: Path) -> None:
    left = tmp_path / "x.sock"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(left))
    server = ApiServer(left, answer)
    await server.start()
    assert (await ask(left, {"verb": "status"}))[-1]["text"] == "status"
    await server.close()
    assert not left.exists()


async def test_missing_daemon_error_names_the_socket_and_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(ApiError, match=r"no daemon answers.*nothing\.sock.*upright serve"):
        await ask(tmp_path / "nothing.sock", {"verb": "status"})


async def test_unwritable_socket_path_is_named_in_the_error() -> None:
    with pytest.raises(ApiError, match=r"cannot listen at /proc/upright/x\.sock.*--socket"):
        await ApiServer(Path("/proc/upright/x.sock"), answer).start()
