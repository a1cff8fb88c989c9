"""The baselines by name."""

from __future__ import annotations

from collections.abc import Mapping

from upright.service.hidden_effects.methods.answers import Method
from upright.service.hidden_effects.methods.exhaustive import exhaustive_bic
from upright.service.hidden_effects.methods.regressions import differentiate_sindy, smoother_stepwise

BASELINES: Mapping[str, Method] = {
    "differentiate_sindy": differentiate_sindy,
    "smoother_stepwise": smoother_stepwise,
    "exhaustive_bic": exhaustive_bic,
}
