"""A report is opened only where somebody sees the browser."""

from __future__ import annotations

import sys
import webbrowser
from pathlib import Path

import pytest

from upright.service import browser
from upright.service.browser import has_browser, open_page


@pytest.mark.parametrize(
    ("environment", "platform", "terminal", "expected"),
    [
        ({"DISPLAY": ":0"}, "linux", True, True),
        ({"WAYLAND_DISPLAY": "wayland-0"}, "linux", True, True),
        ({}, "darwin", True, True),
        ({}, "win32", True, True),
        ({}, "linux", True, False),
        ({"DISPLAY": ""}, "linux", True, False),
        ({"DISPLAY": ":0"}, "linux", False, False),
        ({"DISPLAY": "localhost:10.0", "SSH_CONNECTION": "10.0.0.2 50000 10.0.0.1 22"}, "linux", True, False),
        ({"SSH_TTY": "/dev/ttys001"}, "darwin", True, False),
        ({"DISPLAY": ":99", "CI": "true"}, "linux", True, False),
    ],
)
def test_browser_is_where_a_person_is(
    environment: dict[str, str], platform: str, terminal: bool, expected: bool
) -> None:
    assert has_browser(environment, platform, terminal=terminal) is expected


def test_page_is_opened_by_its_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda address: bool(opened.append(address)) or True)
    monkeypatch.setattr(browser, "has_browser", lambda *_, **__: True)
    assert open_page(tmp_path / "a b.html")
    assert opened == [(tmp_path / "a b.html").as_uri()]


def test_nothing_is_opened_from_a_pipe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(webbrowser, "open", lambda _: pytest.fail("it was opened"))
    with (tmp_path / "out").open("w") as pipe:
        monkeypatch.setattr(sys, "stdout", pipe)
        assert not open_page(tmp_path / "page.html")
