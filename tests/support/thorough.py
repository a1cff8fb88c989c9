"""Cases that `make test` leaves to `make thorough-test`: the same tests of further effects, amplitudes and records."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TypeVar

import pytest

Case = TypeVar("Case")


def of_many(cases: Iterable[Case], *always: Case) -> list[object]:
    """All `cases` to parametrise a test with. `make test` runs only those in `always`."""
    found = list(cases)
    assert all(each in found for each in always)
    return [each if each in always else _thorough(each) for each in found]


def _thorough(case: object) -> object:
    values = case if isinstance(case, tuple) else (case,)
    return pytest.param(*values, marks=pytest.mark.thorough)
