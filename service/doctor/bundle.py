"""One archive for somebody who helps: logs, configuration, recordings, versions and findings, and no secret.

What is text is packed without secrets (`service.doctor.secrets`). Of another file, as a recording, nothing can be
removed: it is left out if it holds a known one. The vehicle file is packed as it was read, so without comments, and of
the environment what is known to be harmless. Only ordinary files of the given folders are read, no links.
"""

from __future__ import annotations

import io
import json
import os
import stat
import tarfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any

from upright.service.control.adopted import FILE as ADOPTED
from upright.service.control.commissioned import FILE as COMMISSIONED
from upright.service.doctor import secrets
from upright.service.doctor.collect import run
from upright.telemetry.errors import UprightError
from upright.vehicles.sections import VehicleFile

HARMLESS = (
    "UPRIGHT_",
    "OPENBLAS_",
    "NUMBA_",
    "PYTHON",
    "LANG",
    "LC_",
    "TZ",
    "STATE_",
    "RUNTIME_",
    "CACHE_",
    "XDG_RUNTIME",
)
"""Beginnings of the names of variables that are packed."""

LINES = 20_000
"""Lines of the journal that are packed, the newest."""

LARGEST_TEXT = 4_000_000
"""Bytes of one text, the end of a longer one."""

OF_A_MEMBER = 1536
"""Bytes that an archive needs for each file beside its content, at most."""

SUFFIXES = (".arrow", ".log", ".estimates.json")
"""The files of a recording."""

ENVIRONMENT_FILE = Path("/etc/upright/upright.env")


class BundleError(UprightError):
    """An archive cannot be written."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """What shall be packed. `data` is the folder of the recordings, of which the last `recordings` are packed while the
    archive stays below `limit` bytes; `logs` are further log files; `daemon` is the process of a running one.
    `vehicle` is None if the file at `vehicle_path` cannot be used."""

    data: Path
    recordings: int
    limit: int
    logs: tuple[Path, ...] = ()
    vehicle: VehicleFile | None = None
    vehicle_path: Path | None = None
    daemon: int | None = None
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))


@dataclass(slots=True)
class Packed:
    """What is in an archive, what is not and why, and its size in bytes."""

    path: Path
    files: list[dict[str, Any]] = field(default_factory=list)
    left_out: list[dict[str, str]] = field(default_factory=list)
    size: int = 0


def known_secrets(wanted: Wanted) -> tuple[set[str], list[str]]:
    """The values that must not get into the archive, and the files with others that could not be read."""
    environments = [wanted.environment]
    if wanted.daemon is not None:
        with suppress(OSError):
            environments.append(_variables(Path(f"/proc/{wanted.daemon}/environ").read_text(errors="replace"), "\0"))
    with suppress(OSError):
        environments.append(_variables(ENVIRONMENT_FILE.read_text(errors="replace"), "\n"))
    found, files = set[str](), set[str]()
    for environment in environments:
        found |= secrets.of_environment(environment)
        files |= secrets.files_of(environment)
    for place in Path("/proc").glob("[0-9]*/cmdline"):  # daemon, page, and whatever else of upright runs here
        with suppress(OSError):
            words = place.read_text(errors="replace").split("\0")
            if any("upright" in word for word in words):
                files |= secrets.files_on(words)
    if wanted.vehicle is not None and wanted.vehicle.mqtt.password_file:
        files.add(wanted.vehicle.mqtt.password_file)
    elif wanted.vehicle is None and wanted.vehicle_path is not None:
        with suppress(OSError):
            files |= secrets.files_in(wanted.vehicle_path.read_text(errors="replace"))
    unread = []
    for name in sorted(files):
        try:
            found |= set(Path(name).read_text(errors="replace").splitlines())
        except OSError as error:
            unread.append(f"{name}: {error.strerror}")
    return {each for each in found if each.strip()}, unread


def _variables(text: str, separator: str) -> dict[str, str]:
    pairs = [line.strip().partition("=") for line in text.split(separator)]
    return {name: value.strip("\"'") for name, equals, value in pairs if equals and not name.startswith("#")}


def pack(
    path: Path, wanted: Wanted, documents: Mapping[str, Any], progress: Callable[[str], None] = lambda text: None
) -> Packed:
    """Write the archive at `path`, readable by its owner alone. `documents` are packed as `NAME.json`.

    Raises BundleError if it cannot be written; nothing is left then.
    """
    part = path.with_name(f"{path.name}.part")
    try:
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        with os.fdopen(descriptor, "wb") as stream:
            packed = _Archive(stream, path, wanted, progress).write(documents)
        part.rename(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise BundleError(
            f"{path} cannot be written: {error.strerror}.", remedy="Give another --output FILE."
        ) from error
    except BaseException:
        part.unlink(missing_ok=True)
        raise
    packed.size = path.stat().st_size
    return packed


class _Archive:
    """An archive that is being written, with a bound on what goes into it."""

    def __init__(self, stream: io.BufferedWriter, path: Path, wanted: Wanted, progress: Callable[[str], None]) -> None:
        self._stream = stream
        self._wanted = wanted
        self._progress = progress
        self._folder = path.name.removesuffix(".tar.gz")
        self._packed = Packed(path)
        known, self._unread = known_secrets(wanted)
        self._redactor = secrets.Redactor(known)
        self._left = wanted.limit - 64_000  # for the list of contents
        self._now = int(datetime.now(UTC).timestamp())

    def write(self, documents: Mapping[str, Any]) -> Packed:
        with tarfile.open(fileobj=self._stream, mode="w:gz") as self._tar:
            for name, document in documents.items():
                self._document(f"{name}.json", document)
            self._configuration()
            self._logs()
            self._recordings()
            self._contents()
        return self._packed

    # What goes in

    def _configuration(self) -> None:
        self._progress("packing the configuration")
        wanted = self._wanted
        if wanted.vehicle is not None:
            self._document("configuration/vehicle.json", wanted.vehicle.model_dump(mode="json"))
        shown = {name: value for name, value in sorted(wanted.environment.items()) if name.startswith(HARMLESS)}
        self._document("configuration/environment.json", shown)
        versions = {each.metadata["Name"]: each.version for each in metadata.distributions()}
        self._document("versions.json", dict(sorted(versions.items())))
        self._command("configuration/unit.txt", "systemctl", "cat", "upright")
        for path in [wanted.data / name for name in (ADOPTED, COMMISSIONED)]:
            if path.exists():
                self._text_file(f"configuration/{path.name}", path)
        for path in sorted((wanted.data / "models").glob("*.toml")):
            self._text_file(f"models/{path.name}", path)

    def _logs(self) -> None:
        self._progress("packing logs")
        self._command(
            "logs/journal.txt",
            *("journalctl", "--unit=upright", "--no-pager", "--output=short-iso-precise", f"--lines={LINES}"),
        )
        for path in self._wanted.logs:
            self._text_file(f"logs/{path.name}", path)

    def _recordings(self) -> None:
        for stem in list(_recordings(self._wanted.data))[: self._wanted.recordings]:
            for path in (Path(f"{stem}{suffix}") for suffix in SUFFIXES):
                self._progress(f"packing {path.name}")
                self._recorded_file(f"recordings/{path.name}", path)

    def _contents(self) -> None:
        packed = self._packed
        document = {
            "packed": packed.files,
            "left_out": packed.left_out,
            "secrets": "Known passwords and tokens, and what looks like one, were removed.",
            "not_known": self._redactor.document(self._unread),
        }
        self._add("contents.json", json.dumps(document, indent=2).encode()[:60_000])

    # How it goes in

    def _document(self, name: str, document: Any) -> None:
        clean = self._redactor.document(json.loads(json.dumps(document, default=str)))
        self._put(name, json.dumps(clean, indent=2).encode())

    def _command(self, name: str, *command: str) -> None:
        try:
            self._text(name, run(*command))
        except UprightError as error:
            self._leave_out(name, str(error))

    def _text_file(self, name: str, path: Path) -> None:
        if (content := self._content(name, path)) is not None:
            self._text(name, content.decode("utf-8", "replace"))

    def _recorded_file(self, name: str, path: Path) -> None:
        content = self._content(name, path) if path.exists() else None
        if content is None:
            return
        if path.suffix == ".json":
            self._text(name, content.decode("utf-8", "replace"))
        elif self._redactor.holds_known(content):
            self._leave_out(name, "it holds a secret")
        else:
            self._put(name, content)

    def _text(self, name: str, text: str) -> None:
        # Cut after the secrets were removed: half a secret would not be known as one.
        clean = self._redactor.text(text).encode()
        if len(clean) > LARGEST_TEXT:
            self._leave_out(f"{name} (its beginning)", f"only the last {LARGEST_TEXT / 1e6:.0f} MB are packed")
            clean = clean[-LARGEST_TEXT:]
        self._put(name, clean)

    def _content(self, name: str, path: Path) -> bytes | None:
        """The content of an ordinary file, or None, with the reason."""
        try:
            descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
            with os.fdopen(descriptor, "rb") as stream:
                about = os.fstat(descriptor)
                if not stat.S_ISREG(about.st_mode):
                    self._leave_out(name, "it is no ordinary file")
                elif about.st_size > self._wanted.limit:
                    self._leave_out(name, f"its {about.st_size / 1e6:.0f} MB are beyond the limit of the archive")
                else:
                    return stream.read(about.st_size)
        except OSError as error:
            self._leave_out(name, "it is a link" if path.is_symlink() else str(error.strerror))
        return None

    def _put(self, name: str, content: bytes) -> None:
        if len(content) + OF_A_MEMBER > self._left:
            self._leave_out(name, f"its {len(content) / 1e6:.1f} MB do not fit into the archive any more")
            return
        self._left -= len(content) + OF_A_MEMBER
        name = self._redactor.text(name)
        self._add(name, content)
        self._packed.files.append({"file": name, "bytes": len(content), "sha256": sha256(content).hexdigest()})

    def _add(self, name: str, content: bytes) -> None:
        entry = tarfile.TarInfo(f"{self._folder}/{name}")
        entry.size, entry.mode, entry.mtime = len(content), 0o600, self._now
        self._tar.addfile(entry, io.BytesIO(content))

    def _leave_out(self, name: str, why: str) -> None:
        self._packed.left_out.append({"file": self._redactor.text(name), "why": self._redactor.text(why)})


def _recordings(folder: Path) -> Iterator[Path]:
    """The recordings in a folder, without suffix, the newest first."""
    found = []
    for path in folder.glob("*.arrow"):
        with suppress(FileNotFoundError):  # somebody tidies up
            found.append((path.lstat().st_mtime, path.with_suffix("")))
    for _, stem in sorted(found, reverse=True):
        yield stem
