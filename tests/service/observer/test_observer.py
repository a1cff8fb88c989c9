"""The observer process: what it records and estimates, and that control neither waits for it nor depends on it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from monocab_channels import MONOCAB
from observer_harness import VEHICLE, cycles, hello, record, until

from upright.diagnosis.live.live import LiveDiagnosis
from upright.service.observer.client import ObserverClient
from upright.service.observer.live.online_estimators import EstimatorBank, estimators_of
from upright.service.observer.pipe import MOST_WAITING
from upright.service.observer.process import Observer, link
from upright.service.offline.inputs import replay
from upright.telemetry.candump import CandumpReader
from upright.telemetry.samples import CanFrame, Frame
from upright.telemetry.storage import load
from upright.vehicles.monocab.identification.torque_balance import make as make_plain
from upright.vehicles.registry import nominal_model


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Put the compiled model into the cache: compiling it on a new computer takes longer than these tests wait."""
    estimators_of(VEHICLE).join()


@pytest.fixture
async def client(tmp_path: Path) -> AsyncIterator[ObserverClient]:
    """A started client; its observer depends only on the pipe."""
    client = ObserverClient(hello(tmp_path))
    await client.start()
    yield client
    if client.alive and client.pid is not None:
        os.kill(client.pid, signal.SIGCONT)
    await client.stop()


async def up(client: ObserverClient) -> None:
    """Wait until the observer has started and has read the messages sent so far."""
    await until(lambda: "trouble" in client.statistics())


async def test_recording_live_results_and_replay_agree(client: ObserverClient) -> None:
    frames = cycles()
    client.offer(Frame(frames[0].timestamp_ns - 4_000_000, frames[0].values))  # before the start: not recorded
    await up(client)
    summary = await record(client, frames)
    assert (summary["failure"], summary["rows"]) == ("", len(frames))

    recording = load(Path(summary["recording"]))
    assert list(recording.frames(MONOCAB)) == frames
    assert recording.truncated == ""
    assert recording.metadata["end_reason"] == "done"
    assert recording.metadata["dropped_frames"] == "0"
    results = replay.replay(recording, VEHICLE)
    assert results == summary["estimates"] == client.estimates
    assert results["recursive_least_squares"]["samples"] > 100
    assert results["recursive_prediction_error"]["samples"] > 100
    assert results["recursive_output_error"]["samples"] > 100
    beside = json.loads(Path(summary["recording"].replace(".arrow", ".estimates.json")).read_text())
    assert beside["methods"] == results
    assert beside["diagnosis"] == summary["diagnosis"] == client.diagnosis
    assert beside["diagnosis"]["verdict"] in ("adequate", "missing_effect", "insufficient_data")


async def test_estimator_that_is_compiled_late_still_gets_every_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on the first start on a computer: a recording begins, and ends, before the model is compiled."""
    compiled = threading.Event()

    def slow_estimators(*given: Any) -> EstimatorBank:
        def make() -> LiveDiagnosis:
            compiled.wait(20.0)
            return LiveDiagnosis(
                nominal_model("monocab"), parameters=given[1], deviations=given[2], support=given[3], channels=MONOCAB
            )

        return EstimatorBank([make_plain(given[1], given[3], channels=given[4])], {"recursive_prediction_error": make})

    monkeypatch.setattr("upright.service.observer.process.online_estimators", slow_estimators)
    own, other = link.pair()
    loop = asyncio.get_running_loop()
    running = asyncio.create_task(Observer(other, hello(tmp_path)).run())
    frames, codec = cycles(), link.FrameCodec(len(MONOCAB))
    stem = str(tmp_path / "first")
    start = {"type": "start_recording", "stem": stem, "start_ns": 0, "metadata": {}, "raw_log": False}
    await loop.sock_sendall(own, link.pack_json(start))
    for place in range(0, len(frames), 20):
        await loop.sock_sendall(own, codec.pack(frames[place : place + 20]))

    async def next_message(what: str) -> dict[str, Any]:
        while True:
            message = link.unpack_json(await asyncio.wait_for(loop.sock_recv(own, link.LARGEST), 20.0))
            if message["type"] == what:
                return message

    meanwhile = (await next_message("estimates"))["estimates"]
    assert meanwhile["recursive_prediction_error"]["status"] == "starting"
    assert "compiled" in meanwhile["recursive_prediction_error"]["reason"]
    assert meanwhile["recursive_least_squares"]["samples"] > 10
    end = {"end_ns": frames[-2].timestamp_ns, "raw_end_ns": 0, "reason": "done", "dropped_frames": 0}
    await loop.sock_sendall(own, link.pack_json({"type": "stop_recording", **end}))
    await asyncio.sleep(0.3)
    compiled.set()
    finished = await next_message("finished")
    assert finished["rows"] == len(frames)
    live = finished["estimates"]["recursive_prediction_error"]
    assert live == replay.replay(load(Path(finished["recording"])), VEHICLE)["recursive_prediction_error"]
    assert live["samples"] > 100
    own.close()
    await running
    other.close()


async def test_estimates_arrive_during_a_recording_and_restart_with_the_next(client: ObserverClient) -> None:
    frames = cycles()
    client.start_recording("first", frames[0].timestamp_ns, {})
    for frame in frames:
        client.offer(frame)
    await until(lambda: client.estimates.get("recursive_least_squares", {}).get("samples"))
    second = await record(client, frames[:100])
    assert second["estimates"]["recursive_least_squares"]["status"] == "too_few_samples"
    first = [path for path in Path(second["recording"]).parent.glob("*first.arrow") if len(load(path)) == len(frames)]
    assert load(first[0]).metadata["end_reason"] == "another recording began"


async def test_cycles_before_the_start_or_after_a_clock_setback_are_left_out(client: ObserverClient) -> None:
    frames = cycles()[:500]
    client.start_recording("hold", frames[50].timestamp_ns, {})
    for frame in (*frames[:200], *frames[150:300]):
        client.offer(frame)
    client.stop_recording("done", frames[299].timestamp_ns)
    summary = await client.finished_recording()
    assert list(load(Path(summary["recording"])).frames()) == frames[50:300]


async def test_raw_frames_from_the_pipe_are_logged(client: ObserverClient) -> None:
    start = 1_000_000_000_000
    kinds: list[dict[str, Any]] = [{}, {"extended": True}, {"error": True}, {"bus": 1}]
    frames = [CanFrame(start + 100_000 * i, 0x18A, bytes([i % 256] * (i % 9)), **kinds[i % 4]) for i in range(3000)]
    frames[20] = CanFrame(frames[20].timestamp_ns, 0x18A, bytes(4), remote=True)
    client.offer_can(frames[0])  # no recording yet
    client.start_recording("hold", frames[10].timestamp_ns, {})
    for frame in frames[:1500]:
        client.offer_can(frame)
    client.stop_recording("done", frames[2000].timestamp_ns - 2_000_000)  # plus half a cycle: the setpoints' frames
    for frame in frames[1500:]:
        client.offer_can(frame)
    summary = await client.finished_recording()
    log = CandumpReader(Path(summary["raw_log"]))
    logged = list(log)
    assert log.buses == {"can0": 0, "can1": 1}
    assert logged == frames[10:2001]


async def test_killed_observer_leaves_its_recording_and_a_new_one_takes_over(
    client: ObserverClient, tmp_path: Path
) -> None:
    exits: list[int] = []
    client.on_exit = exits.append
    frames = cycles()
    client.start_recording("sweep", frames[0].timestamp_ns, {})
    for frame in frames[:1000]:
        client.offer(frame)
    await until(lambda: any(path.stat().st_size > 1000 * 8 * 15 for path in tmp_path.glob("*.arrow")))
    assert client.pid is not None
    os.kill(client.pid, signal.SIGKILL)
    await until(lambda: exits)
    assert exits == [-signal.SIGKILL]
    assert not client.alive
    client.offer(frames[1000])  # there is no receiver; it must not raise
    client.stop_recording("done", frames[1000].timestamp_ns)
    summary = await client.finished_recording()
    assert summary["failure"] == "the observer process ended"
    kept = load(Path(summary["recording"]))
    assert list(kept.frames()) == frames[: len(kept)]
    assert len(kept) > 500
    assert "not closed" in kept.truncated or "cut off" in kept.truncated

    await client.restart()
    again = await record(client, frames[:500], "again")
    assert (again["failure"], again["rows"]) == ("", 500)
    assert client.statistics()["exits"] == 1


async def test_stalled_observer_never_blocks_and_dropped_frames_are_counted(client: ObserverClient) -> None:
    await up(client)
    assert client.pid is not None
    os.kill(client.pid, signal.SIGSTOP)
    client.start_recording("sweep", 0, {})
    values = (0.0,) * len(MONOCAB)
    total = 100_000  # 400 s: more than twice what pipe and queue hold. A single blocking wait would hang this test.
    for i in range(total):
        client.offer(Frame(1 + 4_000_000 * i, values))
    client.stop_recording("done", 4_000_000 * total)
    counts = client.statistics()
    assert counts["frames"] + counts["frames_dropped"] == total
    assert counts["frames_dropped"] > total / 2
    os.kill(client.pid, signal.SIGCONT)
    summary = await client.finished_recording()
    assert summary["failure"] == ""
    recording = load(Path(summary["recording"]))
    assert len(recording) == counts["frames"]
    assert recording.metadata["dropped_frames"] == str(counts["frames_dropped"])


async def test_no_cycle_is_lost_if_the_observer_stalls_for_half_a_minute(client: ObserverClient) -> None:
    await up(client)
    assert client.pid is not None
    os.kill(client.pid, signal.SIGSTOP)
    client.start_recording("sweep", 0, {})
    values = (0.0,) * len(MONOCAB)
    total = 30 * 250
    for i in range(total):
        client.offer(Frame(1 + 4_000_000 * i, values))
    client.event("info", "test", "in the middle")
    client.stop_recording("done", 4_000_000 * total)
    os.kill(client.pid, signal.SIGCONT)
    assert (await client.finished_recording())["rows"] == total
    assert client.statistics()["frames_dropped"] == 0


async def test_messages_for_a_stalled_observer_are_queued_up_to_a_bound(client: ObserverClient) -> None:
    await up(client)
    assert client.pid is not None
    os.kill(client.pid, signal.SIGSTOP)
    text = "x" * 1000
    for i in range(20_000):
        client.event("info", "test", f"number {i}, {text}")
    dropped = client.statistics()["messages_dropped"]
    assert 0 < dropped < 20_000 - MOST_WAITING / 1200
    # The order to record arrives while there is no room for a message, and is not lost.
    summary_of_later = asyncio.create_task(record(client, cycles()[:500]))
    await asyncio.sleep(0.1)
    os.kill(client.pid, signal.SIGCONT)
    assert (await summary_of_later)["failure"] == ""


async def test_lossless_client_waits_for_a_stalled_observer(tmp_path: Path) -> None:
    client = ObserverClient(hello(tmp_path), lossless=True)
    await client.start()
    await up(client)
    pid = client.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    wake = threading.Timer(0.3, os.kill, (pid, signal.SIGCONT))
    wake.start()
    values = (0.0,) * len(MONOCAB)
    client.start_recording("sweep", 0, {})
    for i in range(10_000):
        client.offer(Frame(1 + 4_000_000 * i, values))
    client.stop_recording("done", 4_000_000 * 9_999 + 1)
    assert (await client.finished_recording())["rows"] == 10_000
    assert client.statistics()["frames_dropped"] == 0
    wake.join()
    await client.stop()


async def test_observer_ignores_signals_and_finishes_its_recording_on_stop(client: ObserverClient) -> None:
    frames = cycles()[:500]
    await up(client)
    assert client.pid is not None
    client.start_recording("hold", frames[0].timestamp_ns, {})
    for frame in frames:
        client.offer(frame)
    os.kill(client.pid, signal.SIGTERM)  # stopping a service signals all its processes
    os.kill(client.pid, signal.SIGINT)
    await client.stop()
    summary = await client.finished_recording()
    recording = load(Path(summary["recording"]))
    assert list(recording.frames()) == frames
    assert recording.truncated == ""
    assert recording.metadata["end_reason"] == "the control process ended"


async def test_unwritable_folder_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    client = ObserverClient(hello(tmp_path / "file"))
    await client.start()
    summary = await record(client, cycles()[:500])
    assert "file" in summary["failure"]
    await until(lambda: "nothing is recorded" in client.statistics().get("trouble", ""))
    await client.stop()


async def test_finished_recording_is_empty_if_nothing_was_recorded(tmp_path: Path) -> None:
    assert await ObserverClient(hello(tmp_path)).finished_recording() == {}


async def test_waiting_for_a_recording_that_is_never_stopped_times_out(client: ObserverClient) -> None:
    client.start_recording("a/b c", 0, {})
    summary = await client.finished_recording(timeout=0.1)
    assert "not finished" in summary["failure"]
    assert summary["recording"].endswith("_a_b_c.arrow")


MASTER = """
import asyncio, os, sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from observer_harness import cycles, hello
from upright.service.observer.client import ObserverClient

async def main():
    client = ObserverClient(hello(Path({data!r})))
    await client.start()
    frames = cycles()[:1000]
    client.start_recording("hold", frames[0].timestamp_ns, {{"kind": "monocab"}})
    for frame in frames:
        client.offer(frame)
    client.progress("flush", 0.0, 1.0)
    print(client.pid, flush=True)
    await asyncio.sleep(60)

asyncio.run(main())
"""


def test_when_control_is_killed_the_recording_is_completed_and_the_observer_ends(tmp_path: Path) -> None:
    script = MASTER.format(tests=str(Path(__file__).parents[2] / "support"), data=str(tmp_path))
    master = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert master.stdout is not None
    observer = int(master.stdout.readline())
    master.kill()
    master.wait()
    master.stdout.close()
    limit = time.monotonic() + 20.0
    while Path(f"/proc/{observer}").exists():
        assert time.monotonic() < limit, "the observer is still there"
        time.sleep(0.02)
    (path,) = tmp_path.glob("*.arrow")
    recording = load(path)
    assert (len(recording), recording.truncated) == (1000, "")
    assert recording.metadata["end_reason"] == "the control process ended"


def test_packets_are_lossless_and_too_large_messages_are_refused() -> None:
    random = np.random.default_rng(3)
    frames = [Frame(int(t), tuple(random.standard_normal(14).tolist())) for t in random.integers(0, 1 << 62, 50)]
    codec = link.FrameCodec(14)
    assert codec.unpack(codec.pack(frames)) == frames
    message: dict[str, Any] = {"type": "event", "text": "grüße\n"}
    assert link.unpack_json(link.pack_json(message)) == message
    with pytest.raises(ValueError, match="bytes"):
        link.pack_json({"text": "x" * link.LARGEST})


async def test_all_that_an_end_had_sent_arrives_though_it_went_without_reading() -> None:
    control, observer = link.pair()
    with observer:
        observer.send(b"never read")
        for packet in (b"1", b"2", b"3"):
            control.send(packet)
        control.close()
        received = [await link.receive_soon(observer), link.receive(observer), await link.receive_soon(observer)]
        assert (received, link.receive(observer)) == ([b"1", b"2", b"3"], b"")
    control, observer = link.pair()
    with control:
        control.send(b"never read")
        observer.send(b"finished")
        observer.close()
        assert (link.receive(control), link.receive(control)) == (b"finished", b"")
