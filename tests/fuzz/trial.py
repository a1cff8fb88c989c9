"""One input after another into a target, and an account of what became of them.

An input is a crash if it raises anything but an UprightError or leaves a temporary file, a hang if it takes more than
the target's processor time, and too large if the process grows by more than the target's memory. Time is counted by the
processor, so that a busy machine changes nothing; an input that waits instead is ended by the process that watches this
one.
"""

from __future__ import annotations

import contextlib
import gc
import signal
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis.strategies import SearchStrategy

from fuzz.target import Target, Trial
from upright.telemetry.errors import UprightError

BATCH = 500
"""Inputs of one run of Hypothesis, which remembers what it tried."""
WARM_UP = 50
"""Inputs after the examples before memory is counted: caches fill."""
REPOSITORY = Path(__file__).resolve().parents[2]
LONGEST_WORDS = 200


class Over(BaseException):
    """Ends a run of Hypothesis."""


class Hang(BaseException):
    """An input takes too long. No `except Exception` of the product catches it."""


@dataclass(slots=True)
class Failure:
    """A crash, a hang or too much memory at one place: how often, and the `inputs` that lead to it, from a fresh trial
    on."""

    kind: str
    where: str
    words: str
    count: int
    inputs: list[bytes]


@dataclass(slots=True)
class Account:
    """What became of the inputs of one target. Times in s, memory in MB."""

    target: str
    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    slowest: float = 0.0
    growth: float = 0.0
    failures: dict[str, Failure] = field(default_factory=dict)

    def note(self, kind: str, where: str, words: str, inputs: list[bytes], count: int = 1) -> None:
        """Count a failure; of each place the shortest inputs are kept."""
        known = self.failures.setdefault(where, Failure(kind, where, words, 0, inputs))
        known.count += count
        if (len(inputs), sum(map(len, inputs))) < (len(known.inputs), sum(map(len, known.inputs))):
            known.inputs, known.words = inputs, words

    def count(self, kind: str) -> int:
        return sum(each.count for each in self.failures.values() if each.kind == kind)

    def merge(self, other: Account) -> None:
        """Add what became of further inputs."""
        self.inputs += other.inputs
        self.accepted += other.accepted
        self.refused += other.refused
        self.slowest = max(self.slowest, other.slowest)
        self.growth = max(self.growth, other.growth)
        for each in other.failures.values():
            self.note(each.kind, each.where, each.words, each.inputs, each.count)


class Session:
    """Takes inputs for one target, in this process. `before` is called with each input before it is tried."""

    def __init__(self, target: Target, folder: Path, before: Callable[[bytes], None] = lambda data: None) -> None:
        self.account = Account(target.name)
        self._target = target
        self._folder = folder
        self._before = before
        self._stack = ExitStack()
        self._trial: Trial | None = None
        self._since: list[bytes] = []
        """The inputs since the trial was opened, if it keeps state."""
        self._base = 0.0
        self._warm = WARM_UP + len(target.examples())

    def take(self, data: bytes) -> None:
        """Try one input."""
        account, target = self.account, self._target
        if self._trial is None or (target.keeps_state and len(self._since) >= target.keeps_state):
            self._open()
        assert self._trial is not None
        self._since = [*self._since, data] if target.keeps_state else [data]
        self._before(data)
        account.inputs += 1
        before, began = forget_peak(), time.process_time()
        try:
            with leaving_nothing(self._folder), timed(target.seconds), silence():
                self._trial(data)
        except UprightError:
            account.refused += 1
        except Hang as error:
            self._fail("hang", f"at {_place(error)}", "")
        except Exception as error:  # that is what is looked for
            self._fail("crash", f"{type(error).__name__} at {_place(error)}", _words(error))
        else:
            account.accepted += 1
        account.slowest = max(account.slowest, time.process_time() - began)
        self._weigh(before)

    def close(self) -> None:
        self._trial = None
        self._stack.close()

    def _open(self) -> None:
        self.close()
        self._trial = self._stack.enter_context(self._target.opened(self._folder))
        self._since = []

    def _fail(self, kind: str, where: str, words: str) -> None:
        self.account.note(kind, where, words, list(self._since))
        self.close()  # whatever state it left

    def _weigh(self, before: float) -> None:
        """Memory that one input took, and that all since the warm-up have left behind."""
        if self.account.inputs <= self._warm or not self._base:
            self._base = resident()
        growth = max(peak() - before, resident() - self._base)
        self.account.growth = max(self.account.growth, growth)
        if growth > self._target.megabytes:
            self.account.note("memory", f"more than {self._target.megabytes:g} MB", "", list(self._since))
            self._base = resident()


@contextmanager
def timed(seconds: float) -> Iterator[None]:
    """Raises Hang in the block after `seconds` of processor time, and again if that is not heeded."""

    def ring(number: int, frame: FrameType | None) -> None:
        raise Hang

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds, 0.5)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


@contextmanager
def leaving_nothing(folder: Path) -> Iterator[None]:
    """Temporary files go into a folder of their own; raises AssertionError if one is left there."""
    before = tempfile.tempdir
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        tempfile.tempdir = temporary
        try:
            yield
        finally:
            tempfile.tempdir = before
            left = [path.suffix for path in Path(temporary).iterdir()]
            assert not left, f"temporary files were left: {left}"


@contextmanager
def silence() -> Iterator[None]:
    with contextlib.redirect_stderr(None), contextlib.redirect_stdout(None):
        yield


def tried(target: Target, session: Session, number: int, over: Callable[[], bool]) -> None:
    """Try the examples, then generated inputs until it is `over`. The `number` decides what is generated."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a warning is no crash
        for data in target.examples():
            session.take(data)
        inputs = target.inputs()
        with contextlib.suppress(Over), _old_objects_set_aside():
            while True:
                _batch(inputs, session, number, over)
                number += 1


@contextmanager
def _old_objects_set_aside() -> Iterator[None]:
    """A reader that collects garbage after each failure then looks at its own objects alone."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _batch(inputs: SearchStrategy[bytes], session: Session, number: int, over: Callable[[], bool]) -> None:
    @seed(number)
    @settings(
        max_examples=BATCH,
        database=None,
        deadline=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(inputs)
    def batch(data: bytes) -> None:
        if over():
            raise Over
        session.take(data)

    batch()


def forget_peak() -> float:
    """Start to measure anew; returns what the process has now, MB."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return resident()


def resident() -> float:
    """What the process has now, MB."""
    return _status("VmRSS:")


def peak() -> float:
    """The most that the process had since `forget_peak`, MB."""
    return _status("VmHWM:")


def _status(key: str) -> float:
    with open("/proc/self/status", "rb") as status:
        for line in status:
            if line.startswith(key.encode()):
                return int(line.split()[1]) / 1024.0
    return 0.0


def _place(error: BaseException) -> str:
    """The last line of the product that `error` came through; any last line if there is none."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [each for each in frames if _is_of_product(each.filename)]
    last = (own or frames)[-1]
    return f"{Path(last.filename).name if not own else Path(last.filename).relative_to(REPOSITORY)}:{last.lineno}"


def _is_of_product(filename: str) -> bool:
    path = Path(filename)
    return path.is_relative_to(REPOSITORY) and not path.is_relative_to(REPOSITORY / "tests") and ".venv" not in filename


def _words(error: Any) -> str:
    return " ".join(str(error).split())[:LONGEST_WORDS]
