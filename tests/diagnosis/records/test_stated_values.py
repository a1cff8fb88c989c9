"""What a model states of its parameters, with a ±, and is wrong: named, and not taken for an effect."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pendulum_plant import INERTIA, STIFFNESS
from test_own_machine import MANUAL, MISSING, diagnosed

from upright.diagnosis.evidence import LEVEL
from upright.diagnosis.findings import Diagnosis, Verdict
from upright.diagnosis.fits.stated_values import Contradiction, stated_wrong
from upright.diagnosis.parts import merged
from upright.diagnosis.report.sentences import contradiction_sentences
from upright.diagnosis.report.words import next_step
from upright.models.parts import Parameter

RIGHT = f"inertia 0.6 0.02, stiffness {STIFFNESS} 0.1, motor_constant 0.3 0.02"
WITHIN = 3.0
"""Allowed error of a value, in its standard deviations."""


def stating(folder: Path, statements: str) -> Path:
    """The first model of the manual with other statements: `inertia 0.5 0.01, ...` are name, value and ±."""
    text = re.findall(r"^```toml\n(.*?)^```", MANUAL.read_text(), re.DOTALL | re.MULTILINE)[0]
    for name, value, std in (each.split() for each in statements.split(", ")):
        text, count = re.subn(rf"({name} = .*?value = )[\d.]+, std = [\d.]+", rf"\g<1>{value}, std = {std}", text)
        assert count == 1
    path = folder / "pendulum.toml"
    path.write_text(text)
    return path


def test_the_one_wrong_value_is_named_and_not_those_that_it_pulls(tmp_path: Path) -> None:
    model = stating(tmp_path, RIGHT.replace("inertia 0.6 0.02", "inertia 0.5 0.01"))
    found = diagnosed(model, tmp_path)
    assert found["verdict"] == "adequate", found["reason"]
    (wrong,) = found["contradicted"]
    assert (wrong["parameter"], wrong["stated"], wrong["stated_std"]) == ("inertia", 0.5, 0.01)
    assert abs(wrong["value"] - INERTIA) < WITHIN * wrong["std"]
    assert not wrong["instead_of"]


def test_right_values_are_not_contradicted(tmp_path: Path) -> None:
    found = diagnosed(stating(tmp_path, RIGHT), tmp_path)
    assert (found["verdict"], found["contradicted"]) == ("adequate", [])
    found = diagnosed(stating(tmp_path, RIGHT), tmp_path, MISSING["viscous_friction"][0])
    assert [each["effect"] for each in found["findings"]] == ["viscous_friction"]
    assert found["contradicted"] == []


def test_an_effect_that_only_wrong_values_need_is_a_question(tmp_path: Path) -> None:
    """Inertia and stiffness are stated a fifth too small: the same motion as with a motor that is a fifth too weak."""
    model = stating(tmp_path, "inertia 0.5 0.005, stiffness 9.274 0.05, motor_constant 0.3 0.001")
    found = diagnosed(model, tmp_path)
    assert [each["effect"] for each in found["findings"]] == ["input_gain"]
    wrong = {each["parameter"]: each for each in found["contradicted"]}
    assert set(wrong) == {"inertia", "stiffness"}
    for name, true in (("inertia", INERTIA), ("stiffness", STIFFNESS)):
        assert abs(wrong[name]["value"] - true) < WITHIN * wrong[name]["std"]
        assert wrong[name]["instead_of"] == ["input_gain"]


def test_sentence_asks_which_of_the_two_it_is() -> None:
    wrong = Contradiction("inertia", "kg m^2", 0.5, 0.01, 0.62, 0.005, ("input_gain",))
    asked = Diagnosis(Verdict.MISSING_EFFECT, "", contradicted=(wrong,))
    assert next_step(asked).startswith("Correct the stated values")
    assert contradiction_sentences(asked) == (
        "Are the stated values right? The recordings contradict some of them, and need input_gain only if they are"
        " right. Without input_gain, inertia is stated as 0.500 ± 0.010 kg m^2, and 0.6200 ± 0.0050 kg m^2 fits."
    )
    assert contradiction_sentences(Diagnosis(Verdict.ADEQUATE, "")) == ""


def test_contradictions_of_both_parts_are_said_once() -> None:
    vehicle, drive = (Contradiction(name, "1", 1.0, 0.01, 2.0, 0.01) for name in ("inertia", "lag"))
    whole = merged(*(Diagnosis(Verdict.ADEQUATE, "", contradicted=(each,)) for each in (vehicle, drive)), ())
    assert whole.contradicted == (vehicle, drive)
    assert contradiction_sentences(whole).count("is stated as") == 2


STDS = np.array([0.1, 0.5, 1.0, 2.0])
NOISE = 0.05


def called_wrong(columns: np.ndarray, seen: np.ndarray) -> list[str]:
    """Which of four parameters, stated as 0 ± STDS, are called wrong if `columns` (n, 4) times them, with NOISE, is
    `seen` (n,)."""
    information = columns.T @ columns / NOISE**2 + np.diag(STDS**-2.0)
    estimate = np.linalg.solve(information, columns.T @ seen / NOISE**2)
    parameters = [Parameter(f"p{place}", "1", 0.0, std) for place, std in enumerate(STDS)]
    minimum = SimpleNamespace(information=information, common=estimate)
    problem = SimpleNamespace(parameters=parameters, start=np.zeros(4))
    fit = SimpleNamespace(problem=problem, minimum=minimum)
    fitted: Any = SimpleNamespace(fit=fit, model=SimpleNamespace(base_states=()))
    return [each.name for each in stated_wrong(fitted, {each.name for each in parameters})]


def test_right_values_are_called_wrong_in_a_hundredth_of_records() -> None:
    """Three sums of four parameters: 10,000 records."""
    random = np.random.default_rng(5)
    columns, called = random.standard_normal((3, 4)), 0
    for _ in range(10_000):
        true = STDS * random.standard_normal(4)
        called += bool(called_wrong(columns, columns @ true + NOISE * random.standard_normal(3)))
    assert 0.3 * LEVEL < called / 10_000 < 1.2 * LEVEL


@pytest.mark.parametrize("wrong", range(4))
def test_wrong_value_is_found_among_right_ones(wrong: int) -> None:
    columns = np.random.default_rng(6).standard_normal((6, 4))
    true = np.where(np.arange(4) == wrong, 12.0 * STDS, 0.5 * STDS)
    assert called_wrong(columns, columns @ true) == [f"p{wrong}"]
