"""The short form of `make fuzz`: some hundred inputs a target, always the same ones."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fuzz.mutation import anything
from fuzz.table import keep, main, row
from fuzz.target import Refused, Target, Trial
from fuzz.targets import TARGETS
from fuzz.trial import WARM_UP, Account, Session, tried


def account_of(target: Target, folder: Path, inputs: int) -> Account:
    """What becomes of the examples, and of `inputs` generated ones."""
    session = Session(target, folder)
    most = len(target.examples()) + inputs
    tried(target, session, 0, lambda: session.account.inputs >= most)
    session.close()
    return session.account


@pytest.mark.parametrize("target", TARGETS.values(), ids=lambda target: target.name)
def test_no_input_is_a_crash_or_a_hang_or_too_large(target: Target, tmp_path: Path) -> None:
    account = account_of(target, tmp_path, target.short)
    assert list(keep(account, tmp_path / "kept")) == []
    assert account.accepted > 0
    assert account.refused > 0
    assert account.accepted + account.refused == account.inputs == len(target.examples()) + target.short


# The trial itself finds what it looks for


@contextmanager
def bad(folder: Path) -> Iterator[Trial]:
    held: list[bytes] = []

    def trial(data: bytes) -> None:
        match data:
            case b"refuse":
                raise Refused("no")
            case b"crash":
                raise KeyError("x")
            case b"litter":
                tempfile.mkstemp()
                raise Refused("no")
            case b"hang":
                while True:
                    time.process_time()
            case b"memory":
                assert b"x" * (64 << 20)
            case b"leak":
                held.append(b"x" * (2 << 20))

    yield trial


def bad_target(*examples: bytes) -> Target:
    return Target(
        "bad", "a bad reader", bad, lambda: anything([b"seed"]), lambda: list(examples), seconds=0.2, megabytes=32.0
    )


@pytest.mark.parametrize(
    ("data", "kind"), [(b"crash", "crash"), (b"litter", "crash"), (b"hang", "hang"), (b"memory", "memory")]
)
def test_trial_notices(data: bytes, kind: str, tmp_path: Path) -> None:
    account = account_of(bad_target(b"fine", b"refuse", data), tmp_path, 10)
    assert [each.kind for each in account.failures.values()] == [kind]
    assert next(iter(account.failures.values())).inputs == [data]
    assert account.refused == 1
    assert account.inputs == 13


def test_trial_notices_what_stays(tmp_path: Path) -> None:
    session = Session(bad_target(), tmp_path)
    for _ in range(WARM_UP + 40):
        session.take(b"leak")
    assert session.account.count("memory") > 0


def test_failure_is_kept_and_can_be_tried_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    account = Account("log")
    account.note("crash", "ValueError at x.py:1", "words", [b"(1.000000) can0 123#R99999999999\n"])
    account.note("crash", "ValueError at x.py:1", "fewer words", [b"(1)\n"])
    (said,) = keep(account, tmp_path)
    (kept,) = tmp_path.iterdir()
    assert str(kept) in said
    assert "(2)" in said
    assert json.loads(kept.read_text())["words"] == "fewer words"
    assert main(["--replay", str(kept)]) == 0  # a log with such a line is refused
    assert "refused: " in capsys.readouterr().out
    assert row(account)[:6] == ("log", "0", "0", "0", "2", "0")


def test_each_target_runs_in_a_process_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--only", "csv", "--minutes", "0.02", "--seed", "1", "--keep", str(tmp_path)]) == 0
    cells = capsys.readouterr().out.splitlines()[1].split()
    assert cells[0] == "csv"
    assert int(cells[1]) > 0
    assert not list(tmp_path.iterdir())
