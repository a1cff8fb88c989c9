"""Files that others read are whole at any time: written beside, then put in place of the old one."""

from __future__ import annotations

import os
from pathlib import Path
from secrets import token_hex


def write_whole(path: Path, text: str) -> None:
    """Replace `path` by `text`, UTF-8, at once. A link there is replaced and not followed; what is no file, as a pipe
    or a terminal, is written to. Raises OSError, and leaves the old file as it was."""
    if path.exists() and not path.is_file():
        path.write_text(text, "utf-8")
        return
    beside = path.with_name(f".{path.name}.{token_hex(4)}")
    try:
        with beside.open("x", encoding="utf-8") as file:
            file.write(text)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
