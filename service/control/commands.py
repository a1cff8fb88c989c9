"""The one command layer: whatever a person asks of a running daemon, by terminal, page or MQTT, is answered here.

A request is `{"verb", "client", arguments}`; the transport (`service.control.api`, `service.mqtt.client`) vouches for
`client`. What moves the vehicle is held by a lease (`service.control.lease`): its client renews it, lets go of it, or
goes away, and then the experiment ends in order. Anybody may stop.

    experiment {name}   start one, and hold it
    renew, release      the holder's sign, and its farewell
    stop {now}, reset   for everybody
    status              for everybody
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable
from typing import Any

from service.control.api import GONE, ExitCode, Message, result
from service.control.lease import LOOK, Lease
from service.control.loop import ControlLoop, Mode
from service.control.sequence import ExperimentRun
from service.observer.client import ObserverClient
from service.observer.news import News
from vehicles.phases import Phase
from vehicles.sections import VehicleFile

PROGRESS_PERIOD = 0.2
"""s between two lines of progress."""


class Commands:
    """Answers for one daemon. All methods are called in the event loop's thread."""

    def __init__(
        self, vehicle: VehicleFile, loop: ControlLoop, observer: ObserverClient, status: Callable[[], dict[str, Any]]
    ) -> None:
        self.lease: Lease | None = None
        """Of the running or last experiment."""
        self._vehicle = vehicle
        self._loop = loop
        self._observer = observer
        self._status = status
        self._watching: asyncio.Task[None] | None = None

    async def answer(self, request: Message) -> AsyncGenerator[Message]:
        """The lines of the answer, the result last. Where the answer to an experiment is not read to its end, the
        experiment ends in order."""
        match request["verb"]:
            case "status":
                yield result(ExitCode.DONE, status=self._status())
            case "stop":
                yield await self._stop(now=request.get("now") is True)
            case "reset":
                refusal = self._loop.reset_fault()
                yield result(ExitCode.REFUSED, "reset", refusal) if refusal else result(ExitCode.DONE)
            case "experiment":
                async for message in self._experiment(str(request.get("name", "")), str(request["client"])):
                    yield message
            case "renew" | "release":
                yield self.sign(request)
            case verb:
                yield result(ExitCode.USAGE, "unknown_verb", f"The daemon knows no verb {verb!r}.")

    def sign(self, request: Message) -> Message:
        """A sign of life, or the farewell, of a lease's holder. Never waits."""
        lease, client = self.lease, str(request["client"])
        match request["verb"]:
            case "renew":
                done = lease is not None and lease.renew(client)
            case "release":
                done = self._let_go(client, f"{client} let go")
            case verb if verb == GONE:
                done = self._let_go(client, f"{client} went away")
            case _:
                done = False
        if done:
            return result(ExitCode.DONE)
        why = lease.ended if lease is not None and lease.holder == client else ""
        return result(ExitCode.REFUSED, "no_lease", f"{client} holds nothing{': ' if why else ''}{why}.")

    def _let_go(self, client: str, reason: str) -> bool:
        if self.lease is None or not self.lease.release(client, reason):
            return False
        if self._watching is not None and not self._watching.done():
            self._loop.end_experiment(reason)
        return True

    def held(self) -> dict[str, Any] | None:
        """The lease of the running or last experiment, for `upright status`."""
        lease = self.lease
        if lease is None:
            return None
        return {"holder": lease.holder, "ended": lease.ended, "longest_silence": lease.longest}

    async def _stop(self, *, now: bool) -> Message:
        if self._loop.mode is not Mode.RUNNING:
            return result(ExitCode.DONE, text="Nothing was running.")
        if now:
            self._loop.stop_now("an operator asked for an immediate stop")
        else:
            self._loop.end_experiment("an operator asked for the end")
        while self._loop.mode is Mode.RUNNING:
            await asyncio.sleep(0.02)
        return result(ExitCode.DONE, text=self._loop.reason)

    async def _experiment(self, name: str, client: str) -> AsyncGenerator[Message]:
        experiment = self._vehicle.experiments.get(name)
        if experiment is None:
            there = ", ".join(self._vehicle.experiments)
            yield result(ExitCode.USAGE, "unknown_experiment", f"No experiment {name!r}; this vehicle has {there}.")
            return
        interlocks = self._loop.interlocks()
        if interlocks:
            yield result(ExitCode.REFUSED, "interlock", " ".join(interlocks), interlocks=interlocks)
            return
        run = self._loop.start_experiment(name)
        lease = self.lease = Lease(client, self._vehicle.control.lease)
        self._watching = asyncio.create_task(self._watch(run, lease), name=f"watch {name}")
        phase: Phase | None = None
        news = News()
        try:
            while self._loop.run is run:
                if run.phase is not phase:
                    phase = run.phase
                    yield {"type": "event", "severity": "info", "code": phase.name.lower(), "text": phase.text}
                for text in news.of(self._observer.diagnosis):
                    yield {"type": "event", "severity": "warning", "code": "missing_effect", "text": text}
                yield {
                    "type": "progress",
                    "phase": run.phase.name.lower(),
                    "fraction": run.fraction,
                    "remaining": run.remaining,
                    "estimates": self._observer.estimates,
                    "diagnosis": self._observer.diagnosis,
                }
                await asyncio.sleep(PROGRESS_PERIOD)
        finally:
            if self._loop.run is run:
                self._let_go(client, f"{client} went away")
        # Another experiment may begin while this one's files are completed: what is said here is of this one.
        fault = (self._loop.code, self._loop.reason) if self._loop.mode is Mode.FAULT else None
        summary = await self._observer.finished_recording()
        if fault is not None:
            yield result(ExitCode.VEHICLE_FAULT, *fault, **summary)
        elif run.failure:
            yield result(ExitCode.FAILED, "experiment", run.failure, **summary)
        elif summary["failure"]:
            ended = run.end_reason or "The experiment is over"
            text = f"{ended}, but its recording is not whole: {summary['failure']}."
            yield result(ExitCode.FAILED, "recording", text, **summary)
        else:
            yield result(ExitCode.DONE, text=run.end_reason, **summary)

    async def _watch(self, run: ExperimentRun, lease: Lease) -> None:
        """While `run` lasts: how far it is, for everybody, and whether its holder is still there."""
        before = told = time.monotonic()
        self._observer.progress(run.name, run.fraction, run.remaining)
        while self._loop.run is run:
            await asyncio.sleep(LOOK)
            now = time.monotonic()
            if not lease.pass_time(now - before) and self._loop.run is run:
                self._loop.end_experiment(lease.ended)
            before = now
            if now - told >= PROGRESS_PERIOD:
                told = now
                self._observer.progress(run.name, run.fraction, run.remaining)
