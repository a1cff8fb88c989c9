"""What the product does not do yet, as measured: MONOCAB, while it excites, in the first experiment of each fault.

An entry is an expected failure of `test_faults`, and has to be removed when the product does what is expected.
"""

from __future__ import annotations

SHORTFALLS: dict[str, str] = {}
