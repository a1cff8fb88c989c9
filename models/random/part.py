"""Random signals as states of a model: first-order, or narrow-band about a frequency.

    x' = -x / time + w,    std^2 = q^2 time / 2
    x' = W v,    v' = -W x - 2 v / time + w,    W = 2 pi frequency,    std^2 = q^2 time / 4

w is white, of density q^2. The first (Ornstein-Uhlenbeck) has the correlation time `time` s and the stationary RMS
`std`. The second oscillates about its frequency and loses its phase within `time` s; its damping ratio is 1 / (W time),
and v has the same RMS. Source: Gelb, "Applied optimal estimation" (1974), section 3.8 (Gauss-Markov processes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from upright.models.parts import NarrowBand, Parameter, State

SPREAD = 3.0
"""Prior standard deviation of the natural logarithm of an RMS: only the order of magnitude of a random signal is known
in advance, to a factor of twenty."""
ROUGHLY = 10.0
"""Prior standard deviation of a correlation time, in multiples of the start of its estimation."""
LEAST_ROWS = 2.0
"""Sampling intervals in the shortest correlation time: a signal that decays faster is white."""
LEAST_TIMES = 10.0
"""Correlation times in a record, at least: the record does not show that a signal that decays more slowly is random,
and a mere drift is not."""
PERIODS = 1.0
"""Periods for which a narrow-band signal persists, at least: one that decays within a period has no frequency of its
own."""
MOST_DAMPED = 1.0 / (2.0 * math.pi * PERIODS)
"""The damping ratio of a signal that persists for PERIODS."""


@dataclass(frozen=True, slots=True)
class RandomPart:
    """The states of a random signal and their parameters; `shown` is its expression in terms of them."""

    states: tuple[State, ...]
    parameters: tuple[Parameter, ...]
    shown: str


def first_order(
    name: str, unit: str, meaning: str, std: float, time: float, bounds: tuple[float, float] | None
) -> RandomPart:
    """A first-order signal. Its estimation starts at an RMS of `std`, unit, and a correlation time of `time`, s, which
    is estimated within `bounds`; without bounds both are known."""
    known = bounds is None
    lower, upper = bounds or (0.0, math.inf)
    state = State(
        name=name,
        unit=unit,
        derivative=f"-{name} / {name}_time",
        initial_std=std,
        process_noise=std * math.sqrt(2.0 / time),
        noise_known=known,
        noise_spread=SPREAD,
        correlation_time=f"{name}_time",
        meaning=meaning,
    )
    parameter = Parameter(
        name=f"{name}_time",
        unit="s",
        value=time,
        std=0.0 if known else ROUGHLY * time,
        lower=lower,
        upper=upper,
        estimated=not known,
        meaning=f"correlation time of {name}",
    )
    return RandomPart((state,), (parameter,), name)


def narrow_band(name: str, unit: str, meaning: str, known: NarrowBand, longest: float) -> RandomPart:
    """A narrow-band signal with the prior knowledge `known`, for a record of `longest` s or, if that is 0, for one that
    goes on."""
    lead, about, time = f"{name}_lead", f"{name}_frequency", f"{name}_time"
    shortest = PERIODS / known.frequency
    stated = MOST_DAMPED * shortest / known.damping_ratio if known.damping_ratio else 0.0
    most = max(longest / LEAST_TIMES if longest else stated * LEAST_TIMES, 2.0 * shortest)
    lasting = min(stated, most) or math.sqrt(shortest * most)
    turn = f"{2.0 * math.pi!r} * {about}"
    swinging = State(
        name=name,
        unit=unit,
        derivative=f"{turn} * {lead}",
        initial_std=known.std,
        correlation_time=time,
        frequency=about,
        driven_by=lead,
        meaning=meaning,
    )
    leading = replace(
        swinging,
        name=lead,
        derivative=f"-{turn} * {name} - 2.0 * {lead} / {time}",
        process_noise=2.0 * known.std / math.sqrt(lasting),
        noise_spread=SPREAD,
        driven_by="",
        meaning="the same, a quarter of a period ahead",
    )
    frequency = known.frequency
    parameters = (
        Parameter(about, "Hz", frequency, std=frequency, lower=0.0, meaning=f"centre frequency of {name}"),
        Parameter(
            time, "s", lasting, std=ROUGHLY * lasting, lower=shortest, upper=most, meaning=f"correlation time of {name}"
        ),
    )
    return RandomPart((swinging, leading), parameters, name)
