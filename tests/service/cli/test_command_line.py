"""The command itself: its version, `python -m upright`, and what a shell completes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

UPRIGHT = (sys.executable, "-m", "upright")


def upright(*words: str, **more: str) -> str:
    done = subprocess.run(
        [*UPRIGHT, *words], capture_output=True, text=True, check=True, timeout=60, env={**os.environ, **more}
    )
    return done.stdout


def completed(line: str) -> list[str]:
    """What bash offers for the last word of `line`."""
    words = line.split(" ")
    return upright(_UPRIGHT_COMPLETE="complete_bash", COMP_WORDS=line, COMP_CWORD=str(len(words) - 1)).split()


def test_version() -> None:
    assert upright("--version") == f"upright {version('upright')}\n"


def test_the_module_is_the_command() -> None:
    assert "Usage: upright [OPTIONS] COMMAND" in upright("--help", NO_COLOR="1", TERM="dumb")


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("upright dia", {"diagnose"}),
        ("upright diagnose --vehicle mo", {"monocab"}),
        ("upright config check tw", {"twsbr"}),
        ("upright diagnose --effect coulomb", {"coulomb_friction"}),
        ("upright identify --method prediction", {"prediction_error"}),
        ("upright compare --model monocab_red", {"monocab_reduced"}),
        ("upright model add mine.toml visc", {"viscous_friction"}),
    ],
)
def test_a_shell_completes(line: str, offered: set[str]) -> None:
    assert set(completed(line)) == offered


def test_a_recording_is_left_to_the_shell() -> None:
    assert completed("upright diagnose run") == []


@pytest.mark.skipif(not shutil.which("bash"), reason="no bash here")
def test_bash_takes_the_script(tmp_path: Path) -> None:
    """Bash itself calls the command, by the script that `--show-completion` prints in a bash."""
    (tmp_path / "upright").write_text(f'#!/bin/sh\nexec {" ".join(UPRIGHT)} "$@"\n')
    (tmp_path / "upright").chmod(0o755)
    script = upright(_UPRIGHT_COMPLETE="source_bash")
    function = re.search(r"^(\w+)\(\)", script, re.MULTILINE)
    assert function is not None
    asked = f"{script}\nCOMP_WORDS=(upright dia); COMP_CWORD=1; {function[1]} upright; echo ${{COMPREPLY[@]}}"
    path = f"{tmp_path}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(["bash", "-c", asked], capture_output=True, text=True, env={**os.environ, "PATH": path})
    assert done.stdout.strip() == "diagnose", done.stderr
