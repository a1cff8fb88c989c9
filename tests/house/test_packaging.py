"""What is installed: every dependency locked with its hashes, images pinned, and the contents of the Debian package."""

from __future__ import annotations

import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).resolve().parents[2]
LOCK = (REPOSITORY / "requirements.lock").read_text()


def locked() -> dict[str, list[tuple[str, int]]]:
    """Versions and their numbers of hashes by name: several where they differ by the version of Python."""
    found: dict[str, list[tuple[str, int]]] = {}
    for entry in re.split(r"\n(?=\w)", re.sub(r"(?m)^ *#.*\n", "", LOCK)):
        name, version = re.match(r"([\w.-]+)==([^ ;]+)", entry).groups()  # type: ignore[union-attr]
        found.setdefault(name, []).append((version, entry.count("--hash=sha256:")))
    return found


def test_every_dependency_is_locked_with_hashes() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    versions = locked()
    for text in [*project["project"]["dependencies"], *project["build-system"]["requires"], "pip"]:
        requirement = Requirement(text)
        entries = versions.get(canonicalize_name(requirement.name), [])
        assert entries, f"{text}: `make lock` writes it into requirements.lock"
        assert all(requirement.specifier.contains(version) for version, _ in entries), f"{text}: `make lock`"
    assert [name for name, entries in versions.items() if not all(hashes for _, hashes in entries)] == []


def test_lock_names_no_registry() -> None:
    assert not re.search(r"https?:|file:|--index|--find-links", LOCK)


def test_images_are_pinned_and_do_not_run_as_root() -> None:
    docker = (REPOSITORY / "Dockerfile").read_text()
    images = re.findall(r"(?m)^FROM (\S+)|image: (\S+)", docker + (REPOSITORY / "docker-compose.yml").read_text())
    assert images
    for image in map("".join, images):
        assert re.search(r":\d+\.\d+\.\d+|@sha256:", image), f"{image}: a version of three numbers, or a digest"
    users = re.findall(r"(?m)^USER (\S+)", docker)
    assert users
    assert users[-1] not in ("root", "0")
    assert docker.index("--require-hashes") < docker.index("COPY . "), "what the lock names comes first"


@pytest.mark.skipif(not shutil.which("dpkg-deb"), reason="no Debian here")
def test_package_holds_the_wheels_the_unit_and_the_manual(tmp_path: Path) -> None:
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    for name in ("upright-0.2.0rc1-py3-none-any.whl", "numpy-2.4.6-cp311-cp311-linux_x86_64.whl"):
        (wheels / name).touch()
    build = [REPOSITORY / "deploy" / "deb", wheels, tmp_path]
    package = subprocess.run(build, check=True, capture_output=True, text=True, timeout=60).stdout.strip()
    assert re.fullmatch(r"upright_0\.2\.0~rc1_\w+\.deb", Path(package).name), "older than 0.2.0 to dpkg"
    listing = subprocess.run(["dpkg-deb", "--contents", package], check=True, capture_output=True, text=True).stdout
    owners = {line.split()[1] for line in listing.splitlines()}
    files = {line.split()[5].removeprefix(".") for line in listing.splitlines()}
    assert owners == {"root/root"}
    assert {
        "/opt/upright/set-up",
        "/opt/upright/wheels/numpy-2.4.6-cp311-cp311-linux_x86_64.whl",
        "/usr/bin/upright",
        "/usr/lib/systemd/system/upright.service",
        "/usr/lib/sysusers.d/upright.conf",
        "/etc/upright/upright.env",
        "/usr/share/doc/upright/docs/how-to/run-as-a-service.md",
        "/usr/share/doc/upright/requirements.lock",
    } <= files
    assert not [file for file in files if file.startswith("/var") or file.endswith("vehicle.toml")], (
        "data are not its own"
    )
