"""Numbers for people have two digits of their standard deviation, and one unit with one power of ten."""

from __future__ import annotations

import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from watched import chromium

from upright.estimators.numbers import about, common, with_error

CASES = [
    (0.032, 0.0012, "N m", "0.0320 ± 0.0012 N m"),
    (1612.3, 148.0, "N m", "1.61 ± 0.15 kN m"),
    (-1612.3, 148.0, "N m", "-1.61 ± 0.15 kN m"),
    (1650.4, 12.4, "kg m^2", "1650 ± 12 kg m^2"),
    (1650.4, 124.0, "kg m^2", "(1.65 ± 0.12) × 10^3 kg m^2"),
    (14512.0, 99.4, "N m/rad", "14512 ± 99 N m/rad"),
    (14512.0, 99.6, "N m/rad", "14.51 ± 0.10 kN m/rad"),
    (2.74e-6, 3.2e-7, "kg m^2", "(2.74 ± 0.32) × 10^-6 kg m^2"),
    (0.00318, 4.4e-5, "s", "3.180 ± 0.044 ms"),
    (3e-4, 3e-5, "s", "300 ± 30 µs"),
    (0.0, 3e-4, "rad", "0.00 ± 0.30 mrad"),
    (0.5, 150.0, "N", "0.00 ± 0.15 kN"),
    (5400.0, 320.0, "s", "(5.40 ± 0.32) × 10^3 s"),
    (8.13, 0.41, "1", "8.13 ± 0.41"),
    (0.0996, 0.0996, "m", "0.10 ± 0.10 m"),
    (3300.0, 0.0, "N m s", "3300 N m s"),
    (3300.0, None, "N m s", "3300 N m s"),
    (0.0004, math.inf, "m", "400 µm"),
    (2.5e6, None, "1", "2.5 × 10^6"),
    (0.0, None, "m", "0 m"),
]


@pytest.mark.parametrize(("value", "std", "unit", "shown"), CASES)
def test_value_and_deviation_share_digits_and_unit(value: float, std: float | None, unit: str, shown: str) -> None:
    assert with_error(value, std, unit) == shown


@given(st.floats(1e-11, 1e8), st.floats(-6.0, 6.0), st.sampled_from(["N m", "kg m^2", "s", "1"]))
def test_nothing_is_lost_but_digits_below_the_second_of_the_deviation(std: float, ratio: float, unit: str) -> None:
    value = std * ratio
    found = common([(value, std)], unit)
    first, second = (float(each) * 10.0**found.power for each in found.pair(value, std))
    assert second == pytest.approx(std, rel=0.05)
    assert abs(first - value) <= 0.051 * std
    assert len(found.pair(value, std)[1].replace(".", "").lstrip("0")) == 2


@pytest.mark.browser
def test_the_dashboard_writes_numbers_by_the_same_rule() -> None:
    """Its module in a real browser, with superscripts in units."""
    source = (Path(__file__).parents[2] / "service" / "dashboard" / "static" / "numbers.js").read_text(encoding="utf-8")
    known = [(value, std if std is None or math.isfinite(std) else None, unit) for value, std, unit, _ in CASES]
    with chromium() as browser:
        shown = browser.new_page().evaluate(RUN, [source, known])
    assert shown == [re.sub(r"\^(-?\d+)", lambda power: power[1].translate(SUPERSCRIPT), text) for *_, text in CASES]


SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
RUN = """async ([source, cases]) => {
  const { plusMinus } = await import("data:text/javascript;charset=utf-8," + encodeURIComponent(source));
  return cases.map((each) => plusMinus(...each));
}"""


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [(134.6, "N m s/rad", "130 N m s/rad"), (3.5e5, "N m/rad^3", "350 kN m/rad^3"), (7.54e-5, "rad", "75 µrad")],
)
def test_size_that_is_known_roughly_has_two_digits_and_no_exponent(value: float, unit: str, shown: str) -> None:
    assert about(value, unit) == shown


def test_column_has_one_power_of_ten_for_all_of_its_values() -> None:
    column = common([(2.74e-6, 3.2e-7), (None, None), (3.1e-5, 1e-6)], "kg m^2")
    assert column.unit == "10^-6 kg m^2"
    assert column.text(2.74e-6, 3.2e-7) == "2.74 ± 0.32"
    assert column.text(3.1e-5, 1e-6) == "31.0 ± 1.0"
    assert column.text(None) == "-"
    assert column.text(5e-6) == "5"
