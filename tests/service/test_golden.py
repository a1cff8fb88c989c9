"""The golden recordings are still what the virtual vehicles record."""

from __future__ import annotations

import numpy as np
import pytest
from golden import FOLDER, GOLDEN, Recipe
from thorough import of_many

from upright.telemetry.storage import load

ALWAYS = [next(each for each in GOLDEN if each.vehicle == name) for name in ("twsbr", "cube")]
ALWAYS.append(next(each for each in GOLDEN if each.vehicle == "monocab" and each.duration == 10.0))
SAME = 1e-4
"""Share of a channel's own scatter by which it may differ (RMS): the last bits of another processor's arithmetic may
change an encoder's count. Chosen, not measured."""
HASH = "configuration_hash"
ROUNDED = 2.0**-23
"""Relative rounding error of values with 32 bits."""


@pytest.mark.parametrize("recipe", of_many(GOLDEN, *ALWAYS), ids=lambda recipe: recipe.path.stem)
def test_virtual_vehicle_still_records_it(recipe: Recipe) -> None:
    kept, now = load(recipe.path), recipe.simulated()
    assert kept.channels == now.channels
    # A comment in the vehicle file changes its hash, but nothing that is recorded.
    assert {**kept.metadata, HASH: ""} == {**now.metadata, HASH: ""}
    np.testing.assert_array_equal(kept.timestamp_ns, now.timestamp_ns)
    for name, column in now.values.items():
        least = SAME * float(np.nanstd(column)) + ROUNDED * float(np.nanmax(np.abs(column)))
        assert float(np.sqrt(np.nanmean((kept[name] - column) ** 2))) <= least, name
        np.testing.assert_array_equal(np.isnan(kept[name]), np.isnan(column))


def test_folder_holds_no_other_files() -> None:
    assert {each.name for each in FOLDER.iterdir()} == {each.path.name for each in GOLDEN}
