"""What is fuzzed, as data: where its inputs come from, what takes them, and what it may take for that."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path

from hypothesis import strategies as st

from upright.telemetry.errors import UprightError

Trial = Callable[[bytes], None]
"""Takes one input. It returns if that was used, and raises an UprightError if it was refused; all else is a crash."""


class Refused(UprightError):
    """A refusal that is not an exception in the product: an answer, a stop."""


@dataclass(frozen=True, slots=True)
class Target:
    """One reader of foreign bytes. Every input is bytes; what they mean is the target's affair."""

    name: str
    title: str
    opened: Callable[[Path], AbstractContextManager[Trial]]
    """The trial, with a folder for its files."""
    inputs: Callable[[], st.SearchStrategy[bytes]]
    examples: Callable[[], Sequence[bytes]]
    """Tried first, always: valid inputs, and those that once were a crash, a hang or too much memory."""
    seconds: float = 2.0
    """Of processor time; an input that takes longer is a hang."""
    megabytes: float = 100.0
    """That the process may grow by, over all inputs and in each."""
    keeps_state: int = 0
    """Inputs after which the trial is opened anew, if one input changes what the next one meets."""
    short: int = 200
    """Inputs in the tests."""


def of_file(suffix: str, read: Callable[[Path], object]) -> Callable[[Path], AbstractContextManager[Trial]]:
    """For `opened`: the input is the content of a file, which `read` takes."""

    @contextmanager
    def opened(folder: Path) -> Iterator[Trial]:
        path = folder / f"input{suffix}"

        def trial(data: bytes) -> None:
            path.write_bytes(data)
            read(path)

        yield trial

    return opened
