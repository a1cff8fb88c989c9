"""The random parts beside the first-order disturbance: how they are made, estimated and told apart from effects."""

from __future__ import annotations

import math

import numpy as np
import pytest

from service.virtual_run import record
from simulation.hidden import MONOCAB, UnknownEffectError, parse_narrow_band
from simulation.narrow_band import NarrowBand, NarrowBandTorque

STEP = 1.0 / 3000.0
"""s, the plant's at 250 Hz."""
MOST = 4.0
"""Standard deviations of an estimate that a test allows: 6 of 100,000 seeds are beyond."""


# --- the virtual vehicle's


def test_it_has_its_rms_its_frequency_and_its_damping_ratio() -> None:
    """Its autocorrelation is rms^2 exp(-z w t) (cos(w' t) + z sin(w' t) w / w'), w' = w sqrt(1 - z^2); estimates over D
    s scatter as those of as many independent values as D z w / 2 at least."""
    band, duration = NarrowBand(4.0, 2.0, 0.05), 2000.0
    random = NarrowBandTorque(band, 0.01, 5)
    torque = np.array([random.torque(0.0) for _ in range(round(duration / 0.01))])
    turn, damping = 2.0 * math.pi * band.frequency, band.damping
    within = MOST / math.sqrt(0.5 * duration * damping * turn)
    assert float(np.std(torque)) == pytest.approx(band.rms, rel=within)
    assert abs(float(np.mean(torque))) < within * band.rms
    damped = turn * math.sqrt(1.0 - damping**2)
    for rows in (12, 25, 50, 100):
        lag = 0.01 * rows
        swing = math.cos(damped * lag) + damping * turn / damped * math.sin(damped * lag)
        expected = math.exp(-damping * turn * lag) * swing
        found = float(np.mean(torque[rows:] * torque[:-rows])) / band.rms**2
        assert found == pytest.approx(expected, abs=within)


def test_it_is_stationary_from_the_first_step_on_and_follows_from_the_seed() -> None:
    first = [NarrowBandTorque(NarrowBand(8.0, 2.0, 0.05), STEP, seed).torque(0.0) for seed in range(400)]
    assert math.sqrt(float(np.mean(np.square(first)))) == pytest.approx(8.0, rel=MOST * math.sqrt(0.5 / 400))
    assert NarrowBandTorque(NarrowBand(8.0, 2.0, 0.05), STEP, 7).torque(0.0) == first[7]


@pytest.mark.parametrize(
    ("argument", "expected"),
    [
        ("narrow_band", NarrowBand(4.0, 2.0, 0.05)),
        ("narrow_band=2", NarrowBand(8.0, 2.0, 0.05)),
        ("narrow_band=3,1.5,0.1@30", NarrowBand(3.0, 1.5, 0.1, onset=30.0)),
        ("narrow_band=0", None),
    ],
)
def test_it_is_asked_for_as_an_effect_is(argument: str, expected: NarrowBand | None) -> None:
    assert parse_narrow_band(["coulomb_friction=2", argument], MONOCAB) == (["coulomb_friction=2"], expected)


@pytest.mark.parametrize("argument", ["narrow_band=3,2", "narrow_band=-1,2,0.1", "narrow_band=3,2,1", "narrow_band=x"])
def test_one_that_cannot_be_is_refused_with_the_remedy(argument: str) -> None:
    with pytest.raises(UnknownEffectError, match=r"narrow_band=4,2,0\.05.*narrow_band=0 switches it off"):
        parse_narrow_band([argument])


@pytest.mark.parametrize(("vehicle", "channel"), [("monocab", "roll"), ("twsbr", "tilt")])
def test_it_shakes_the_virtual_vehicles(vehicle: str, channel: str) -> None:
    shaken, still = (record(vehicle, "hold", hide=hide, seed=3, duration=5.0) for hide in (["narrow_band"], []))
    assert not np.array_equal(shaken.values[channel], still.values[channel])
