"""Excitations: their spectra, bounds and smoothness, and the experiment sections that are refused."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from upright.vehicles.experiment.excitation import (
    Doublet,
    Excitation,
    ExcitationError,
    SineStream,
    Square,
    Sweep,
    make_excitation,
)
from upright.vehicles.file import ExperimentSection, load

SHIPPED = load("monocab").experiments
RATE = 250.0


def section(kind: str, **keys: Any) -> ExperimentSection:
    at = keys.pop("at", "controller_output")
    return ExperimentSection(
        title=kind,
        excitation=kind,
        at=at,
        **{"duration": 20.0, "amplitude": 0.1, **keys},  # type: ignore[arg-type]
    )


def sampled(excitation: Excitation, rate: float = RATE) -> np.ndarray:
    return np.array([excitation.value(k / rate) for k in range(round(excitation.duration * rate) + 1)])


@pytest.mark.parametrize("name", sorted(SHIPPED))
def test_shipped_excitations_start_and_end_at_zero_within_their_peak(name: str) -> None:
    excitation = make_excitation(SHIPPED[name], RATE)
    values = sampled(excitation, 1000.0)
    assert np.max(np.abs(values)) <= excitation.peak * (1.0 + 1e-9)
    for t in (-1.0, 0.0, excitation.duration, excitation.duration + 1.0):
        assert excitation.value(t) == 0.0
    # No jumps: the value changes by about a twentieth of the peak per millisecond at most.
    assert np.max(np.abs(np.diff(values))) <= 0.06 * excitation.peak
    if excitation.at != "rest" and excitation.peak:
        assert np.max(np.abs(values)) > 0.9 * excitation.peak


def test_amplitudes_in_degrees_reach_the_roll_reference_in_radians() -> None:
    excitation = make_excitation(SHIPPED["sweep"], RATE)
    assert excitation.at == "roll_reference"
    assert excitation.peak == pytest.approx(math.radians(SHIPPED["sweep"].amplitude_deg or 0.0))


def test_spectrum_gives_each_line_its_share_and_phase() -> None:
    lines = [(0.5, 1.0, 0.0), (1.0, 0.5, 90.0), (2.0, 0.25, -45.0)]
    excitation = make_excitation(section("multisine", spectrum=lines), RATE)
    times = np.arange(5.0, 15.0, 1.0 / RATE)  # whole periods, without the fades
    values = np.array([excitation.value(t) for t in times])
    found = [2.0 * np.mean(values * np.exp(-2j * np.pi * f * times)) for f, _, _ in lines]
    np.testing.assert_allclose(np.abs(found) / abs(found[0]), [1.0, 0.5, 0.25], rtol=1e-3)
    np.testing.assert_allclose(np.degrees(np.angle(found)), [0.0, 90.0, -45.0], atol=0.1)
    assert np.max(np.abs(sampled(excitation))) <= excitation.peak * (1.0 + 1e-9)


def test_only_a_multisine_has_a_spectrum() -> None:
    with pytest.raises(ValueError, match="only a multisine has a spectrum, not a square"):
        section("square", frequency=1.0, spectrum=[(1.0, 1.0, 0.0)])


def test_value_is_pure() -> None:
    excitation = make_excitation(SHIPPED["multisine"], RATE)
    assert excitation.value(7.3) == excitation.value(7.3)
    forwards = [excitation.value(t) for t in (1.0, 5.0, 9.0)]
    assert [excitation.value(t) for t in (9.0, 5.0, 1.0)] == forwards[::-1]


def test_sweep_spends_equal_time_in_each_octave_from_first_to_last_frequency() -> None:
    sweep = Sweep(0.5, 8.0, 40.0)
    t = np.arange(0.0, 40.0, 1e-4)
    values = np.array([sweep(x) for x in t])
    crossings = t[1:][(values[:-1] < 0.0) & (values[1:] >= 0.0)]
    frequency = 1.0 / np.diff(crossings)
    middle = 0.5 * (crossings[1:] + crossings[:-1])
    # The frequency changes within a period, at 0.5 Hz by 14 %; at the middle of the period the error is far smaller.
    expected = 0.5 * 16.0 ** (middle / 40.0)
    assert np.allclose(frequency, expected, rtol=0.01)
    assert frequency[0] < 0.62
    assert frequency[-1] > 7.8


def test_multisine_has_only_its_spectral_lines_and_a_low_crest_factor() -> None:
    excitation = make_excitation(SHIPPED["multisine"], RATE)
    n = round(excitation.duration * RATE)
    values = np.array([excitation.waveform(k / RATE) for k in range(n)])
    amplitude = np.abs(np.fft.rfft(values)) * 2.0 / n
    lines = np.flatnonzero(amplitude > 1e-9)
    assert len(lines) == 24
    frequency = lines / excitation.duration
    assert frequency[0] == pytest.approx(0.1)
    assert frequency[-1] == pytest.approx(3.0)
    assert np.ptp(amplitude[lines]) < 1e-9
    # Cosines in phase would give sqrt(2 * 24) = 6.9.
    assert 1.0 < excitation.crest_factor < 2.3


def test_sine_stream_plays_whole_periods_of_each_frequency() -> None:
    excitation = make_excitation(section("sine_stream", frequencies=[0.3, 0.7, 2.0], duration=30.0), RATE)
    stream = excitation.waveform
    assert isinstance(stream, SineStream)
    start = 0.0
    for frequency, end in zip(stream.frequencies, stream.ends, strict=True):
        periods = (end - start) * frequency
        assert periods == pytest.approx(round(periods))
        assert periods >= 1.0
        assert abs(stream(end - 1e-6)) < 1e-4
        assert stream(start + 0.25 / frequency) == pytest.approx(1.0)
        start = end
    assert excitation.duration == stream.ends[-1] <= 30.0


def test_doublet_has_zero_mean_and_is_repeated_with_opposite_sign() -> None:
    doublet = Doublet(0.4)
    t = np.arange(0.0, 8.0, 1e-3)
    values = np.array([doublet(x) for x in t])
    assert values[600] == 1.0
    assert values[1000] == -1.0
    assert values[4600] == -1.0
    assert values[5000] == 1.0
    assert abs(values[:4000].sum()) < 2.0
    assert not values[1300:4300].any()


def test_square_wave_is_at_full_amplitude_for_nine_tenths_of_the_time() -> None:
    square = Square(0.5)
    values = np.array([square(k * 1e-3) for k in range(4000)])
    assert np.mean(np.abs(values) == 1.0) == pytest.approx(0.9, abs=0.01)
    assert abs(values.mean()) < 1e-9
    assert square(0.5) == 1.0
    assert square(1.5) == -1.0


@pytest.mark.parametrize(
    ("kind", "keys", "key"),
    [
        ("sweep", {"start_frequency": 3.0, "stop_frequency": 0.1}, "stop_frequency"),
        ("sweep", {"start_frequency": 1.0, "stop_frequency": 40.0}, "stop_frequency"),
        ("sweep", {"start_frequency": 0.01, "stop_frequency": 1.0}, "duration"),
        ("multisine", {"start_frequency": 1.0, "stop_frequency": 2.0, "lines": 64}, "lines"),
        ("multisine", {"start_frequency": 2.0, "stop_frequency": 2.0, "lines": 4}, "stop_frequency"),
        ("square", {"frequency": 100.0}, "frequency"),
        ("square", {"frequency": 0.01}, "duration"),
        ("doublet", {"width": 6.0}, "duration"),
        ("doublet", {"width": 0.001}, "width"),
        ("sine_stream", {"frequencies": []}, "frequencies"),
        ("sine_stream", {"frequencies": [0.05, 1.0]}, "duration"),
        ("sine_stream", {"frequencies": [1.0, 60.0]}, "frequencies"),
    ],
)
def test_infeasible_excitation_is_refused_with_its_key_and_a_remedy(kind: str, keys: dict[str, Any], key: str) -> None:
    with pytest.raises(ExcitationError) as caught:
        make_excitation(section(kind, **keys), RATE)
    assert caught.value.key == key
    assert caught.value.remedy


def test_the_remedy_for_too_many_lines_works() -> None:
    keys: dict[str, Any] = {"start_frequency": 1.0, "stop_frequency": 2.0}
    with pytest.raises(ExcitationError, match="use 21 lines"):
        make_excitation(section("multisine", lines=64, **keys), RATE)
    assert make_excitation(section("multisine", lines=21, **keys), RATE).peak == 0.1


def test_hold_and_step_experiments_have_no_excitation_while_upright() -> None:
    for name in ("hold", "step"):
        excitation = make_excitation(SHIPPED[name], RATE)
        assert not sampled(excitation).any()
        assert excitation.crest_factor == math.inf
    assert make_excitation(SHIPPED["step"], RATE).peak == SHIPPED["step"].amplitude
