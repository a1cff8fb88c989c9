"""One small model that uses every feature of a pass, and data for it.

Held and measured inputs, delays, lags, terms in time, and outputs that contain inputs.
"""

from __future__ import annotations

import numpy as np

from upright.models.model import Model
from upright.models.parts import Hold, Input, Output, Parameter, State
from upright.models.segment import Segment

PLANT = Model(
    name="test-plant",
    title="a mass on a hardening spring with friction, pushed by a command, a motor and the wind",
    base_states=(
        State("x", "m", "v"),
        State("v", "m/s", "(push + motor + wind - k * x - x**3 - c * v - f * tanh(v / 0.2) + sin(3 * time)) / m"),
        State("z", "m", "(x - z) / 0.3 + 0.02 * seen_slope"),
    ),
    inputs=(
        Input("push", "N", Hold.ZERO_ORDER, delays=("push_delay", "both_delay")),
        Input("motor", "N", Hold.ZERO_ORDER, delays=("both_delay",), lag="motor_lag"),
        Input("wind", "N", Hold.CUBIC, delays=("wind_delay",), lag="wind_lag"),
        Input("seen", "N", Hold.CUBIC, delays=("seen_delay",)),
    ),
    outputs=(
        Output("position", "m", "x + 0.1 * z + 0.01 * seen_slope", noise=0.01),
        Output("rate", "m/s", "v * m + 0.3 * wind + 0.2 * seen", noise=0.01),
    ),
    base_parameters=(
        Parameter("m", "kg", 0.7),
        Parameter("k", "N/m", 20.0),
        Parameter("c", "N s/m", 0.6),
        Parameter("f", "N", 0.8),
        *(Parameter(f"{name}_delay", "s", 0.0) for name in ("push", "both", "wind", "seen")),
        *(Parameter(f"{name}_lag", "s", 0.0) for name in ("motor", "wind")),
    ),
)
INITIAL = np.array([0.2, -0.4, 0.1])
GAIN = np.array([[0.2, 0.01], [0.5, 0.3], [0.0, 0.1]])
ROWS = 150
SHIFTED = {"push_delay": 0.0034, "both_delay": 0.0021, "wind_delay": 0.0057, "seen_delay": 0.0042}


def segment(*, regular: bool = False, rows: int = ROWS) -> Segment:
    """Samples 1/128 s apart, whose sums are exact; unless `regular`, with jitter and inputs sampled in between."""
    source = np.random.default_rng(2)  # no two times are closer than the step of the differences
    time = np.arange(rows) / 128.0
    knots = np.repeat(time[:, None], len(PLANT.inputs), axis=1)
    knots[:, 1] -= 0.003  # no two inputs change at the same time: their order would matter
    if not regular:
        time = time + source.uniform(-2e-3, 2e-3, rows)
        knots = knots - source.uniform(0.0, 4e-3, knots.shape)
    held = np.repeat(source.uniform(-5.0, 5.0, (rows // 3 + 1, 2)), 3, axis=0)[:rows]
    smooth = 3.0 * np.sin(np.outer(time, (11.0, 7.0)) + np.array([0.0, 1.0]))
    measured = 0.3 * np.sin(np.outer(time, (5.0, 5.0))) + source.normal(0.0, 0.05, (rows, 2))
    return Segment(time, knots, np.column_stack((held, smooth)), measured)
