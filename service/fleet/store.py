"""The recordings below a folder of this machine or of an object store, by fsspec.

A recording is a file whose suffix is that of a format that upright reads, or the folder of a rosbag 2. Left out are
hidden files, and the raw CAN log of a recording beside it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from fnmatch import fnmatch
from hashlib import sha256
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from upright.service.offline.can_log import SUFFIXES as CAN_LOGS
from upright.telemetry.errors import UprightError
from upright.telemetry.formats.files import SUFFIXES

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

    def recordings(self, only: str = "*", besides: Path | None = None) -> list[Stored]:
        """All recordings, by name: those that match `only`, a pattern such as *.csv, and not the file `besides`.

        Raises StoreError if there is none, or if the folder cannot be listed.
        """
        try:
            paths = sorted(path for path in self.files.find(self.root) if besides is None or not _is(path, besides))
            found = [self._stored(name, files) for name, files in _grouped(self._names(paths)) if fnmatch(name, only)]
        except Exception as error:  # each kind of store fails in its own way
            why = f"cannot be listed ({type(error).__name__}: {error})"
            remedy = "Check the path, its permissions, and the credentials of the object store."
            raise StoreError(self.url, why, remedy=remedy) from error
        if not found:
            remedy = f"Name a folder that holds files such as {', '.join((*SUFFIXES[:3], *CAN_LOGS[:1]))}."
            raise StoreError(self.url, "holds no recordings", remedy=remedy)
        return found

    @contextmanager
    def fetched(self, stored: Stored) -> Iterator[tuple[Path, str]]:
        """The path of a recording on this machine, for as long as it is needed, and the SHA-256 of its bytes."""
        if _is_local(self.files):
            yield self._named(stored, Path(self.root)), _digest(map(Path, stored.files))
            return
        with TemporaryDirectory(prefix="upright-fleet-") as folder:
            here = [Path(folder, path.removeprefix(self.root).lstrip("/")) for path in stored.files]
            for path, target in zip(stored.files, here, strict=True):
                target.parent.mkdir(parents=True, exist_ok=True)
                target.write_bytes(stored.content[path] if path in stored.content else self.files.cat_file(path))
            yield self._named(stored, Path(folder)), _digest(here)

    def _names(self, paths: Sequence[str]) -> dict[str, str]:
        """Paths by their names below the root."""
        return {path.removeprefix(self.root).lstrip("/"): path for path in paths}

    def _named(self, stored: Stored, root: Path) -> Path:
        return root / stored.name

    def _stored(self, name: str, paths: Sequence[str]) -> Stored:
        modified = None
        with suppress(NotImplementedError):
            modified = max(self.files.modified(path) for path in paths)
        stamp = sha256("".join(self.files.ukey(path) for path in paths).encode()).hexdigest()
        content = {path: self.files.cat_file(path) for path in paths} if _is_of_this_process(self.files) else {}
        return Stored(name, tuple(paths), stamp, modified, content)


def _grouped(paths: Mapping[str, str]) -> Iterator[tuple[str, list[str]]]:
    """Name and paths of each recording among files by name."""
    bags = [f"{PurePosixPath(name).parent}/" for name in paths if PurePosixPath(name).name == BAG]
    for bag in bags:
        yield bag.rstrip("/"), [path for name, path in paths.items() if name.startswith(bag)]
    for name, path in paths.items():
        pure = PurePosixPath(name)
        hidden = any(part.startswith(".") for part in pure.parts)
        raw = pure.suffix == ".log" and str(pure.with_suffix(".arrow")) in paths
        known = pure.suffix.lower() in {*SUFFIXES, *CAN_LOGS}
        if known and not hidden and not raw and not name.startswith(tuple(bags)):
            yield name, [path]


def _digest(paths: Iterator[Path] | Sequence[Path]) -> str:
    """Of the bytes of all files together; of one file, its SHA-256."""
    total = sha256()
    for path in paths:
        total.update(path.read_bytes())
    return total.hexdigest()


def _is(path: str, other: Path) -> bool:
    return path == str(other.absolute())


def _is_local(files: Any) -> bool:
    from fsspec.implementations.local import LocalFileSystem

    return isinstance(files, LocalFileSystem)


def _is_of_this_process(files: Any) -> bool:
    """Whether no other process can read these files."""
    from fsspec.implementations.memory import MemoryFileSystem

    return isinstance(files, MemoryFileSystem)
