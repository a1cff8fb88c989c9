"""Documents of others: whatever is wrong with one, it is a ValueError, and at once."""

from __future__ import annotations

import pytest

from upright.telemetry.documents import DEEPEST, from_json, from_toml


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, "[1", "9" * 5000, b"\xff"])
def test_json_that_is_none_is_a_value_error(text: str | bytes) -> None:
    with pytest.raises(ValueError):
        from_json(text)


@pytest.mark.parametrize(
    "text",
    [
        "a." * 20_000 + "b = 1",
        "[" + "a." * 5000 + "b]",
        "x = { " + '"a" . ' * 1000 + "b = 1 }",
        "a = " + "[" * 5000 + "]" * 5000,
        "a = { " + "b = { " * 2000 + "}" * 2001,
        "a = " + "9" * 5000,
        "a = 1979-13-01",
    ],
)
@pytest.mark.timeout(20)
def test_toml_that_is_none_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError):
        from_toml(text)


def test_line_of_a_deep_name_is_stated() -> None:
    with pytest.raises(ValueError, match="at line 3"):
        from_toml("a = 1\nb = 2\n" + "c." * DEEPEST + "d = 3\n")


def test_documents_are_read_as_they_are() -> None:
    names = ".".join("a" * DEEPEST)
    assert from_json(memoryview(b'{"a": [1, 2.5, null]}')) == {"a": [1, 2.5, None]}
    assert from_toml('a = [0.5, 1.5]\n[b]\nc = "1.2.3"\n') == {"a": [0.5, 1.5], "b": {"c": "1.2.3"}}
    assert from_toml(f"{names} = 1")
    assert from_toml("x = [" + "0.1, " * 5000 + "]")
