"""Files are replaced as a whole: a link is not followed, and a failure leaves the old file."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from upright.service.whole_file import write_whole


def test_file_is_replaced_and_nothing_else_is_left(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    for text in ("first ±", "second"):
        write_whole(path, text)
        assert path.read_text("utf-8") == text
    assert os.listdir(tmp_path) == ["page.html"]


def test_link_is_replaced_and_its_target_is_not_touched(tmp_path: Path) -> None:
    precious = tmp_path / "precious"
    precious.write_text("keep")
    path = tmp_path / "page.html"
    path.symlink_to(precious)
    write_whole(path, "page")
    assert precious.read_text() == "keep"
    assert not path.is_symlink()
    assert path.read_text() == "page"


def test_a_failure_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    write_whole(path, "old")
    with pytest.raises(UnicodeEncodeError):
        write_whole(path, "half \ud800")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["page.html"]


def test_a_pipe_is_written_to(tmp_path: Path) -> None:
    path = tmp_path / "pipe"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_whole(path, "text")
        assert os.read(reader, 10) == b"text"
    finally:
        os.close(reader)
    assert path.is_fifo()


def test_folder_that_does_not_exist_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        write_whole(tmp_path / "no" / "page.html", "text")
