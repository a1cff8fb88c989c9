"""A pendulum on a motor with dry friction that its model lacks: a table and a model file, as a user has them."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pendulum_plant
import pytest

MANUAL = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "write-your-own-model.md"
FRICTION = 0.25
"""N m."""


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With `run.csv`, and `pendulum.toml`, the first model file of the manual."""
    path = tmp_path_factory.mktemp("pendulum")
    missing: pendulum_plant.Missing = lambda t, angle, rate: -FRICTION * rate / math.hypot(rate, 2e-3)  # noqa: E731
    pendulum_plant.write(path / "run.csv", missing, seed=71, duration=15.0)
    blocks = re.findall(r"^```toml\n(.*?)^```", MANUAL.read_text(), re.DOTALL | re.MULTILINE)
    (path / "pendulum.toml").write_text(blocks[0])
    return path
