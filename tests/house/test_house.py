"""The promised set-up by two commands: missing packages are named, and required tests are never skipped."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
APT_NEEDS = REPOSITORY / "tests" / "setup" / "apt-needs"


@pytest.fixture
def machine(tmp_path: Path) -> Path:
    """A folder with the only commands that apt-needs finds: those that it requires itself."""
    commands = tmp_path / "bin"
    commands.mkdir()
    for name in ("bash", "env"):
        (commands / name).symlink_to(shutil.which(name) or name)
    return commands


def _command(folder: Path, name: str, script: str) -> None:
    file = folder / name
    file.write_text(f"#!{folder}/bash\n{script}\n")
    file.chmod(0o755)


def _apt_needs(machine: Path, *needs: str) -> subprocess.CompletedProcess[str]:
    # The script itself appends /usr/sbin and /sbin to PATH; the commands that a test requires are in neither.
    return subprocess.run(
        [machine / "bash", APT_NEEDS, *needs], env={"PATH": str(machine)}, capture_output=True, text=True, timeout=20
    )


def test_no_message_if_nothing_is_missing(machine: Path) -> None:
    _command(machine, "upright-tool", "true")
    done = _apt_needs(machine, "upright-tool:some-package", f"{machine}/env:coreutils")
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_install_command_is_printed_if_apt_is_not_available(machine: Path) -> None:
    done = _apt_needs(machine, "upright-one:package-one", "upright-two:package-two", "bash:bash")
    assert done.returncode == 1
    assert "apt-get install package-one package-two\n" in done.stderr


def test_only_missing_packages_are_installed_and_the_list_is_updated_if_needed(machine: Path, tmp_path: Path) -> None:
    calls = tmp_path / "calls"
    _command(
        machine,
        "apt-get",
        f'echo "$*" >>{calls}; [[ $1 == update ]] || [[ -e {tmp_path}/once ]]; s=$?\n: >{tmp_path}/once; exit $s',
    )
    _command(machine, "sudo", '[[ $1 != -n ]] || shift\nexec "$@"')  # for users other than root
    done = _apt_needs(machine, "bash:bash", "upright-one:package-one")
    assert done.returncode == 0
    install = "install -y --no-install-recommends package-one"
    assert calls.read_text().splitlines() == [install, "update", install]


TWO_SKIPS = """
import pytest

@pytest.mark.skip(reason="for a reason")
def test_marked(): ...

def test_inside():
    pytest.skip("in the middle")

def test_vcan():
    pass
"""


@pytest.mark.parametrize(
    ("required", "outcomes"), [("1", {"passed": 1, "failed": 1, "error": 1}), ("", {"passed": 1, "skipped": 2})]
)
def test_skipped_test_fails_if_everything_is_required(tmp_path: Path, required: str, outcomes: dict[str, int]) -> None:
    for name in ("conftest.py", "standstill.py"):
        shutil.copy(REPOSITORY / "tests" / name, tmp_path)
    (tmp_path / "test_skips.py").write_text(TWO_SKIPS)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-ra", "--rootdir", tmp_path, tmp_path],
        env={**os.environ, "UPRIGHT_REQUIRE_ALL": required},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == (1 if required else 0)
    closing = done.stdout.splitlines()[-1]
    for outcome, count in outcomes.items():
        assert f"{count} {outcome}" in closing
    assert "for a reason" in done.stdout
    assert "in the middle" in done.stdout
