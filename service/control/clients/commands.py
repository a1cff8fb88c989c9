"""The command layer: answers all requests to a running daemon, from the terminal, the page or MQTT.

A request is `{"verb", "client", arguments}`; the transport (`service.control.clients.api`, `service.mqtt.client`)
guarantees `client`. An experiment needs a lease (`service.control.clients.lease`), which its client renews. If the
client releases it, disconnects or does not renew it, the experiment ends in order. Every client may stop it.

    experiment {name}   start one, and take its lease
    renew, release      for the holder of the lease
    stop {now}, reset   for everybody
    status              for everybody
    design {source, sha256, values, deviations}, or {back}
                        design the controllers for other parameters, or for those before; on the control socket only
    commissioning, commissioning {entry}
                        the steps and what became of them; add an entry, on the control socket only
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from upright.service.control.adopted import VEHICLE_FILE, Adopted, History
from upright.service.control.clients.api import GONE, ExitCode, Message, result
from upright.service.control.clients.lease import LOOK, Lease
from upright.service.control.commissioned import Record
from upright.service.control.cycle.loop import ControlLoop
from upright.service.control.cycle.operation import Mode
from upright.service.control.cycle.sequence import ExperimentRun
from upright.service.observer.client import ObserverClient
from upright.service.observer.live.news import News
from upright.vehicles.commissioning import Entry
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.sections import VehicleFile

ADOPTED = ("source", "sha256", "values", "deviations")
"""Keys of a design in a request."""
PROGRESS_PERIOD = 0.2
"""s between two progress messages."""


class Commands:
    """Answers for one daemon. All methods are called in the event loop's thread."""

    def __init__(
        self,
        vehicle: VehicleFile,
        loop: ControlLoop,
        observer: ObserverClient,
        status: Callable[[], dict[str, Any]],
        data: Path,
    ) -> None:
        """`data` is the folder of the recordings. Raises AdoptedError and ControlDesignError if the parameters that
        were adopted there cannot be used, RecordError if the record of the commissioning there cannot be read."""
        self.lease: Lease | None = None
        """The lease of the running or last experiment."""
        self._vehicle = vehicle
        self._loop = loop
        self._observer = observer
        self._status = status
        self._watching: asyncio.Task[None] | None = None
        self._data = data
        self.adopted = History.read(data)
        """The parameters for which the controllers are and were designed."""
        self.record = Record.read(data, vehicle)
        """What was done of the commissioning."""
        self._published: dict[str, Any] = {}
        self._told: Message = {}
        """The last answer with the status."""
        self._publish_record()
        if self.adopted.acting != VEHICLE_FILE:
            file = self.adopted.acting.of(vehicle)
            loop.adopt(file, loop.designed(file))

    async def answer(self, request: Message) -> AsyncGenerator[Message]:
        """The lines of the answer, the result last. If the answer to an experiment is not read to its end, the
        experiment ends in order."""
        match request["verb"]:
            case "status":
                status = self._status()
                if status is not self._told.get("status"):
                    self._told = result(ExitCode.DONE, status=status)
                yield self._told
            case "stop":
                yield await self._stop(str(request["client"]), now=request.get("now") is True)
            case "reset":
                refusal = self._loop.reset_fault()
                self._observer.event("info", "reset", f"{request['client']} asked for a reset")
                yield result(ExitCode.REFUSED, "reset", refusal) if refusal else result(ExitCode.DONE)
            case "design":
                yield await self._design(request)
            case "commissioning":
                yield self._commissioning(request)
            case "experiment":
                async for message in self._experiment(str(request.get("name", "")), str(request["client"])):
                    yield message
            case "renew" | "release":
                yield self.sign(request)
            case verb:
                yield result(ExitCode.USAGE, "unknown_verb", f"Unknown verb {verb!r}.")

    def sign(self, request: Message) -> Message:
        """Renew or release a lease for its holder, or end it if the holder has disconnected. Never waits."""
        lease, client = self.lease, str(request["client"])
        match request["verb"]:
            case "renew":
                done = lease is not None and lease.renew(client)
            case "release":
                done = self._release(client, f"{client} released the lease")
            case verb if verb == GONE:
                done = self._release(client, f"{client} disconnected")
            case _:
                done = False
        if done:
            return result(ExitCode.DONE)
        why = lease.ended if lease is not None and lease.holder == client else ""
        return result(ExitCode.REFUSED, "no_lease", f"{client} does not hold the lease{': ' if why else ''}{why}.")

    def _release(self, client: str, reason: str) -> bool:
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

    async def _design(self, request: Message) -> Message:
        if request.get("back") is True:
            before = self.adopted.before
            if before is None:
                text = "The controllers are designed for the vehicle file's parameters, as they always were."
                return result(ExitCode.REFUSED, "design", text)
            adopted = before
        else:
            try:
                adopted = Adopted.model_validate({key: request[key] for key in ADOPTED if key in request})
            except ValidationError as error:
                return result(ExitCode.USAGE, "bad_request", f"Not a design: {error.errors()[0]['msg']}.")
        adopted = adopted.model_copy(update={"date": datetime.now(UTC).strftime("%Y-%m-%d %H:%M:%S")})
        if self._is_running():  # asked before the work, which takes time from the control loop
            return result(ExitCode.REFUSED, "design", f"{self._loop.reason} is running; `upright stop` ends it.")
        file = adopted.of(self._vehicle)
        pilot = await asyncio.to_thread(self._loop.designed, file)
        if not self._is_running():
            following = self.adopted.with_next(adopted)
            following.write(self._data)  # first: what is not kept would not act any more after a restart
            self.adopted = following
        refusal = self._loop.adopt(file, pilot)
        if refusal:
            return result(ExitCode.REFUSED, "design", refusal)
        text = f"From the next experiment on, the controllers are designed for the parameters of {adopted.text}."
        self._observer.event("info", "design", text)
        return result(ExitCode.DONE, text=text, design=self.adopted.to_json())

    def _is_running(self) -> bool:
        return self._loop.mode is Mode.RUNNING

    def _commissioning(self, request: Message) -> Message:
        if "entry" in request:
            if self._is_running():  # the loop does not wait for a disk
                text = f"{self._loop.reason} is running: add the entry when it is over."
                return result(ExitCode.REFUSED, "commissioning", text)
            try:
                entry = Entry.model_validate(request["entry"])
            except ValidationError as error:
                return result(ExitCode.USAGE, "bad_request", f"Not an entry: {error.errors()[0]['msg']}.")
            following = self.record.with_next(entry)
            following.write(self._data)
            self.record = following
            self._publish_record()
        return result(ExitCode.DONE, **self._published)

    def _publish_record(self) -> None:
        document = self.record.to_json()
        entries = [each.model_dump(mode="json") for each in self.record.entries]
        self._published = {"commissioning": document, "entries": entries}
        if document is not None:
            self._observer.retain("commissioning", document)

    async def _stop(self, client: str, *, now: bool) -> Message:
        if self._loop.mode is not Mode.RUNNING:
            return result(ExitCode.DONE, text="No experiment was running.")
        if now:
            self._loop.stop_now(f"an operator requested an immediate stop ({client})")
        else:
            self._loop.end_experiment(f"an operator requested the end ({client})")
        if self._watching is not None:
            await asyncio.wait({self._watching})
        return result(ExitCode.DONE, text=self._loop.reason)

    async def _experiment(self, name: str, client: str) -> AsyncGenerator[Message]:
        experiment = self._vehicle.experiments.get(name)
        if experiment is None:
            there = ", ".join(self._vehicle.experiments)
            yield result(ExitCode.USAGE, "unknown_experiment", f"No experiment {name!r}; this vehicle has {there}.")
            return
        interlocks = self._loop.obstacles(name)
        if interlocks:
            yield result(ExitCode.REFUSED, "interlock", " ".join(interlocks), interlocks=interlocks)
            return
        run = self._loop.start_experiment(name, client)
        lease = self.lease = Lease(client, self._vehicle.control.lease)
        self._watching = asyncio.create_task(self._watch(run, lease), name=f"watch {name}")
        phase: Phase | None = None
        news = News()
        asked = False
        try:
            while self._loop.run is run:
                if run.phase is not phase:
                    phase = run.phase
                    yield {"type": "event", "severity": "info", "code": phase.name.lower(), "text": phase.text}
                if run.asked is not None and not asked:
                    asked = True
                    yield {"type": "event", "severity": "info", "code": "asked", "text": run.asked.announcement}
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
                self._release(client, f"{client} disconnected")
        # Another experiment may start while the files of this one are completed: keep the state of this one.
        fault = self._loop.fault if self._loop.mode is Mode.FAULT else None
        summary = await self._observer.finished_recording()
        if fault is not None:
            yield result(ExitCode.VEHICLE_FAULT, fault.code, fault.text, **summary)
        elif run.failure:
            yield result(ExitCode.FAILED, "experiment", run.failure, **summary)
        elif summary["failure"]:
            ended = run.end_reason or "The experiment is over"
            text = f"{ended}, but its recording is incomplete: {summary['failure']}."
            yield result(ExitCode.FAILED, "recording", text, **summary)
        else:
            yield result(ExitCode.DONE, text=run.end_reason, **summary)

    async def _watch(self, run: ExperimentRun, lease: Lease) -> None:
        """While `run` lasts, publish its progress, and end it if its lease is not renewed."""
        before = published = time.monotonic()
        self._observer.progress(run.name, run.fraction, run.remaining)
        while self._loop.run is run:
            await asyncio.sleep(LOOK)
            now = time.monotonic()
            if not lease.pass_time(now - before) and self._loop.run is run:
                self._loop.end_experiment(lease.ended)
            before = now
            if now - published >= PROGRESS_PERIOD:
                published = now
                self._observer.progress(run.name, run.fraction, run.remaining)
