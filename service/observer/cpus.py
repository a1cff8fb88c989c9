"""The processors of the helper processes (observer, raw log), apart from the one that control has.

A unit's CPUAffinity= holds for all its processes. Where it gives control a processor of its own, the drop-in also names
the others in $UPRIGHT_HELPER_CPUS, as in `0-2,4`, and each helper moves there when it starts.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping

VARIABLE = "UPRIGHT_HELPER_CPUS"


def leave_to_control(environment: Mapping[str, str] = os.environ) -> None:
    """Move this process to the processors in $UPRIGHT_HELPER_CPUS; if that is refused, say so and stay."""
    given = environment.get(VARIABLE, "")
    if not given:
        return
    try:
        os.sched_setaffinity(0, processors(given))
    except (OSError, ValueError) as error:
        print(f"{VARIABLE}={given}: {error}; this helper process stays on the processors of control", file=sys.stderr)


def processors(text: str) -> set[int]:
    """The numbers in a list such as `0-2,4`. Raises ValueError."""
    found: set[int] = set()
    for part in text.split(","):
        first, _, last = part.partition("-")
        found.update(range(int(first), int(last or first) + 1))
    return found
