"""Inputs made from valid ones: bits, bytes, parts and numbers changed, lines and values of texts exchanged."""

from __future__ import annotations

import struct
from collections.abc import Sequence

from hypothesis import strategies as st

NUMBERS = (
    *(
        struct.pack("<I", value)
        for value in (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)
    ),
    *(struct.pack("<q", value) for value in (-1, 2**31, 2**32, 2**62, 2**63 - 1, -(2**63))),
    *(struct.pack("<f", value) for value in (float("nan"), float("inf"), -float("inf"), 3e38, 1e-45)),
    *(struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e308, 5e-324)),
)
"""Lengths, counts and values at the ends of their ranges."""
LONGEST = 1 << 20
"""Bytes that an input may grow to."""
EDITS = ("flip", "flip", "overwrite", "insert", "delete", "duplicate", "repeat", "cut", "token", "token")


@st.composite
def mutated(
    draw: st.DrawFn, seeds: Sequence[bytes], tokens: Sequence[bytes] = NUMBERS, most: int = 8, head: int = 0
) -> bytes:
    """One of the `seeds` with up to `most` edits, `tokens` among them; in its first `head` bytes alone if given."""
    data = bytearray(draw(st.sampled_from(seeds)))
    for _ in range(draw(st.integers(0, most))):
        end = min(len(data), head or len(data))
        place = draw(st.integers(0, end))
        match draw(st.sampled_from(EDITS)):
            case "flip" if place < len(data):
                data[place] ^= 1 << draw(st.integers(0, 7))
            case "overwrite":
                new = draw(st.binary(min_size=1, max_size=8))
                data[place : place + len(new)] = new
            case "insert":
                data[place:place] = draw(st.binary(min_size=1, max_size=16))
            case "delete":
                del data[place : place + draw(st.sampled_from((1, 2, 4, 16, 100)))]
            case "duplicate":
                other = draw(st.integers(0, end))
                data[place:place] = data[other : other + draw(st.sampled_from((1, 8, 64, 1000)))]
            case "repeat" if len(data) < LONGEST:
                part = data[place : place + draw(st.integers(1, 8))]
                data[place:place] = part * draw(st.sampled_from((2, 10, 100, 10_000)))
            case "cut":
                del data[place:]
            case "token":
                new = draw(st.sampled_from(tokens))
                data[place : place + (len(new) if draw(st.booleans()) else 0)] = new
    return bytes(data[:LONGEST])


@st.composite
def exchanged(draw: st.DrawFn, seeds: Sequence[bytes], values: Sequence[bytes], separator: bytes = b"=") -> bytes:
    """A text of lines `key = value` with some values replaced, and lines doubled, left out or moved."""
    lines = draw(st.sampled_from(seeds)).split(b"\n")
    for _ in range(draw(st.integers(1, 5))):
        place = draw(st.integers(0, len(lines) - 1))
        match draw(st.sampled_from(("value", "value", "value", "value", "double", "leave out", "move"))):
            case "value":
                key, found, _ = lines[place].partition(separator)
                if found:
                    lines[place] = key + separator + b" " + draw(st.sampled_from(values))
            case "double":
                lines.insert(draw(st.integers(0, len(lines))), lines[place])
            case "leave out" if len(lines) > 1:
                del lines[place]
            case "move":
                lines.insert(draw(st.integers(0, len(lines) - 1)), lines.pop(place))
    return b"\n".join(lines)


def anything(seeds: Sequence[bytes], tokens: Sequence[bytes] = NUMBERS, head: int = 0) -> st.SearchStrategy[bytes]:
    """Mostly mutated seeds, in their `head` too, and now and then bytes of no kind."""
    near = (
        [mutated(seeds, tokens), mutated(seeds, (*tokens, *NUMBERS), head=head)] if head else [mutated(seeds, tokens)]
    )
    return st.one_of(*near, *near, *near, st.binary(max_size=2000))
