"""What clients send: commands over MQTT, requests to the dashboard, lines on the control socket."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import logging
import re
import socket
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import uvicorn
from hypothesis import strategies as st
from uvicorn.server import ServerState

from fuzz.mutation import mutated
from fuzz.target import Refused, Target, Trial
from fuzz.targets.bus import OpenBench
from fuzz.targets.recordings import written
from upright.service.control.clients.commands import Commands
from upright.service.control.clients.mqtt_replies import MqttReplies
from upright.service.control.clients.server import ApiServer
from upright.service.control.cycle.operation import Mode
from upright.service.dashboard.app import Dashboard, Settings
from upright.service.dashboard.jobs import Job, Jobs
from upright.service.mqtt.command_inbox import CommandInbox
from upright.service.mqtt.topics import ARGUMENTS
from upright.service.turns import Turns
from upright.service.virtual.run import Witness
from upright.vehicles.file import load

PATIENT = 5.0
"""s of real time for a connection to end after its client has gone."""
JSON_TOKENS = (
    b"null",
    b"NaN",
    b"1e999",
    b"[",
    b"{",
    b"}",
    b"]",
    b'"',
    b"\\u0000",
    b"\\ud800",
    b"-1",
    b"true",
    b"9" * 400,
    b'{"a":' * 50,
)
Exchange = Callable[[bytes], Awaitable[None]]


def in_loop(opened: Callable[[Path], Any]) -> Callable[[Path], Any]:
    """An exchange of an event loop as a trial; what its tasks raise is raised by the trial."""

    @contextmanager
    def within(folder: Path) -> Iterator[Trial]:
        raised: list[BaseException] = []
        with asyncio.Runner() as runner:
            runner.get_loop().set_exception_handler(
                lambda loop, context: raised.append(context.get("exception") or AssertionError(context["message"]))
            )
            stack = contextlib.AsyncExitStack()
            exchange: Exchange = runner.run(stack.enter_async_context(opened(folder)))

            def trial(data: bytes) -> None:
                runner.run(exchange(data))
                if raised:
                    raise raised.pop()

            try:
                yield trial
            finally:
                runner.run(stack.aclose())

    return within


class Observer(Witness):
    """The observer process, as the command layer sees it."""

    def __init__(self) -> None:
        super().__init__()
        self.estimates: dict[str, Any] = {}
        self.diagnosis: dict[str, Any] | None = None

    def progress(self, task: str, fraction: float, remaining: float) -> None: ...

    async def finished_recording(self) -> dict[str, Any]:
        return {"recording": None, "failure": ""}


class Served:
    """A control loop and its command layer, and its time."""

    def __init__(self, folder: Path) -> None:
        self.bench = OpenBench("monocab")
        self.commands = Commands(self.bench.vehicle, self.bench.loop, Observer(), self.bench.loop.state, folder)  # type: ignore[arg-type]

    def begin(self) -> None:
        self.bench.bring_to(Mode.DISARMED)

    async def passing(self, steps: int = 5) -> None:
        """Some control cycles, and what the tasks do in between."""
        for _ in range(steps):
            self.bench.advance(self.bench.vehicle.period)
            await asyncio.sleep(0.001)

    def end(self) -> None:
        """Nothing runs any more, so that nobody waits for its end."""
        if self.bench.loop.mode is Mode.RUNNING:
            self.bench.loop.stop_now("the input is over")


async def until(over: Callable[[], object], what: str) -> None:
    for _ in range(round(PATIENT / 0.001)):
        if over():
            return
        await asyncio.sleep(0.001)
    raise AssertionError(what)


# The control socket

REQUESTS = (
    {"verb": "status"},
    {"verb": "experiment", "name": "hold"},
    {"verb": "stop"},
    {"verb": "stop", "now": True},
    {"verb": "reset"},
    {"verb": "renew"},
    {"verb": "release"},
    {"verb": "gone"},
    {
        "verb": "design",
        "source": "r.json",
        "sha256": "0",
        "values": {"inertia": 1600.0},
        "deviations": {"inertia": 10.0},
    },
    {"verb": "design", "back": True},
    {"verb": "commissioning"},
    {"verb": "commissioning", "entry": {"step": "", "state": "open"}},
    {"verb": "commissioning", "entry": {"step": "bus", "state": "skipped", "reason": "none"}},
)
VALUES: tuple[Any, ...] = (
    None,
    [],
    {},
    True,
    -1,
    0,
    1e308,
    float("nan"),
    float("inf"),
    10**400,
    "",
    "x" * 3000,
    "\0",
    "\ud800",
    {"inertia": -1},
    {"inertia": float("nan")},
    {"x": 1},
    [[[]]],
    "design",
    "hold",
    {"inertia": 1e300},
    {"inertia": 1e-300},
    {"gravity_stiffness": 0.0},
)


def one_line(requests: tuple[dict[str, Any], ...]) -> st.SearchStrategy[bytes]:
    """A request with some values exchanged, or with its bytes changed."""
    lines = [json.dumps(each).encode() for each in requests]

    def changed(request: dict[str, Any], changes: dict[str, Any]) -> bytes:
        return json.dumps({**request, **changes}).encode()

    keys = sorted({key for each in requests for key in each} | {"client", "id", "x"})
    exchanged = st.builds(
        changed, st.sampled_from(requests), st.dictionaries(st.sampled_from(keys), st.sampled_from(VALUES), max_size=2)
    )
    return st.one_of(
        exchanged,
        exchanged,
        st.sampled_from(lines),
        mutated(lines, JSON_TOKENS),
        st.integers(1, 70_000).map(lambda depth: b"[" * depth),
    )


def socket_inputs() -> st.SearchStrategy[bytes]:
    ends = st.sampled_from((b"\n", b"\n", b"\n", b"\n", b"", b"\r\n", b"\n\n", b"\0\n"))
    return st.lists(st.tuples(one_line(REQUESTS), ends).map(b"".join), min_size=1, max_size=4).map(b"".join)


@in_loop
@asynccontextmanager
async def control_socket(folder: Path) -> AsyncIterator[Exchange]:
    served = Served(folder)
    turns = Turns()
    server = ApiServer(folder / "s.sock", served.commands.answer, served.commands.sign, turns)
    await server.start()

    async def taking() -> None:
        while True:
            turns.take()
            await asyncio.sleep(0.0005)

    cycles = asyncio.create_task(taking(), name="turns")

    async def exchange(data: bytes) -> None:
        served.begin()
        reader, writer = await asyncio.open_unix_connection(str(folder / "s.sock"), limit=1 << 24)
        answer = b""
        with contextlib.suppress(ConnectionError):
            writer.write(data)
            await served.passing()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(0.02):
                    while more := await reader.read(1 << 20):
                        answer += more
        writer.close()
        served.end()
        await until(lambda: not server._connections, "the connection of a client that has gone stays open")
        if cycles.done():
            cycles.result()  # raises what ended it
        last = json.loads(answer.splitlines()[-1]) if answer.endswith(b"\n") else {}
        assert last.get("code") != "internal_error", last.get("text")
        if last.get("exit_code") != 0:
            raise Refused(str(last.get("text", "no answer")))

    try:
        yield exchange
    finally:
        cycles.cancel()
        await server.close()


# MQTT

COMMANDS = tuple(
    {"id": "1", "client": "page", "timestamp": 0.0, "arguments": arguments}
    for arguments in ({}, {"name": "hold"}, {"now": True}, {"name": "sweep"})
)
REPLY = re.compile(r"reply/[A-Za-z0-9_.@-]{1,64}/[A-Za-z0-9_-]{1,40}")


def mqtt_inputs() -> st.SearchStrategy[bytes]:
    """Verb, or user and verb, whether it was retained, and the payload."""
    verbs = st.sampled_from(
        [
            *(verb.encode() for verb in ARGUMENTS),
            b"status",
            b"design",
            b"gone",
            b"",
            b"x/y",
            b"you/stop",
            b"/stop",
            b"+/stop",
            b"#",
            b"\xff",
        ]
    )
    payload = st.one_of(one_line(COMMANDS), st.binary(max_size=200), st.just(b" " * 5000))
    return st.tuples(verbs, st.sampled_from((b"\n0", b"\n0", b"\n0", b"\n1")), payload).map(b"".join)


@in_loop
@asynccontextmanager
async def mqtt(folder: Path) -> AsyncIterator[Exchange]:
    served = Served(folder)
    told: list[tuple[str, dict[str, Any]]] = []
    number = 0

    def forward(command: dict[str, Any]) -> bool:
        replies.take(json.loads(json.dumps(command)))
        return True

    inbox = CommandInbox(forward, lambda topic, reply: told.append((topic, reply)), lambda: 0.5 * number)
    replies = MqttReplies(served.commands, inbox.reply)

    async def exchange(data: bytes) -> None:
        nonlocal number
        number += 1
        served.begin()
        topic, _, rest = data.partition(b"\n")
        now = 0.5 * number
        payload = (
            rest[1:]
            .replace(b'"timestamp": 0.0', b'"timestamp": %.1f' % now)
            .replace(b'"id": "1"', b'"id": "%d"' % number)
        )
        passed = inbox.gate.counts["passed"]
        user, there, verb = topic.decode(errors="replace").rpartition("/")
        inbox.take(user if there else "me", verb, payload, rest[:1] == b"1")
        await served.passing(2)
        served.end()
        await until(lambda: not replies._running, "a command is answered for ever")
        for topic, reply in told:
            assert REPLY.fullmatch(topic), topic
            json.dumps(reply)
        told.clear()
        if inbox.gate.counts["passed"] == passed:
            raise Refused("by the gate")

    yield exchange


# HTTP

PATHS = (
    *(
        "/",
        "/index.html",
        "/api/config",
        "/api/recordings",
        "/api/recordings/short.arrow",
        "/api/recordings/short.csv?points=20",
    ),
    *(
        "/api/recordings/short.arrow/log",
        "/api/recordings/short.arrow/recording",
        "/api/recordings/bad.arrow",
        "/api/model",
    ),
    *(
        "/api/jobs",
        "/api/jobs/1",
        "/reports/x.html",
        "/commissioning/x.html",
        "/../../etc/passwd",
        "/%2e%2e/%2e%2e/etc/passwd",
    ),
    *(
        "/api/recordings/%00",
        "/api/recordings/..%2f..%2fx.arrow",
        "//",
        "/%ff",
        "*",
        "http://localhost/",
        "/api/jobs/99999999999999999999999",
    ),
    *("/api/recordings/" + "a" * 5000, "/" + "%2e%2e%2f" * 20 + "etc/passwd"),
)
JOBS = (
    {"kind": "identify", "recordings": ["short.arrow"], "methods": []},
    {"kind": "diagnose", "recordings": ["short.arrow"]},
    {"kind": "compare", "recordings": ["short.arrow"]},
    {"kind": "add", "recordings": ["short.arrow"], "effect": "static_torque"},
    {"kind": "undo"},
    {"kind": "begin"},
    {"kind": "skip", "step": "bus", "reason": "none here"},
    {"kind": "step", "step": "bus"},
)
HEADERS = (
    *(
        "Host: localhost",
        "Host: localhost:8080",
        "Host: evil.example",
        "Host: [::1",
        "Host:",
        "X-Upright: 1",
        "Origin: http://localhost",
    ),
    *(
        "Connection: close",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
    ),
    *(
        "Transfer-Encoding: chunked",
        "Content-Length: 5",
        "Content-Length: 99999999999999",
        "Content-Length: -1",
        "Content-Length: x",
        "Expect: 100-continue",
    ),
    *(
        "Content-Type: application/json",
        "Range: bytes=0-",
        "Range: bytes=5-2",
        "Range: bytes=-1,0-0,5-",
        "Range: x",
        "Range: bytes=" + "0-1," * 300,
    ),
    *(
        "If-Modified-Since: x",
        "If-None-Match: *",
        "If-Range: x",
        "Cookie: \xff",
        "X: " + "a" * 70_000,
        "Range: bytes=" + "9" * 5000 + "-",
    ),
)
UPGRADE = (
    "Connection: Upgrade",
    "Upgrade: websocket",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
)


def http_request(method: str, path: str, headers: list[str], body: bytes) -> bytes:
    head = "\r\n".join([f"{method} {path} HTTP/1.1", *headers]) + "\r\n\r\n"
    return head.encode("latin-1") + body


def http_inputs() -> st.SearchStrategy[bytes]:
    body = one_line(JOBS)
    some = st.lists(st.sampled_from(HEADERS), max_size=5).map(lambda found: ["Host: localhost", "X-Upright: 1", *found])
    any_request = st.builds(
        http_request,
        st.sampled_from(
            ("GET", "GET", "POST", "HEAD", "DELETE", "PUT", "OPTIONS", "TRACE", "CONNECT", "get", "X" * 100)
        ),
        st.sampled_from(PATHS),
        some,
        st.one_of(st.just(b""), body),
    )
    job = body.map(
        lambda text: http_request(
            "POST", "/api/jobs", ["Host: localhost", "X-Upright: 1", f"Content-Length: {len(text)}"], text
        )
    )
    upgrade = st.sampled_from(PATHS).map(lambda path: http_request("GET", path, ["Host: localhost", *UPGRADE], b""))
    chunk = st.tuples(st.sampled_from((1, 100, 100_000)), st.integers(0, 200)).map(
        lambda each: http_request(
            "POST",
            "/api/jobs",
            ["Host: localhost", "X-Upright: 1", "Transfer-Encoding: chunked"],
            (b"%x\r\n" % each[0] + b" " * each[0] + b"\r\n") * each[1] + b"0\r\n\r\n",
        )
    )
    several = st.lists(st.one_of(any_request, job), min_size=1, max_size=3).map(b"".join)
    return st.one_of(
        any_request,
        job,
        several,
        mutated(http_examples(), [header.encode("latin-1")[:200] + b"\r\n" for header in HEADERS]),
        upgrade,
        chunk,
    )


def http_examples() -> list[bytes]:
    plain = [http_request("GET", path, ["Host: localhost"], b"") for path in PATHS]
    jobs = [json.dumps(each).encode() for each in JOBS]
    posted = [
        http_request("POST", "/api/jobs", ["Host: localhost", "X-Upright: 1", f"Content-Length: {len(text)}"], text)
        for text in jobs
    ]
    upgraded = [http_request("GET", path, ["Host: localhost", *UPGRADE], b"") for path in ("/", "/api/config")]
    return [*plain, *posted, *upgraded, http_request("DELETE", "/api/jobs/1", ["Host: localhost", "X-Upright: 1"], b"")]


class Errors(logging.Handler):
    """Keeps the exceptions that the server logs."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.raised: list[BaseException] = []

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        self.raised.append(error or AssertionError(record.getMessage()))


async def no_work(jobs: Jobs, job: Job) -> None:
    job.state = "done"


@in_loop
@asynccontextmanager
async def http(folder: Path) -> AsyncIterator[Exchange]:
    for suffix in (".arrow", ".csv"):
        (folder / f"short{suffix}").write_bytes(written(suffix))
    (folder / "bad.arrow").write_bytes(b"not a recording")
    dashboard = Dashboard(Settings(load("monocab"), folder, "ws://localhost:9001"))
    config = uvicorn.Config(dashboard.app, log_config=None, access_log=False)
    config.load()
    errors, logger = Errors(), logging.getLogger("uvicorn.error")
    logger.addHandler(errors)
    logger.propagate = False
    state = ServerState()
    loop = asyncio.get_running_loop()

    async def exchange(data: bytes) -> None:
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        theirs.setblocking(False)
        protocols: list[Any] = []

        def protocol() -> Any:
            protocols.append(config.http_protocol_class(config=config, server_state=state, app_state={}))  # type: ignore[union-attr, operator]
            return protocols[-1]

        await loop.connect_accepted_socket(protocol, theirs)
        answers = asyncio.create_task(received(loop, ours))
        with contextlib.suppress(ConnectionError):
            await loop.sock_sendall(ours, data)
        for _ in range(5):
            await asyncio.sleep(0)
        for _ in range(1000):
            cycle = getattr(protocols[0], "cycle", None)
            if not state.tasks or (cycle is not None and cycle.more_body):
                break
            await asyncio.sleep(0.001)
        with contextlib.suppress(OSError):
            ours.shutdown(socket.SHUT_WR)
        await until(
            lambda: not state.tasks and not state.connections, "a request of a client that has gone does not end"
        )
        answer = await answers  # ends with the connection
        ours.close()
        if errors.raised:
            raise errors.raised.pop()
        status = answer[9:12]
        assert not status.startswith(b"5"), answer[:200]
        if not status.startswith((b"2", b"3")):
            raise Refused(answer[:200].decode("latin-1"))

    try:
        with mock.patch.object(Jobs, "_run", no_work):
            yield exchange
    finally:
        logger.removeHandler(errors)
        gc.collect()


async def received(loop: asyncio.AbstractEventLoop, connection: socket.socket) -> bytes:
    """The beginning of the answers."""
    answer = b""
    with contextlib.suppress(OSError):
        while more := await loop.sock_recv(connection, 1 << 16):
            answer = (answer + more)[:1000]
    return answer


TARGETS = (
    Target(
        "mqtt",
        "commands over MQTT",
        mqtt,
        mqtt_inputs,
        lambda: [b"experiment\n0" + json.dumps(each).encode() for each in COMMANDS],
        keeps_state=200,
    ),
    Target("http", "requests to the dashboard", http, http_inputs, http_examples, keeps_state=200, megabytes=60),
    Target(
        "socket",
        "lines on the control socket",
        control_socket,
        socket_inputs,
        lambda: [
            *(json.dumps(each).encode() + b"\n" for each in REQUESTS),
            b"[" * 60_000 + b"\n",
            b"x" * 70_000,
            b"\n",
        ],
        keeps_state=200,
        short=100,
    ),
)
