"""Files that are code, or that decide about code: read only if nobody else could have written them."""

from __future__ import annotations

import os
import stat
from pathlib import Path

OTHERS = stat.S_IWGRP | stat.S_IWOTH


def read_own(folder: Path, name: str) -> bytes:
    """The content of a file; file and folder have to belong to this user or to root, and only their owner may be able
    to write them. What is checked is what is read, whatever is renamed meanwhile. Raises OSError."""
    place = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        _check_owner(place, folder)
        with open(os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK, dir_fd=place), "rb") as file:
            _check_owner(file.fileno(), folder / name)
            return file.read()
    finally:
        os.close(place)


def make_own(folder: Path) -> None:
    """Make a folder for this user alone; one that is there and belongs to this user is closed for others to write.
    Raises OSError."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    there = folder.stat()
    if there.st_uid == os.geteuid() and there.st_mode & OTHERS:
        folder.chmod(stat.S_IMODE(there.st_mode) & ~OTHERS)


def _check_owner(descriptor: int, path: Path) -> None:
    """Raises PermissionError if somebody else could have written what is open here."""
    there = os.fstat(descriptor)
    if there.st_uid not in (os.geteuid(), 0) or there.st_mode & OTHERS:
        raise PermissionError(f"{path} belongs to somebody else, or others can write it")
