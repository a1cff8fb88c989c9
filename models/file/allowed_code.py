"""Python files that this user has allowed to run, by the SHA-256 of their content.

An effect in a Python file is code, and a model file that comes from somebody else may name one. So it is run only if
this user has allowed it, to the bit: `upright model allow FILE`. A file that was changed since is refused again. The
list is $XDG_STATE_HOME/upright/allowed-python (~/.local/state by default), one SHA-256 and path a line; it counts only
if nobody else could have written it.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

from upright.models.own_files import make_own, read_own
from upright.models.parts import ModelError

NAME = "allowed-python"


def state_directory() -> Path:
    """The folder of the list."""
    return Path(os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")) / "upright"


def sha256(content: bytes) -> str:
    """By what a file is known."""
    return hashlib.sha256(content).hexdigest()


def is_allowed(content: bytes) -> bool:
    """Whether this user has allowed a file of this content."""
    try:
        lines = read_own(state_directory(), NAME).decode(errors="replace").splitlines()
    except OSError:
        return False
    return sha256(content) in {line.partition(" ")[0] for line in lines}


def allow(path: Path) -> str:
    """Allow the file at `path`, as it is now. Returns its SHA-256. Raises ModelError."""
    try:
        content = path.read_bytes()
        if not is_allowed(content):
            make_own(state_directory())
            descriptor = os.open(
                state_directory() / NAME, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW, 0o600
            )
            with os.fdopen(descriptor, "w", encoding="utf-8", errors="replace") as file:
                file.write(f"{sha256(content)} {str(path.resolve())!r}\n")
    except OSError as error:
        what = f"cannot be allowed: {error.filename}: {error.strerror or error}"
        raise ModelError(str(path), what, remedy="check path and permissions.") from error
    if not is_allowed(content):
        what = f"cannot be allowed: others could have written {state_directory() / NAME}"
        raise ModelError(str(path), what, remedy="remove that file, or make it and its folder yours alone.")
    return sha256(content)
