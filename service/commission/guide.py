"""Carries out the steps of a commissioning, one at a time, and keeps the record at the daemon.

The daemon moves the vehicle, under the lease of this client, and owns the record; a step's evaluation runs here, in
processes of their own. So a commissioning may be continued by another client, after a restart or a day.
"""

from __future__ import annotations

import getpass
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from upright.service.command_line import UPRIGHT
from upright.service.commission.evaluations.table import evaluation
from upright.service.commission.evidence import Evidence, Found, Request
from upright.service.commission.report import write_commissioning
from upright.service.control.clients import api
from upright.service.whole_file import write_whole
from upright.telemetry.errors import UprightError
from upright.vehicles.commissioning import CommissioningError, Entry, State, Step, Steps, is_within, latest, steps_for
from upright.vehicles.sections import VehicleFile

FOLDER = "commissioning"
"""Of the files of a commissioning, in the data folder."""
REPORT = "report.html"
"""There, that of the newest commissioning."""
READY = 20.0
"""s to wait for the interlocks before an experiment; then the daemon refuses it with them as the reason."""
ANSWERED = 30.0
"""s that the daemon may take for anything but an experiment."""

Follow = Callable[[Iterator[dict[str, Any]]], dict[str, Any]]
"""Shows the messages of an experiment and returns its result."""


class StepError(UprightError):
    """A step could not be carried out."""


@dataclass(frozen=True, slots=True)
class Guide:
    """The commissioning of `vehicle`, whose daemon listens at one of `sockets`. `follow` shows an experiment while it
    runs."""

    vehicle: VehicleFile
    sockets: Sequence[Path]
    follow: Follow

    @property
    def steps(self) -> Steps:
        """Raises CommissioningError if this kind of vehicle has none."""
        return steps_for(self.vehicle)

    def ask(self, request: Request) -> dict[str, Any]:
        """The daemon's result. Raises ApiError if there is no daemon, StepError if it refuses."""
        answer = list(api.call(list(self.sockets), request, timeout=ANSWERED))[-1]
        if answer["exit_code"]:
            raise StepError(answer["text"])
        return answer

    def record(self) -> list[Entry]:
        """The entries so far."""
        return [Entry.model_validate(each) for each in self.ask({"verb": "commissioning"})["entries"]]

    def report(self) -> str:
        """The report of what was done so far, as a page."""
        return write_commissioning(self.vehicle, self.steps, self.record())

    def save_report(self) -> Path:
        """Write the report where the files of this commissioning are."""
        path = self._folder() / REPORT
        write_whole(path, self.report())
        return path

    def begin(self) -> None:
        """Begin a new commissioning; the record of the one before, its files and its report are kept."""
        report = self._folder() / REPORT
        if report.is_file():
            report.replace(report.with_name(f"{len(self.record()):02d}_{REPORT}"))
        self._keep(Entry())

    def skip(self, name: str, reason: str) -> Entry:
        """Skip a step. Raises CommissioningError without a reason."""
        self.steps.find(name)
        try:
            entry = Entry(step=name, state=State.SKIPPED, reason=reason)
        except ValidationError as error:
            raise CommissioningError(
                f"{name} cannot be skipped without a reason.",
                remedy="Say why it is safe to go on without it; the report says so, too.",
            ) from error
        return self._keep(entry)

    def carry_out(self, name: str, recording: Path | None = None) -> Entry:
        """Run the step's experiment, unless its `recording` is given, and evaluate it.

        Raises CommissioningError if steps are lacking that it needs. Anything that fails afterwards is in the entry.
        """
        record = self.record()
        step = self.steps.find(name)
        lacking = self.steps.lacking(step, record)
        if lacking:
            raise CommissioningError(
                f"{name} needs {', '.join(lacking)} first.", remedy="Carry out these steps, or skip them with a reason."
            )
        ran: Path | None = recording
        try:
            if step.experiment and recording is None:
                ran = self._run(step)
            found = evaluation(step.evaluate, self.vehicle.vehicle.kind)(self._evidence(step, record, ran))
        except UprightError as error:
            return self._keep(Entry(step=name, state=State.FAILED, reason=str(error), recording=str(ran or "")))
        return self._keep(self._judged(step, found, ran))

    def _run(self, step: Step) -> Path:
        if step.experiment not in self.vehicle.experiments:
            raise StepError(
                f"{self.vehicle.vehicle.id} has no experiment {step.experiment}.",
                remedy="Copy it from the shipped vehicle of this kind: `upright config show`.",
            )
        self._until_ready()
        request = {"verb": "experiment", "name": step.experiment}
        answer = self.follow(api.call(list(self.sockets), request, timeout=None))
        if answer["exit_code"]:
            raise StepError(answer["text"])
        if answer.get("text"):
            raise StepError(f"{step.experiment} ended early: {answer['text']}")
        return Path(answer["recording"])

    def _until_ready(self) -> None:
        """Wait a while for what passes by itself: drives that are set up again, a filter that settles."""
        limit = time.monotonic() + READY
        while self.ask({"verb": "status"})["status"]["interlocks"] and time.monotonic() < limit:
            time.sleep(0.2)

    def _evidence(self, step: Step, record: Sequence[Entry], ran: Path | None) -> Evidence:
        newest = latest(record)
        before = [newest[name] for name in step.of if name in newest]
        recordings = [Path(each.recording) for each in before if each.recording]
        results = {each.step: Path(each.result) for each in before if each.result}
        models = [Path(each.model) for each in before if each.model]
        return Evidence(
            self.vehicle,
            step,
            [*([ran] if ran is not None else []), *recordings],
            results,
            self._folder(),
            self.ask,
            self._upright,
            model=models[-1] if models else None,
            number=len(record),
        )

    def _folder(self) -> Path:
        folder = Path(self.ask({"verb": "status"})["status"]["data"]).absolute() / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        return folder

    def _upright(self, words: Sequence[str]) -> dict[str, Any]:
        """The JSON document of a command line, in a process of its own. Its progress is shown on stderr."""
        vehicle = ["--vehicle", self.vehicle.path or self.vehicle.vehicle.id]
        socket = [word for path in self.sockets[:1] for word in ("--socket", str(path))] if words[0] == "design" else []
        done = subprocess.run(
            [*UPRIGHT, *words, *vehicle, *socket, "--json"],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=None if sys.stderr.isatty() else subprocess.PIPE,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
            check=False,
        )
        try:
            found: dict[str, Any] = json.loads(done.stdout)
        except ValueError:
            said = (done.stderr or b"").decode(errors="replace").strip().splitlines()
            what = said[-1] if said else f"ended with exit status {done.returncode}"
            raise StepError(f"`upright {words[0]}`: {what.removeprefix('upright: ')}") from None
        return found

    def _judged(self, step: Step, found: Found, ran: Path | None) -> Entry:
        met = all(is_within(each, found.numbers) for each in step.acceptance)
        return Entry(
            step=step.id,
            state=State.ACCEPTED if met else State.NOT_ACCEPTED,
            numbers=dict(found.numbers),
            text=list(found.text),
            recording=str(ran or ""),
            result=str(found.result or ""),
            model=str(found.model or ""),
            files=_hashes([*found.files, *([ran, ran.with_suffix(".log")] if ran is not None else [])]),
        )

    def _keep(self, entry: Entry) -> Entry:
        update = {
            "by": _user(),
            "vehicle_file": self.vehicle.configuration_hash,
            "version": version("upright"),
        }
        whole = entry.model_copy(update=update)
        self.ask({"verb": "commissioning", "entry": whole.model_dump(mode="json")})
        self.save_report()
        return whole


def _hashes(paths: Sequence[Path]) -> dict[str, str]:
    """SHA-256 by path, of those that exist."""
    return {str(path): sha256(path.read_bytes()).hexdigest() for path in paths if path.is_file()}


def _user() -> str:
    """Who runs this program; in a container a user may have a number only."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())
