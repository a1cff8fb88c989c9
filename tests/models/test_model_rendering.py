"""Models as text and LaTeX: the lines compute what the equations do, and every effect is named."""

from __future__ import annotations

import dataclasses
import random
import re

import pytest
import sympy
from model_files import OWN

from upright.models import library, rendering
from upright.models.compiler.fingerprint import fingerprint
from upright.models.file.model_file import parse
from upright.models.model import Model
from upright.models.text.expressions import number


@pytest.fixture(scope="module")
def crowded() -> Model:
    """A model with effects at every kind of place, also with states, and one that uses the load."""
    model = parse(OWN, "mine.toml").model
    for effect in (
        "flexible_mode", "static_torque", "coulomb_friction", "hysteresis", "cubic_stiffness",
        "input_gain", "input_deadband", "input_delay", "sensor_offset",
    ):  # fmt: skip
        model = model.add(effect)
    return model


def test_rendered_lines_compute_the_same_values_as_the_composed_equations(crowded: Model) -> None:
    from upright.models.compiler.equations import Magnitude, Signum, compose

    draw = random.Random(2)
    names = [each.name for each in (*crowded.states, *crowded.inputs, *crowded.parameters)]
    start = {"time": 0.7, "voltage_slope": 0.3, **{name: draw.uniform(0.1, 2.0) for name in names}}
    known, slopes, shown = {name.replace("@", "_at_"): value for name, value in start.items()}, {}, {}
    for line in rendering.equations(crowded):
        if line.kind in (rendering.Kind.DELAY, rendering.Kind.LAG):
            continue
        value = number(line.expression, known | {f"{name}_measured": value for name, value in shown.items()})
        target = {"derivative": slopes, "output": shown, "reading": shown}.get(line.kind, known)
        target[line.name] = value

    composed = compose(crowded)
    exact = {sympy.Symbol(name, real=True): value for name, value in start.items()}
    for parts, symbols, found in (
        (composed.derivatives, crowded.states, slopes),
        (composed.outputs, crowded.outputs, shown),
    ):
        for expression, part in zip(parts, symbols, strict=True):
            plain = expression.replace(Signum, sympy.sign).replace(Magnitude, sympy.Abs)
            assert found[part.name] == pytest.approx(float(plain.subs(exact)), rel=1e-9), part.name
    (delay,) = (line for line in rendering.equations(crowded) if line.kind is rendering.Kind.DELAY)
    assert delay.expression == " + ".join(composed.delays[0])


def test_sensors_on_an_actuator_include_the_backlash_twist() -> None:
    from upright.models.compiler.equations import compose

    robot = library.get("twsbr").add("backlash")
    composed = compose(robot)
    width, place, speed = (sympy.Symbol(f"backlash.{name}", real=True) for name in ("width", "place", "speed"))
    shown = {output.name: expression for output, expression in zip(robot.outputs, composed.outputs, strict=True)}
    for side in ("left", "right"):
        for output, ahead in ((f"{side}_wheel_angle", place), (f"{side}_wheel_rate", speed)):
            assert sympy.simplify(shown[output] - sympy.Symbol(output, real=True) - 0.5 * width * ahead) == 0
    assert {width, place} & shown["tilt_rate"].free_symbols == set()

    text = _squeezed(rendering.text(robot))
    assert "backlash_twist = 0.5 * backlash.width * backlash.place" in text
    assert "left_wheel_angle_measured := left_wheel_angle_measured + backlash_twist [backlash]" in text
    assert "right_wheel_rate_measured := right_wheel_rate_measured + backlash_twist' [backlash]" in text
    assert r"\dot{\mathrm{backlash}_{\mathrm{twist}}}" in rendering.latex(robot)


def test_sensors_without_an_actuator_omit_the_twist_and_change_the_fingerprint() -> None:
    robot = library.get("twsbr").add("backlash")
    loose = dataclasses.replace(robot, sensors=tuple(dataclasses.replace(each, actuator="") for each in robot.sensors))
    assert "backlash_twist" not in rendering.text(loose)
    assert fingerprint(loose) != fingerprint(robot)


def test_rendered_text_names_each_effect(crowded: Model) -> None:
    text = _squeezed(rendering.text(crowded))
    assert "pivot_force = pivot_load + static_torque + coulomb_friction" in text
    assert "coulomb_friction = -coulomb_friction.torque * tanh(rate / 0.001)" in text
    assert "pivot_load = torque - pull * sin(angle)" in text
    assert "voltage := voltage * (1 + input_gain.gain) [input_gain]" in text
    assert "angle_measured := angle_measured + sensor_offset.offset [sensor_offset]" in text
    assert "voltage is delayed by late + input_delay.delay" in text


def _squeezed(text: str) -> str:
    return re.sub(" +", " ", text)


def test_model_without_effects_is_rendered_as_written() -> None:
    assert rendering.text(library.get("axis")).splitlines() == [
        "axis_force        = force_gain * force",
        "position'         = rate",
        "rate'             = axis_force / inertia",
        "position_measured = position",
    ]


def test_effect_at_a_second_place_is_rendered_with_its_place(crowded: Model) -> None:
    second = dataclasses.replace(crowded.joints[0], name="elbow", load="0")
    model = dataclasses.replace(crowded, joints=(*crowded.joints, second)).add("coulomb_friction", "elbow")
    line = "coulomb_friction@elbow = -coulomb_friction@elbow.torque * tanh(rate / 0.001)"
    assert line in _squeezed(rendering.text(model))
    assert r"\mathrm{torque}_{\mathrm{coulomb\,friction\,at\,elbow}}" in rendering.latex(model)


def test_latex_is_well_formed(crowded: Model) -> None:
    latex = rendering.latex(crowded)
    assert latex.startswith("\\begin{align*}\n")
    assert latex.endswith("\n\\end{align*}")
    assert r"\dot{\mathrm{rate}} &= \frac{\mathrm{pivot}_{\mathrm{force}}}" in latex
    assert r"\dot{z_{\mathrm{hysteresis}}} &=" in latex
    assert "_at_" not in latex
    depth = 0
    for bracket in latex.replace(r"\{", "").replace(r"\}", ""):
        depth += {"{": 1, "}": -1}.get(bracket, 0)
        assert depth >= 0
    assert depth == 0
    assert latex.count(r"\left(") == latex.count(r"\right)")


def test_delayed_sensor_is_rendered_with_time_derivatives() -> None:
    late = library.get("monocab_reduced").add("sensor_delay")
    assert r"\ddot{\mathrm{roll}_{\mathrm{measured}}}" in rendering.latex(late)
    assert "roll_measured''" in rendering.text(late)
