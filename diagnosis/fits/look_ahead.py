"""Non-causal fits: fits that use future samples to explain their sensors' noise, which no predictor can do.

A controller responds to the noise of its sensors, and the drives follow it. A model that is driven by the measured
motion of the drives interpolates it by a curve, whose slope at a sample depends on the next samples, too, or shifts it
by a time offset a part of a sample ahead. So the response to a sample's noise is available when this sample is
predicted, and an effect that uses derivatives of the input, such as the twist of a shaft, can reproduce that noise.
Such an effect explains more than the right one: 1,450 nats where dry friction explained 640.

The look-ahead share of an output is estimated from its readings y(k) and their predictions p(k): fourth differences of
both are taken, which leave hardly anything of the motion (estimators.data.white_noise), and

    d4 p(k) = sum of h_j d4 y(k - j), j = 0 .. LAGS

is solved by least squares. A predictor responds to the noise of earlier samples, by its gain and through the loop that
the drives close, so h_1, h_2, ... may have any value; h_0 is zero if the predictor does not know the sample yet. In ten
fits of a simulated vehicle with a noisy gyro that were right, or wrong but causal, it was 0.012 at most, and 0.36 to
0.55 in non-causal ones.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from upright.estimators.data.white_noise import differences
from upright.estimators.fit.maximum_likelihood import Fit
from upright.models.parts import Hold

Array = NDArray[np.float64]

LAGS = 12
"""Number of lags j: beyond, a predictor's response to the noise of a sample is smooth."""
LOOKED_AHEAD = 0.1
"""Share of a sample's noise above which a fit is non-causal."""
DEVIATIONS = 4.0
"""Standard deviations of that share by which it has to differ from zero."""


def looks_ahead(fitted: Fit, base: Fit) -> bool:
    """Whether `fitted` is non-causal in any output whose noise is estimated, and `base` is not.

    Commands do not follow the noise before they are given, so only measured inputs with an estimated time offset count.
    If even `base` seems to predict some of the fourth differences, these are motion, and no statement is made.
    """
    model = fitted.problem.model
    if not any(each.hold is Hold.CUBIC and each.delays for each in model.inputs):
        return False
    measured = [place for place, each in enumerate(model.outputs) if not (each.noise_known or each.counted)]
    return any(_significant(fitted, place) and not _significant(base, place) for place in measured)


def _significant(fitted: Fit, output: int) -> bool:
    share, std = look_ahead_share(fitted, output)
    return share > max(LOOKED_AHEAD, DEVIATIONS * std)


def look_ahead_share(fitted: Fit, output: int) -> tuple[float, float]:
    """h_0 of an output, and its standard deviation; zero and infinity if there are too few samples."""
    rows, targets = [], []
    for segment, errors in zip(fitted.problem.segments, fitted.innovations(), strict=True):
        read = segment.measured[:, output]
        noise, predicted = differences(read), differences(read - errors[:, output])
        if len(noise) <= LAGS:
            continue
        now = np.lib.stride_tricks.sliding_window_view(noise, LAGS + 1)[:, ::-1]
        then = predicted[LAGS:]
        known = np.isfinite(now).all(axis=1) & np.isfinite(then)
        rows.append(now[known])
        targets.append(then[known])
    if sum(map(len, rows)) < 10 * LAGS:
        return 0.0, float("inf")
    answers, target = np.concatenate(rows), np.concatenate(targets)
    found, *_ = np.linalg.lstsq(answers, target, rcond=None)
    left = target - answers @ found
    # Differences of neighbouring samples share readings: the residual is not white, and counts as a fifth as many
    # samples.
    variance = 5.0 * float(left @ left) / len(target)
    return float(found[0]), float(np.sqrt(variance * np.linalg.inv(answers.T @ answers)[0, 0]))
