"""Times of the control loop, their export, and what keeps the control process from being held up."""

from __future__ import annotations

import gc
import json
import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from observer_harness import hello
from served import free_port
from serving import steady

from upright.service.control import realtime
from upright.service.control.clients import api
from upright.service.control.cycle.timing import TIMES, Histogram, Timing
from upright.service.observer import link
from upright.service.observer.cpus import VARIABLE, leave_to_control, processors
from upright.service.observer.process import Observer
from upright.service.observer.viewers.metrics import Metrics, MetricsServer
from upright.service.virtual.run import ClosedLoop

UPRIGHT = [sys.executable, "-c", "from upright.service.cli import main; main()"]
SAMPLE = re.compile(r'^(?P<name>[a-z_]+)(?:\{(?P<labels>[a-z_]+="[^"]*"(?:,[a-z_]+="[^"]*")*)\})? (?P<value>\S+)$')
FIGURES = {
    "modes": ["starting", "running"],
    "mode": "running",
    "cycles": 4,
    "missed_cycles": 1,
    "clock_steps": 0,
    "observer_dropped": 2,
    "buses": [
        {"address": "can0", "received": 7, "sent": 5, "receive_dropped": 0, "transmit_dropped": 0, "error_frames": 3}
    ],
}


def samples(text: str) -> dict[str, float]:
    """The samples of a text in Prometheus' format by name and labels; every line has to be a sample or a comment."""
    found = {}
    for line in text.splitlines():
        if not line.startswith(("# HELP ", "# TYPE ")):
            match = SAMPLE.match(line)
            assert match, line
            key = match["name"] + (f"{{{match['labels']}}}" if match["labels"] else "")
            assert key not in found, key
            found[key] = float(match["value"])
    return found


@given(st.lists(st.floats(0.0, 2.0) | st.sampled_from(TIMES)))
def test_histogram_counts_each_value_once_in_the_smallest_bucket_that_holds_it(values: list[float]) -> None:
    histogram = Histogram(TIMES)
    for value in values:
        histogram.add(value)
    for bound, count in zip(TIMES, histogram.counts, strict=False):
        smaller = [other for other in TIMES if other < bound]
        assert count == sum(value <= bound and all(value > other for other in smaller) for value in values)
    assert sum(histogram.counts) == len(values)
    assert histogram.largest == max(values, default=0.0)
    assert histogram.total == pytest.approx(sum(values))


def test_loop_counts_the_intervals_of_its_frame_sets() -> None:
    closed = ClosedLoop(steady())
    for _ in range(100):
        closed.advance(closed.vehicle.period)
    timing = closed.loop.timing.interval
    assert sum(timing.counts) == closed.loop.cycles - 1 > 50
    assert timing.total / sum(timing.counts) == pytest.approx(closed.vehicle.period, rel=0.02)


def test_metrics_are_cumulative_histograms_in_the_text_format() -> None:
    timing = Timing(0.004)
    for value in (0.004, 0.004, 0.0061, 1.0):
        timing.interval.add(value)
    seconds = iter([10.0, 12.5])
    metrics = Metrics("monocab", "1.2.3", lambda: next(seconds))
    assert samples(metrics.text()) == {'upright_info{vehicle="monocab",version="1.2.3"}': 1.0}
    metrics.report({**FIGURES, "timing": json.loads(json.dumps(timing.to_json()))})
    text = metrics.text()
    found = samples(text)
    buckets = [(key, value) for key, value in found.items() if key.startswith("upright_cycle_interval_seconds_bucket")]
    assert [value for _, value in buckets] == sorted(value for _, value in buckets)
    assert found['upright_cycle_interval_seconds_bucket{le="0.00404"}'] == 2.0
    assert found['upright_cycle_interval_seconds_bucket{le="0.008"}'] == 3.0
    assert found['upright_cycle_interval_seconds_bucket{le="+Inf"}'] == 4.0
    assert found["upright_cycle_interval_seconds_count"] == 4.0
    assert found["upright_cycle_interval_seconds_sum"] == pytest.approx(1.0141)
    assert found["upright_cycle_interval_largest_seconds"] == 1.0
    assert found["upright_report_age_seconds"] == 2.5
    assert found['upright_mode{mode="running"}'] == 1.0
    assert found['upright_mode{mode="starting"}'] == 0.0
    assert found['upright_bus_error_frames_total{bus="can0"}'] == 3.0
    typed = re.findall(r"^# TYPE (\S+) ", text, re.M)
    assert len(typed) == len(set(typed))


def test_label_with_a_quote_and_a_line_break_stays_one_label() -> None:
    assert Metrics('a"b\\c\nd', "1").text().splitlines()[-1] == 'upright_info{vehicle="a\\"b\\\\c\\nd",version="1"} 1'


@pytest.fixture
def served_text() -> Iterator[str]:
    port = free_port()
    server = MetricsServer(port, lambda: "a 1\n")
    yield f"http://127.0.0.1:{port}"
    server.shutdown()
    server.server_close()


def test_metrics_are_served_to_this_computer_by_its_own_name_alone(served_text: str) -> None:
    with urllib.request.urlopen(f"{served_text}/metrics") as answer:
        assert answer.read() == b"a 1\n"
        assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
    for path, host, status in (("/", "localhost", 404), ("/metrics", "elsewhere.example", 403)):
        request = urllib.request.Request(f"{served_text}{path}", headers={"Host": host})
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(request)
        assert refused.value.code == status
        refused.value.close()


def test_client_that_hangs_up_or_sends_garbage_does_not_end_the_metrics(served_text: str) -> None:
    port = int(served_text.rpartition(":")[2])
    for garbage in (b"", b"\0\xff\r\n\r\n", b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n" + b"x" * 70_000):
        with socket.create_connection(("127.0.0.1", port)) as client:
            client.sendall(garbage)
    with urllib.request.urlopen(f"{served_text}/metrics") as answer:
        assert answer.status == 200


def test_daemon_exports_its_times_by_its_observer(tmp_path: Path) -> None:
    port, path = free_port(), tmp_path / "s.sock"
    command = [*UPRIGHT, "serve", "monocab", "--virtual", "--data", str(tmp_path), "--socket", str(path)]
    daemon = subprocess.Popen(command, env={**os.environ, "UPRIGHT_METRICS": str(port)}, stderr=subprocess.DEVNULL)
    try:
        found: dict[str, float] = {}
        limit = time.monotonic() + 80.0
        while found.get("upright_cycle_processing_seconds_count", 0.0) < 10.0:
            assert time.monotonic() < limit, found
            time.sleep(0.1)
            with suppress(OSError), urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics") as answer:
                found = samples(answer.read().decode())
        status = list(api.call([path], {"verb": "status"}))[-1]["status"]
    finally:
        daemon.send_signal(signal.SIGTERM)
        daemon.wait(30)
    assert found["upright_report_age_seconds"] < 30.0
    assert 0.0 < found["upright_cycle_processing_seconds_sum"] / found["upright_cycle_processing_seconds_count"] < 1.0
    assert found["upright_cycle_turnaround_seconds_count"] == 0.0, "simulated time is not that of this computer"
    assert sum(status["timing"]["interval"]["counts"]) >= found["upright_cycle_interval_seconds_count"]


async def test_taken_port_is_reported_and_the_observer_goes_on(tmp_path: Path) -> None:
    own, other = link.pair()
    with own, other, socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        observer = Observer(other, {**hello(tmp_path), "metrics_port": port})
        assert f"no metrics at port {port}" in observer._trouble
        assert "--metrics PORT" in observer._trouble


# What keeps the control process from being held up


def test_garbage_is_collected_at_rest_and_during_a_run_only_when_there_is_much(monkeypatch: pytest.MonkeyPatch) -> None:
    collections: list[int] = []
    young = [0]
    monkeypatch.setattr(gc, "isenabled", lambda: False)
    monkeypatch.setattr(gc, "collect", lambda: collections.append(1))
    monkeypatch.setattr(gc, "get_count", lambda: (young[0], 0, 0))
    realtime.collect(running=True)
    assert not collections
    realtime.collect(running=False)
    assert len(collections) == 1
    young[0] = realtime.MOST_YOUNG + 1
    realtime.collect(running=True)
    assert len(collections) == 2


def test_cycles_of_a_run_leave_no_garbage_for_the_collector() -> None:
    closed = ClosedLoop(steady())
    closed.until(lambda: not closed.loop.interlocks(), 5.0)
    closed.loop.start_experiment("hold")
    closed.advance(0.5)
    before, enabled = closed.loop.cycles, gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        closed.advance(1.2)
        assert gc.collect() == 0
    finally:
        if enabled:
            gc.enable()
    assert closed.loop.cycles - before > 250


SETTLED = """
import gc, resource, sys
from upright.service.control import realtime
class Node: pass
def cycle():
    node = Node(); node.itself = node
kept = [Node() for _ in range(1000)]
text = realtime.settle(lock={lock})
for _ in range(5000): cycle()
left = sum(isinstance(each, Node) for each in gc.get_objects())
realtime.collect(running=True)
realtime.collect(running=False)
print(gc.isenabled(), gc.get_freeze_count() > 1000, left, sum(isinstance(each, Node) for each in gc.get_objects()))
print(sys.getswitchinterval(), text)
"""


def _settled(*, lock: bool, limit: int = resource.RLIM_INFINITY) -> list[str]:
    code = SETTLED.format(lock=lock)

    def limited() -> None:
        if limit != resource.RLIM_INFINITY:
            resource.setrlimit(resource.RLIMIT_MEMLOCK, (limit, limit))

    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, preexec_fn=limited)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_settled_process_leaves_garbage_until_it_is_asked_and_then_collects_all_of_it() -> None:
    first, second = _settled(lock=False)
    assert first == "False True 5000 0"
    assert second == f"{realtime.SWITCH_INTERVAL} "


def test_refused_memory_lock_is_a_sentence_with_the_remedy_and_no_failure() -> None:
    _, second = _settled(lock=True, limit=1_000_000)
    assert "not locked, as no more than 1 MB may be" in second
    assert "LimitMEMLOCK=infinity" in second


def test_list_of_processors() -> None:
    assert processors("0-2,4") == {0, 1, 2, 4}
    with pytest.raises(ValueError):
        processors("0-x")


def test_helper_moves_to_the_processors_it_is_given_and_stays_if_they_cannot_be_had(
    capfd: pytest.CaptureFixture[str],
) -> None:
    before = os.sched_getaffinity(0)
    try:
        leave_to_control({})
        assert os.sched_getaffinity(0) == before
        for wrong in ("nonsense", "4000"):
            leave_to_control({VARIABLE: wrong})
            assert os.sched_getaffinity(0) == before
            assert f"{VARIABLE}={wrong}" in capfd.readouterr().err
        leave_to_control({VARIABLE: str(min(before))})
        assert os.sched_getaffinity(0) == {min(before)}
    finally:
        os.sched_setaffinity(0, before)
