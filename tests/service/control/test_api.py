"""The control socket: answers arrive line by line, and every failure is reported."""

from __future__ import annotations

import asyncio
import os
import pwd
import socket
import stat
import tempfile
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from upright.service.control.clients import server as server_module
from upright.service.control.clients.api import (
    ApiError,
    ExitCode,
    Message,
    call,
    default_socket,
    result,
    socket_candidates,
)
from upright.service.control.clients.peers import FolderError, Peer, peer_of
from upright.service.control.clients.server import ApiServer


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


def test_kernel_says_who_has_connected() -> None:
    mine, theirs = socket.socketpair()
    with mine, theirs:
        peer = peer_of(mine)
    assert (peer.process, peer.user) == (os.getpid(), os.geteuid())
    assert peer.groups == {os.getegid(), *os.getgroups()}
    assert peer.name == pwd.getpwuid(os.geteuid()).pw_name
    assert Peer(1, 54321, frozenset()).name == "54321"


@pytest.mark.parametrize(
    ("user", "groups", "allowed"),
    [(1000, (), True), (0, (), True), (54321, (7, 30), True), (54321, (7,), False), (54321, (1000,), False)],
)
def test_owner_group_and_root_may_use_the_socket(user: int, groups: tuple[int, ...], allowed: bool) -> None:
    assert Peer(1, user, frozenset(groups)).may_use(owner=1000, group=30) == allowed


async def test_other_user_is_refused_even_if_the_socket_is_open_to_all(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path.chmod(0o666)
    monkeypatch.setattr(server_module, "peer_of", lambda connection: Peer(1, 54321, frozenset((54321,))))
    (refusal,) = await ask(path, {"verb": "vanish"})
    assert (refusal["exit_code"], refusal["code"]) == (ExitCode.REFUSED, "not_allowed")
    assert "user 54321 is neither the owner nor in the group" in refusal["text"]


async def test_requests_name_the_user_and_the_client_cannot_choose_it(tmp_path: Path) -> None:
    seen: list[object] = []

    async def answer(request: Message) -> AsyncIterator[Message]:
        seen.append(request["client"])
        yield result(ExitCode.DONE)

    server = ApiServer(tmp_path / "x.sock", answer, lambda request: None)
    await server.start()
    await ask(tmp_path / "x.sock", {"verb": "status", "client": "terminal 7 of somebody"})
    await server.close()
    assert seen == [f"terminal 1 of {pwd.getpwuid(os.geteuid()).pw_name}"]


@pytest.mark.parametrize("how", ["link", "all can write", "somebody else"])
async def test_folder_for_temporary_files_has_to_be_the_users_own(
    tmp_path: Path, how: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its name is known, so that somebody else may have made it, with a socket in it."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    for variable in ("XDG_RUNTIME_DIR", "RUNTIME_DIRECTORY"):
        monkeypatch.delenv(variable, raising=False)
    good = ApiServer(default_socket("x"), answer)
    await good.start()
    assert (await asyncio.to_thread(lambda: list(call(socket_candidates("x"), {"verb": "status"}))))[-1]["text"]
    folder = default_socket("x").parent
    match how:
        case "link":
            folder.rename(tmp_path / "theirs")
            folder.symlink_to(tmp_path / "theirs")
        case "all can write":
            folder.chmod(0o777)
        case "somebody else":
            if os.geteuid():
                pytest.skip("only root can give a folder away")
            os.chown(folder, 54321, -1)
    with pytest.raises(ApiError, match=r"upright-\d+ was made by somebody else"):
        await asyncio.to_thread(lambda: list(call(socket_candidates("x"), {"verb": "status"})))
    with pytest.raises(FolderError, match=r"was made by somebody else.*--socket"):
        await ApiServer(default_socket("x"), answer).start()
    await good.close()


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
