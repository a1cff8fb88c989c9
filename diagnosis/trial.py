"""One trial that fails is a candidate that failed: what may end a fit, and how a diagnosis goes on without it.

A model with one more effect may run away, leave a matrix that has no inverse, or end where its own estimate is none.
All of these are answers, of that effect alone. A mistake in the program is none, and is not caught here.
"""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from typing import TypeVar

import numpy as np

from estimators.budget import OutOfTime
from estimators.contract import EstimationError

Answer = TypeVar("Answer")

FAILURES = (ArithmeticError, np.linalg.LinAlgError, EstimationError)
"""What the fit of a model that does not go with the record raises: it runs away or overflows (ArithmeticError), what is
to be inverted is singular or not finite, or its start and bounds contradict each other."""


def tried(work: Callable[[], Answer], name: str = "", failed: MutableMapping[str, str] | None = None) -> Answer | None:
    """What `work` gives, None where it fails: then `failed` has the reason under `name`, until it works.

    That the time is over is no failure of one trial, and is raised."""
    try:
        found = work()
    except OutOfTime:
        raise
    except FAILURES as error:
        if failed is not None:
            failed[name] = f"no fit with it ends: {error}"
        return None
    if failed is not None:
        failed.pop(name, None)
    return found
