"""The offset of a model's inputs: who gets one, how wide it is, and that it does not stay."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from diagnosis.prepare.time_offsets import EARLIEST, LATEST, OFFSET, timed, untimed
from models import library
from models.library.axis import axis
from models.model import Model
from models.parts import Parameter
from telemetry.channels import Channel, ChannelTable
from telemetry.recording import Recording


def rows(spacing: float, count: int = 5) -> Recording:
    time = np.round(np.arange(count) * spacing * 1e9).astype(np.int64)
    return Recording(ChannelTable((Channel("force", "N", ""),)), time, {"force": np.zeros(count)}, source="rows")


@pytest.fixture
def model() -> Model:
    return axis(name="bare", inertia=2.0)


def test_it_is_half_a_row_of_the_slowest_recording(model: Model) -> None:
    offset = timed(model, [rows(0.001), rows(0.004)]).parameter(OFFSET)
    assert offset.value == 0.0
    assert offset.std == pytest.approx(0.004 / math.sqrt(12.0))
    assert (offset.lower, offset.upper) == pytest.approx((0.004 * EARLIEST, 0.004 * LATEST))
    assert offset.estimated


def test_a_gap_is_no_row(model: Model) -> None:
    """One of 10 s, among rows of 1 ms."""
    whole = rows(0.001, 9)
    late = whole.timestamp_ns + np.where(np.arange(9) > 4, 10_000_000_000, 0)
    gap = Recording(whole.channels, late, whole.values, source="gap")
    assert timed(model, [gap]).parameter(OFFSET).std == pytest.approx(0.001 / math.sqrt(12.0))


def test_who_says_when_an_input_acts_is_believed(model: Model) -> None:
    named = replace(model, base_parameters=(*model.base_parameters, Parameter(OFFSET, "N", 0.0)))
    for told in (library.get("monocab_roll"), library.get("twsbr"), model.add("input_delay"), named):
        assert timed(told, [rows(0.004)]) is told


def test_without_two_rows_there_is_none(model: Model) -> None:
    assert timed(model, [rows(0.004, 1)]) is model


def test_what_was_fitted_stays_and_the_offset_goes(model: Model) -> None:
    there = timed(model, [rows(0.004)]).add("coulomb_friction")
    fitted = there.change({"inertia": 3.0, OFFSET: 0.001, "coulomb_friction.torque": 0.5})
    assert untimed(model, fitted) == model.add("coulomb_friction").change(
        {"inertia": 3.0, "coulomb_friction.torque": 0.5}
    )
