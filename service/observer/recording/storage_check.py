"""Whether a recording can be written: tried before somebody needs it, and while it is written."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

PROBE = bytes(4096)
"""What is written to find out: a quota and a full disk refuse it."""

LEAST_FREE = 32_000_000
"""Bytes: a recording of a few minutes with its raw log."""

PROBE_FILE = ".upright-probe"

REMEDIES = {
    errno.ENOSPC: "delete old recordings, or give a folder on another disk with --data",
    errno.EDQUOT: "delete old recordings, or let the quota be raised",
}


def obstacle(folder: Path) -> str:
    """Why nothing can be recorded in `folder`, as a sentence with the remedy; "" if it can. Blocks like any write."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _write(folder)
        space = os.statvfs(folder)
    except OSError as error:
        remedy = REMEDIES.get(error.errno or 0, "make it writable, or give another folder with --data")
        return f"Nothing would be recorded: {folder} cannot be written ({error.strerror}): {remedy}."
    free = space.f_bavail * space.f_frsize
    if free < LEAST_FREE:
        return (
            f"Nothing would be recorded for long: {free / 1e6:.0f} MB are free in {folder}, and {LEAST_FREE / 1e6:.0f} "
            f"are needed: {REMEDIES[errno.ENOSPC]}."
        )
    return ""


def _write(folder: Path) -> None:
    """Write a little and remove it again. Raises OSError."""
    path = folder / PROBE_FILE
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
    try:
        if os.write(descriptor, PROBE) < len(PROBE):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    finally:
        os.close(descriptor)
        with suppress(OSError):
            path.unlink()
