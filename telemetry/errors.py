"""The one base exception of upright; each layer derives its own from it."""

from __future__ import annotations


class UprightError(Exception):
    """An error that a person can correct.

    The message states what happened; `remedy` states what to do about it. Subclasses add attributes a program can read.
    """

    def __init__(self, message: str, *, remedy: str = "") -> None:
        super().__init__(message)
        self.remedy = remedy

    def __str__(self) -> str:
        message = super().__str__()
        return f"{message} Remedy: {self.remedy}" if self.remedy else message


class RecordingError(UprightError):
    """A recording cannot be read, written or used. `file` and `key` (a channel, a line) say where."""

    def __init__(self, file: str, key: str, message: str, *, remedy: str = "") -> None:
        super().__init__(f"{file}: {key + ': ' if key else ''}{message}.", remedy=remedy)
        self.file = file
        self.key = key
