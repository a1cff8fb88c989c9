"""The recordings below a folder of this machine or of an object store, by fsspec.

A recording is a file whose suffix is that of a format that upright reads, or the folder of a rosbag 2. Left out are
hidden files, and the raw CAN log of a recording beside it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from hashlib import sha256
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from upright.service.offline.inputs.can_log import SUFFIXES as CAN_LOGS
from upright.telemetry.errors import UprightError
from upright.telemetry.formats.files import SUFFIXES
from upright.telemetry.formats.rosbag2 import PACKED
from upright.telemetry.formats.rosbag2 import SUFFIXES as BAG_SUFFIXES

BAG = "metadata.yaml"
"""The file that each folder of a rosbag 2 has."""


class StoreError(UprightError):
    """The folder `url` cannot be used."""

    def __init__(self, url: str, message: str, *, remedy: str) -> None:
        super().__init__(f"{url}: {message}.", remedy=remedy)
        self.url = url


@dataclass(frozen=True, slots=True)
class Stored:
    """A recording called `name`, its path below the folder, in `files` of the store.

    `stamp` changes if they are written again; `modified` is when they were, if the store knows it. `content` of files
    that no other process can read.
    """

    name: str
    files: tuple[str, ...]
    stamp: str
    modified: datetime | None
    content: Mapping[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Store:
    """The folder `root` of a file system. `url` as the user gave it."""

    url: str
    files: Any
    root: str

    @classmethod
    def of(cls, url: str) -> Store:
        """A folder, or a URL as s3://bucket/runs. Raises StoreError."""
        try:
            from fsspec.core import url_to_fs
        except ImportError as error:
            remedy = "pip install 'upright[fleet]'."
            raise StoreError(
                url, "fsspec is not installed, which reads folders and object stores", remedy=remedy
            ) from error
        try:
            files, root = url_to_fs(url)
        except (ImportError, ValueError) as error:
            remedy = "Name a folder, or a URL of a protocol that fsspec knows, and install what that needs."
            raise StoreError(url, f"cannot be opened ({error})", remedy=remedy) from error
        return cls(url, files, str(root).rstrip("/"))

    def recordings(self, besides: Path | None = None) -> list[Stored]:
        """All recordings, by name, without the file `besides`.

        Raises StoreError if the folder cannot be listed, or holds none.
        """
        own = "" if besides is None else os.path.abspath(besides)
        try:
            self.files.invalidate_cache()  # a listing that was kept from earlier may be of files as they were
            paths = {path.removeprefix(self.root).lstrip("/"): path for path in sorted(self.files.find(self.root))}
            found = [self._stored(name, files) for name, files in _grouped(paths) if files != [own]]
        except Exception as error:  # each kind of store fails in its own way
            why = f"cannot be listed ({type(error).__name__}: {error})"
            remedy = "Check the path, its permissions, and the credentials of the object store."
            raise StoreError(self.url, why, remedy=remedy) from error
        if not found:
            remedy = f"Name a folder that holds files such as {', '.join((*SUFFIXES[:3], *CAN_LOGS[:1]))}."
            raise StoreError(self.url, "holds no recordings", remedy=remedy)
        return sorted(found, key=lambda each: each.name)

    @contextmanager
    def fetched(self, stored: Stored) -> Iterator[tuple[Path, str]]:
        """The path of a recording on this machine, for as long as it is needed, and the SHA-256 of its bytes."""
        if _is_local(self.files):
            yield Path(self.root, stored.name), _digest(map(Path, stored.files))
            return
        with TemporaryDirectory(prefix="upright-fleet-") as folder:
            copies = [Path(folder, path.removeprefix(self.root).lstrip("/")) for path in stored.files]
            for path, copy in zip(stored.files, copies, strict=True):
                copy.parent.mkdir(parents=True, exist_ok=True)
                copy.write_bytes(stored.content[path] if path in stored.content else self.files.cat_file(path))
            yield Path(folder, stored.name), _digest(copies)

    def _stored(self, name: str, paths: Sequence[str]) -> Stored:
        modified = None
        with suppress(NotImplementedError):
            modified = max(self.files.modified(path) for path in paths)
        stamp = sha256("".join(self.files.ukey(path) for path in paths).encode()).hexdigest()
        content = {path: self.files.cat_file(path) for path in paths} if _is_of_this_process(self.files) else {}
        return Stored(name, tuple(paths), stamp, modified, content)


def _grouped(paths: Mapping[str, str]) -> Iterator[tuple[str, list[str]]]:
    """Name and paths of each recording among paths by name."""
    bags: dict[str, list[str]] = {}
    for name, path in paths.items():
        pure = PurePosixPath(name)
        folder = str(pure.parent)
        hidden = any(part.startswith(".") for part in pure.parts)
        raw = pure.suffix == ".log" and str(pure.with_suffix(".arrow")) in paths
        if hidden or raw:
            continue
        if f"{folder}/{BAG}" in paths and PurePosixPath(name.removesuffix(PACKED)).suffix in BAG_SUFFIXES:
            bags.setdefault(folder, []).append(path)
        elif pure.suffix.lower() in {*SUFFIXES, *CAN_LOGS}:
            yield name, [path]
    yield from bags.items()


def _digest(paths: Iterable[Path]) -> str:
    """Of the bytes of all files together; of one file, its SHA-256."""
    total = sha256()
    for path in paths:
        total.update(path.read_bytes())
    return total.hexdigest()


def _is_local(files: Any) -> bool:
    from fsspec.implementations.local import LocalFileSystem

    return isinstance(files, LocalFileSystem)


def _is_of_this_process(files: Any) -> bool:
    """Whether no other process can read these files."""
    from fsspec.implementations.memory import MemoryFileSystem

    return isinstance(files, MemoryFileSystem)
