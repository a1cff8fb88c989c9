"""The time offset of a model's inputs: which models get it, how large it may be, and its removal after the fit."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from upright.diagnosis.prepare.time_offsets import EARLIEST, LATEST, OFFSET, timed, untimed
from upright.models import library
from upright.models.library.axis import axis
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording


def recorded(spacing: float, count: int = 5) -> Recording:
    time = np.round(np.arange(count) * spacing * 1e9).astype(np.int64)
    return Recording(ChannelTable((Channel("force", "N", ""),)), time, {"force": np.zeros(count)}, source="rows")


@pytest.fixture
def model() -> Model:
    return axis(name="bare", inertia=2.0)


def test_offset_is_of_half_a_sampling_step_of_the_slowest_recording(model: Model) -> None:
    offset = timed(model, [recorded(0.001), recorded(0.004)]).parameter(OFFSET)
    assert offset.value == 0.0
    assert offset.std == pytest.approx(0.004 / math.sqrt(12.0))
    assert (offset.lower, offset.upper) == pytest.approx((0.004 * EARLIEST, 0.004 * LATEST))
    assert offset.estimated


def test_gap_does_not_count_as_a_sampling_step(model: Model) -> None:
    """A gap of 10 s among sampling steps of 1 ms."""
    whole = recorded(0.001, 9)
    late = whole.timestamp_ns + np.where(np.arange(9) > 4, 10_000_000_000, 0)
    gap = Recording(whole.channels, late, whole.values, source="gap")
    assert timed(model, [gap]).parameter(OFFSET).std == pytest.approx(0.001 / math.sqrt(12.0))


def test_model_that_states_the_time_of_its_inputs_is_unchanged(model: Model) -> None:
    named = replace(model, base_parameters=(*model.base_parameters, Parameter(OFFSET, "N", 0.0)))
    for stated in (library.get("monocab_roll"), library.get("twsbr"), model.add("input_delay"), named):
        assert timed(stated, [recorded(0.004)]) is stated


def test_recording_of_one_sample_gives_no_offset(model: Model) -> None:
    assert timed(model, [recorded(0.004, 1)]) is model


def test_estimates_are_kept_and_the_offset_is_removed(model: Model) -> None:
    extended = timed(model, [recorded(0.004)]).add("coulomb_friction")
    fitted = extended.change({"inertia": 3.0, OFFSET: 0.001, "coulomb_friction.torque": 0.5})
    assert untimed(model, fitted) == model.add("coulomb_friction").change(
        {"inertia": 3.0, "coulomb_friction.torque": 0.5}
    )
