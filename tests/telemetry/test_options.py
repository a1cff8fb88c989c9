"""What a recording does not state is said by options at the terminal, and by arguments in Python."""

from __future__ import annotations

import ast
import shlex
from pathlib import Path

import pytest

import upright
from upright.telemetry.options import Stated, assumed, in_python, mapped, option, statements
from upright.telemetry.tables.mapping import said_of

MANY: dict[str, Stated] = {"time": "ms", "angle": ["deg", "wrapped:360"], "Drehzahl ü": "rpm"}


def test_both_spellings_are_understood_alike() -> None:
    said = said_of((), statements(MANY))
    by_option = shlex.split(assumed({key: MANY[key] for key in ("time", "angle")}))
    assert by_option == ["--assume", "time=ms", "--assume", "angle=deg", "--assume", "angle=wrapped:360"]
    with in_python():
        name, _, argument = assumed(MANY).partition("=")
    assert name == "assume"
    assert said_of((), statements(ast.literal_eval(argument))) == said


def test_column_with_a_blank_is_quoted() -> None:
    assert mapped({"angle": "angle (1)"}) == "--map angle='angle (1)'"
    with in_python():
        assert mapped({"angle": "angle (1)"}) == 'columns={"angle": "angle (1)"}'


def test_a_single_statement_is_no_list() -> None:
    with in_python():
        assert assumed({"angle": ["deg"]}) == 'assume={"angle": "deg"}'


def test_python_ends_with_the_function_that_it_is_entered_by() -> None:
    @in_python()
    def called() -> str:
        raise ValueError(option("--model", "model="))

    with pytest.raises(ValueError, match=r"^model=$"):
        called()
    assert option("--model", "model=") == "--model"


WRONG = {
    "no time": ("u,angle\n1,2\n0,5\n3,1\n", {}, 'columns={"time": "row:0.01"}'),
    "no such time": ("time,angle\n0,1\n1,2\n", {"columns": {"time": "tick"}}, 'columns={"time": "COLUMN:s"}'),
    "no such column": ("time,u\n0,1\n1,2\n", {"columns": {"angle": "xyz"}}, 'columns={"angle": "COLUMN"}'),
    "several": ("time,Angle,ANGLE\n0,1,1\n1,2,2\n", {"columns": {"angle": "angle"}}, 'columns={"angle": "'),
    "another century": ("time,angle\n0,1\n1e12,2\n", {}, 'assume={"time": "ms"}'),
    "no column": ("time,angle\n0,1\n1,2\n", {"columns": {"angle": ""}}, 'columns={"angle": "pos:deg"}'),
    "no unit": ("time,angle\n0,1\n1,2\n", {"assume": {"angle": " "}}, 'assume={"angle": "deg"}'),
    "a unit that is none": ("time,angle\n0,1\n1,2\n", {"assume": {"angle": "furlong"}}, 'assume={"angle": "furlong"}'),
}


@pytest.mark.parametrize("name", WRONG)
def test_remedy_in_python_is_an_argument(name: str, tmp_path: Path) -> None:
    content, more, words = WRONG[name]
    path = tmp_path / "run.csv"
    path.write_text(content)
    with pytest.raises(upright.UprightError) as caught:
        upright.load(path, **more)  # type: ignore[arg-type]
    assert words in str(caught.value)
    assert "--" not in str(caught.value)
