"""A trial that fails is a candidate that failed: what may end a fit, and how a diagnosis goes on without it.

A model with one more effect may diverge, produce a singular matrix, or end at an invalid estimate. Each of these is a
result for that effect alone. A programming error is not, and is not caught here.
"""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import TypeVar

import numpy as np

from upright.estimators.budget import OutOfTime
from upright.estimators.contract import EstimationError

Answer = TypeVar("Answer")

FAILURES = (ArithmeticError, np.linalg.LinAlgError, EstimationError)
"""What the fit of a model that does not match the record raises: the model diverges or overflows (ArithmeticError), a
matrix to be inverted is singular or not finite, or the start and the bounds contradict each other."""


def tried(work: Callable[[], Answer], name: str = "", failed: MutableMapping[str, str] | None = None) -> Answer | None:
    """The result of `work`, None if it fails: then `failed` has the reason under `name`, until it works.

    Running out of time is not a failure of one trial, and is raised.
    """
    try:
        found = work()
    except OutOfTime:
        raise
    except FAILURES as error:
        if failed is not None:
            failed[name] = f"its fit fails: {error}"
        return None
    if failed is not None:
        failed.pop(name, None)
    return found
