"""The rule by which two methods part in a parameter."""

from __future__ import annotations

from typing import Any

import pytest

from upright.estimators.parting import SIGMAS, Parting, partings


def results(**values: tuple[float | None, float | None]) -> dict[str, Any]:
    """Results by method, each with one parameter of this value and standard deviation."""
    return {
        method: {"parameters": {"inertia": {"value": value, "std": std}}} for method, (value, std) in values.items()
    }


def test_difference_is_in_standard_deviations_of_the_difference() -> None:
    (found,) = partings(results(least_squares=(10.0, 0.3), output_error=(12.0, 0.4)))
    assert found == Parting("inertia", ("least_squares", "output_error"), pytest.approx(4.0))
    assert str(found) == (
        "inertia: least squares and output error part, by 4.0 standard deviations of their difference"
    )
    assert found.to_json()["methods"] == ["least_squares", "output_error"]
    assert found.to_json()["text"] == str(found)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_methods_part_beyond_the_limit_only(sign: float) -> None:
    assert not partings(results(a=(0.0, 3.0), b=(sign * SIGMAS * 5.0, 4.0)))
    assert partings(results(a=(0.0, 3.0), b=(sign * SIGMAS * 5.001, 4.0)))


def test_every_pair_is_compared_in_the_order_of_the_methods() -> None:
    found = partings(results(a=(0.0, 1.0), b=(10.0, 1.0), c=(10.5, 1.0)))
    assert [each.methods for each in found] == [("a", "b"), ("a", "c")]


@pytest.mark.parametrize("unknown", [(None, None), (10.0, None), (float("nan"), 1.0), (10.0, float("inf"))])
def test_estimate_without_value_or_deviation_is_not_compared(unknown: tuple[float | None, float | None]) -> None:
    assert not partings(results(a=(0.0, 0.1), b=unknown))


def test_two_values_without_any_scatter_are_not_compared() -> None:
    assert not partings(results(a=(0.0, 0.0), b=(1.0, 0.0)))


def test_method_without_parameters_is_passed_over() -> None:
    assert not partings({**results(a=(0.0, 1.0)), "b": {"parameters": {}, "status": "starting"}})
