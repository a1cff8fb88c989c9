"""Line spectra: the optimum against theory and against every other choice, and phases with low peaks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from upright.diagnosis.prediction.line_spectrum import CREST, Lines, phases, power

FREQUENCY = np.arange(1, 21) / 10.0


def second_order(still: float = 1e-13) -> Lines:
    """Of a mass and a spring, m and k: y = u / (k - m omega^2) has the derivatives -y / (k - m omega^2) and
    omega^2 y / (k - m omega^2); what is limited is the force u alone."""
    omega2 = (2.0 * np.pi * FREQUENCY) ** 2
    dynamic = 30.0 - 1.0 * omega2 + 2.0j * np.sqrt(omega2)
    slopes = np.stack([omega2 / dynamic**2, -1.0 / dynamic**2], axis=1)
    matrices = 0.5 * np.einsum("fi,fj->fij", slopes, slopes.conj()).real
    return Lines(FREQUENCY, still * np.eye(2), matrices, np.ones((1, len(FREQUENCY)), dtype=complex), 10.0)


def log_determinant(lines: Lines, p: np.ndarray, about: list[int]) -> float:
    covariance = np.linalg.inv(lines.still + np.tensordot(p, lines.lines, axes=1))
    return float(np.linalg.slogdet(covariance[np.ix_(about, about)])[1])


@pytest.mark.parametrize("about", [[0, 1], [0], [1]])
def test_no_other_spectrum_within_the_limit_is_better(about: list[int]) -> None:
    lines = second_order()
    best = power(lines, about)
    limit = 0.5 * CREST**2
    assert limit * np.sum(best) == pytest.approx(1.0, rel=1e-3)
    least = log_determinant(lines, best, about)
    random = np.random.default_rng(1)
    for _ in range(300):
        other = random.dirichlet(np.full(len(FREQUENCY), 0.2)) / limit
        assert log_determinant(lines, other, about) >= least - 1e-4
    # The equivalence theorem (Kiefer and Wolfowitz, 1960): for all parameters, no line has a dispersion above their
    # number, and those in use have just that.
    if about == [0, 1]:
        information = lines.still + np.tensordot(best, lines.lines, axes=1)
        dispersion = np.einsum("ij,fji->f", np.linalg.inv(information), lines.lines) / limit
        assert np.max(dispersion) == pytest.approx(2.0, rel=5e-3)
        np.testing.assert_allclose(dispersion[best > 0.0], 2.0, rtol=2e-2)


def test_few_lines_suffice_for_two_parameters() -> None:
    """No more than p (p + 1) / 2 lines are needed (Caratheodory)."""
    assert 1 <= np.count_nonzero(power(second_order(), [0, 1])) <= 3


def test_channel_that_resonates_gets_less() -> None:
    lines = second_order()
    resonant = np.abs(1.0 / (30.0 - (2.0 * np.pi * FREQUENCY) ** 2 + 1.0j * FREQUENCY)) * 300.0
    both = Lines(lines.frequency, lines.still, lines.lines, np.vstack([lines.transfer, resonant.astype(complex)]), 10.0)
    best = power(both, [0, 1])
    used = 0.5 * CREST**2 * np.abs(both.transfer) ** 2 @ best
    assert np.max(used) == pytest.approx(1.0, rel=1e-3)
    assert log_determinant(lines, best, [0, 1]) > log_determinant(lines, power(lines, [0, 1]), [0, 1])


class TestPhases:
    def lines(self) -> Lines:
        frequency = np.arange(1, 25) / 30.0
        return Lines(frequency, np.eye(1), np.ones((24, 1, 1)), np.ones((1, 24), dtype=complex), 30.0)

    def test_peak_is_below_that_of_schroeders_phases(self) -> None:
        lines, amplitude = self.lines(), np.ones(24)
        turned, peak = phases(lines, amplitude)
        k = np.arange(1, 25)
        time = np.arange(0.0, 30.0, 1e-2)
        waves = {
            name: np.cos(2.0 * np.pi * np.outer(time, lines.frequency) + each).sum(axis=1)
            for name, each in (("ours", turned), ("schroeder", -np.pi * k * (k - 1) / 24))
        }
        crest = {name: float(np.max(np.abs(wave)) / np.std(wave)) for name, wave in waves.items()}
        assert crest["schroeder"] > 1.6
        assert crest["ours"] < 1.5
        assert peak == pytest.approx(np.max(np.abs(waves["ours"])), rel=0.02)

    def test_channel_closest_to_its_limit_decides(self) -> None:
        alone = self.lines()
        loud = replace(alone, transfer=np.vstack([alone.transfer, 5.0j * alone.transfer]))
        _, peak = phases(loud, np.ones(24))
        assert 5.0 * 1.3 * np.sqrt(12.0) < peak < 5.0 * 1.7 * np.sqrt(12.0)

    def test_peak_is_that_of_the_whole_record(self) -> None:
        """Lines that lie 0.2 Hz apart need not repeat after 5 s."""
        frequency = np.array([11.0, 37.0, 43.0]) / 30.0
        lines = Lines(frequency, np.eye(1), np.ones((3, 1, 1)), np.ones((1, 3), dtype=complex), 30.0)
        turned, peak = phases(lines, np.ones(3))
        time = np.arange(0.0, 30.0, 1e-3)
        wave = np.cos(2.0 * np.pi * np.outer(time, frequency) + turned).sum(axis=1)
        assert peak == pytest.approx(np.max(np.abs(wave)), rel=0.02)
