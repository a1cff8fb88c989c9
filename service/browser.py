"""Open a page in the user's browser, where there is one."""

from __future__ import annotations

import os
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path

ELSEWHERE = ("SSH_CONNECTION", "SSH_TTY", "CI")
"""Variables of sessions whose user sits at another computer, or nowhere."""
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")


def has_browser(environment: Mapping[str, str], platform: str, *, terminal: bool) -> bool:
    """Whether somebody sits at a `terminal` of this computer and sees its screen.

    A text browser would take the terminal, so a `platform` other than Windows and macOS needs a display."""
    if not terminal or any(environment.get(name) for name in ELSEWHERE):
        return False
    return platform in ("win32", "darwin") or any(environment.get(name) for name in DISPLAYS)


def open_page(path: Path) -> bool:
    """Open the page at `path`, if there is a browser: whether it was opened."""
    if not has_browser(os.environ, sys.platform, terminal=sys.stdout.isatty()):
        return False
    try:
        return webbrowser.open(path.absolute().as_uri())
    except (webbrowser.Error, OSError):
        return False
