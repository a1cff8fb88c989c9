"""Long-running jobs: comparisons, fits and diagnoses, each a run of the command line in a process of its own.

They run one at a time, at a low priority, and only a few may wait: the same machine may balance the vehicle.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Literal

from upright.service.command_line import UPRIGHT
from upright.telemetry.documents import from_json
from upright.telemetry.errors import UprightError

MOST_WAITING = 4
MOST_KEPT = 20
NICENESS = 10
LARGEST = 32 << 20
"""Maximum size of an answer, bytes."""

State = Literal["waiting", "running", "done", "failed", "cancelled"]


class TooManyJobs(UprightError):
    """The maximum number of jobs is waiting."""


@dataclass(slots=True)
class Job:
    """One run; `result` is the JSON document that it printed, of several the last; `error` its message if it failed."""

    id: int
    kind: str
    words: Sequence[str]
    state: State = "waiting"
    began: float = 0.0
    seconds: float = 0.0
    result: Any = None
    error: str = ""
    task: asyncio.Task[None] | None = field(default=None, repr=False)

    def to_json(self) -> dict[str, Any]:
        running = time.monotonic() - self.began if self.state == "running" else self.seconds
        return {
            "id": self.id,
            "kind": self.kind,
            "state": self.state,
            "seconds": round(running, 1),
            "result": self.result,
            "error": self.error,
        }


class Jobs:
    """Runs jobs one after the other, in a running event loop."""

    def __init__(self) -> None:
        self._jobs: OrderedDict[int, Job] = OrderedDict()
        self._numbers = count(1)
        self._one = asyncio.Lock()

    def start(self, kind: str, words: Sequence[str]) -> Job:
        """Start `upright WORDS --json`. Raises TooManyJobs."""
        if sum(each.state in ("waiting", "running") for each in self._jobs.values()) > MOST_WAITING:
            raise TooManyJobs("too many jobs are waiting.", remedy="Wait for one to finish, or cancel one.")
        job = Job(next(self._numbers), kind, words)
        self._jobs[job.id] = job
        while len(self._jobs) > MOST_KEPT:
            self._jobs.popitem(last=False)
        job.task = asyncio.create_task(self._run(job), name=f"job {job.id} {kind}")
        return job

    def find(self, number: int) -> Job | None:
        return self._jobs.get(number)

    def cancel(self, job: Job) -> None:
        if job.task is not None and job.state in ("waiting", "running"):
            job.task.cancel()

    async def close(self) -> None:
        """Cancel all jobs."""
        tasks = [job.task for job in self._jobs.values() if job.task is not None and not job.task.done()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)

    async def _run(self, job: Job) -> None:
        process: asyncio.subprocess.Process | None = None
        try:
            async with self._one:
                job.state, job.began = "running", time.monotonic()
                process = await asyncio.create_subprocess_exec(
                    *UPRIGHT,
                    *job.words,
                    "--json",
                    stdin=asyncio.subprocess.DEVNULL,
                    stdout=asyncio.subprocess.PIPE,
                    stderr=asyncio.subprocess.PIPE,
                    env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "NO_COLOR": "1"},
                    preexec_fn=_lower_priority,
                    limit=LARGEST,
                )
                output, messages = await process.communicate()
                job.seconds = time.monotonic() - job.began
                self._finish(job, process.returncode or 0, output, messages)
        except asyncio.CancelledError:
            job.state = "cancelled"
            if process is not None and process.returncode is None:
                with contextlib.suppress(ProcessLookupError):
                    process.terminate()
                await process.wait()
        except OSError as error:
            job.state, job.error = "failed", str(error)

    def _finish(self, job: Job, status: int, output: bytes, messages: bytes) -> None:
        job.result = _result(output)
        # A diagnosis of insufficient data has exit status 1 and an answer.
        job.state = "done" if job.result is not None else "failed"
        if job.state == "failed":
            lines = messages.decode(errors="replace").strip().splitlines()
            job.error = lines[-1][:1000] if lines else f"ended with exit status {status}"


def _result(output: bytes) -> Any:
    """The JSON document of an output, or the result at the end of JSON lines; None if there is none.

    A process that ends early has printed events, but no result.
    """
    for text in (output, output.strip().rpartition(b"\n")[2]):
        try:
            document = from_json(text)
        except ValueError:
            continue
        event = isinstance(document, dict) and document.get("type", "result") != "result"
        return None if event else document
    return None


def _lower_priority() -> None:
    os.nice(NICENESS)
