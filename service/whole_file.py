"""Files that others read are whole at any time: written beside, then put in place of the old one."""

from __future__ import annotations

import os
from pathlib import Path
from secrets import token_hex


def write_whole(path: Path, content: str | bytes) -> None:
    """Replace `path` by `content`, text as UTF-8, at once. A link there is replaced and not followed; what is no file,
    as a pipe or a terminal, is written to. Raises OSError, and leaves the old file as it was."""
    content = content.encode() if isinstance(content, str) else content
    if path.exists() and not path.is_file():
        path.write_bytes(content)
        return
    beside = path.with_name(f".{path.name}.{token_hex(4)}")
    try:
        with beside.open("xb") as file:
            file.write(content)
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)
