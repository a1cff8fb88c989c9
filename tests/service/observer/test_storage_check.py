"""Recordings that cannot be written: an interlock before an experiment, an end in order during one."""

from __future__ import annotations

import errno
import os
import signal
from pathlib import Path
from types import SimpleNamespace

import pytest
from closed_loop import ClosedLoop
from observer_harness import cycles, hello, until

from upright.service.observer.client import ObserverClient
from upright.service.observer.recording import storage_check
from upright.service.observer.recording.storage_check import PROBE_FILE, obstacle


def test_folder_that_can_be_written_is_made_and_left_empty(tmp_path: Path) -> None:
    assert obstacle(tmp_path / "new" / "data") == ""
    assert list((tmp_path / "new" / "data").iterdir()) == []


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (errno.EROFS, ("Read-only file system", "--data")),
        (errno.EACCES, ("Permission denied", "make it writable")),
        (errno.ENOSPC, ("No space left", "delete old recordings")),
        (errno.EDQUOT, ("quota", "let the quota be raised")),
    ],
)
def test_refused_write_is_said_with_its_remedy(
    tmp_path: Path, number: int, words: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(descriptor: int, data: bytes) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(storage_check.os, "write", refuse)
    said = obstacle(tmp_path)
    assert all(word in said for word in (*words, str(tmp_path))), said
    assert not (tmp_path / PROBE_FILE).exists()


def test_disk_that_is_nearly_full_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage_check.os, "statvfs", lambda path: SimpleNamespace(f_bavail=2000, f_frsize=4096))
    assert "8 MB are free" in obstacle(tmp_path)


def test_it_is_an_interlock() -> None:
    closed = ClosedLoop()
    assert closed.loop.interlocks() == []
    closed.witness.obstacle = "Nothing would be recorded."
    assert closed.loop.interlocks() == ["Nothing would be recorded."]


async def test_observer_reports_it_before_and_during_a_recording(tmp_path: Path) -> None:
    data = tmp_path / "data"
    client = ObserverClient(hello(data))
    said: list[str] = []
    client.on_obstacle = said.append
    await client.start()
    try:
        await until(lambda: client.ready)
        assert client.obstacle == ""
        frames = cycles()
        client.start_recording("hold", frames[0].timestamp_ns, {"kind": "monocab"})
        client.offer(frames[0])
        await until(lambda: any(data.glob("*.log")))
        data.rename(tmp_path / "away")
        data.write_text("a file in place of the folder")
        await until(lambda: client.obstacle)
        assert said
        assert "cannot be written" in said[0]
        client.stop_recording("done", frames[0].timestamp_ns)
        data.unlink()
        await until(lambda: client.obstacle == "")
    finally:
        await client.stop()


async def test_raw_log_that_was_killed_is_an_obstacle_until_it_is_started_again(tmp_path: Path) -> None:
    client = ObserverClient({**hello(tmp_path), "raw_log_buses": ["socketcan:none0"]})
    await client.start()
    try:
        await until(lambda: client.ready)
        client.start_recording("hold", 0, {"kind": "monocab"})
        assert client._raw_log is not None
        os.kill(client._raw_log.pid, signal.SIGKILL)
        await until(lambda: client._raw_log is not None and client._raw_log.failure)
        assert client.complete is False
        assert "Raw frames would not be recorded" in client.obstacle
        client.stop_recording("done", 0)
        summary = await client.finished_recording()
        assert "raw log process ended" in summary["failure"], "the experiment does not count as recorded"
        await client.restart()
        assert client.complete
        assert client.obstacle == ""
    finally:
        await client.stop()


async def test_recording_that_cannot_be_created_is_reported_at_once(tmp_path: Path) -> None:
    client = ObserverClient(hello(tmp_path / "data"))
    said: list[str] = []
    client.on_obstacle = said.append
    await client.start()
    try:
        await until(lambda: client.ready)
        (tmp_path / "data").rmdir()
        (tmp_path / "data").write_text("a file in place of the folder")
        client.start_recording("hold", 0, {"kind": "monocab"})
        await until(lambda: said)
        assert said[0].startswith("Nothing is recorded: ")
    finally:
        await client.stop()
