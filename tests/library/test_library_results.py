"""Three lines from a file to a verdict, and what can be done with each result: text, table, picture, page, model."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest
from test_library_model import RUBBING, RUBBING_TOML
from threadpoolctl import threadpool_info, threadpool_limits

import upright

FEW = ("coulomb_friction", "viscous_friction")
"""Effects to look for: the search through the whole catalogue is tested elsewhere."""


@pytest.fixture(scope="module")
def recording(folder: Path) -> upright.Recording:
    return upright.load(folder / "run.csv")


@pytest.fixture(scope="module")
def diagnosis(recording: upright.Recording, folder: Path) -> upright.Diagnosis:
    return upright.diagnose(recording, folder / "pendulum.toml", effects=FEW)


@pytest.fixture(scope="module")
def comparison(recording: upright.Recording, folder: Path, diagnosis: upright.Diagnosis) -> upright.Comparison:
    assert diagnosis.model is not None
    return upright.compare(recording, {"before": folder / "pendulum.toml", "after": diagnosis.model})


@pytest.fixture(scope="module")
def identification(recording: upright.Recording, folder: Path) -> upright.Identification:
    return upright.identify(recording, folder / "pendulum.toml", methods=("prediction_error", "least_squares"))


class Enough(Exception):
    """What a user's own button for cancel raises."""


def text_of(html: str) -> str:
    """The text of well-formed HTML."""
    found: list[str] = []
    parser = HTMLParser()
    parser.handle_data = found.append  # type: ignore[method-assign]
    parser.feed(html)
    parser.close()
    return "".join(found)


class TestDiagnosis:
    def test_the_missing_effect_is_named_with_its_size(self, diagnosis: upright.Diagnosis) -> None:
        assert diagnosis.verdict == "missing_effect"
        assert not diagnosis.adequate
        assert diagnosis.effects == ("coulomb_friction",)
        (finding,) = diagnosis.findings
        torque = finding.parameters["coulomb_friction.torque"]
        assert torque.value == pytest.approx(0.25, rel=0.02)
        assert str(torque).startswith("0.25")
        assert str(torque).endswith(" N m")
        assert finding.tied_with == ()
        assert not finding.negligible

    def test_its_text_and_its_notebook_view_say_the_same(self, diagnosis: upright.Diagnosis) -> None:
        text = str(diagnosis)
        assert text.startswith("missing effect: the model lacks coulomb_friction")
        assert diagnosis.headline in " ".join(text.split())
        assert diagnosis.next_step.split(" ")[0] in text
        assert "\x1b" not in text
        assert "missing effect: the model lacks coulomb_friction" in text_of(diagnosis._repr_html_())

    def test_it_is_a_table_and_the_document_of_the_command(self, diagnosis: upright.Diagnosis) -> None:
        table = diagnosis.to_frame()
        assert list(table["parameter"]) == list(diagnosis.findings[0].parameters)
        document = json.loads(json.dumps(diagnosis.to_json()))
        assert document["findings"][0]["effect"] == "coulomb_friction"

    def test_its_model_can_be_saved_and_says_where_it_comes_from(
        self, diagnosis: upright.Diagnosis, tmp_path: Path
    ) -> None:
        assert diagnosis.model is not None
        again = upright.Model.load(diagnosis.model.save(tmp_path / "repaired.toml"))
        assert again.effects == ("coulomb_friction",)
        assert again.history[-1]["recording"] == ["run.csv"]
        assert len(again.history[-1]["sha256"][0]) == 64

    def test_its_picture_and_its_page_show_before_and_after(self, diagnosis: upright.Diagnosis, tmp_path: Path) -> None:
        labels = [text.get_text() for text in diagnosis.plot().axes[0].get_legend().get_texts()]
        assert [label.split(",")[0] for label in labels] == ["measured", "before", "after"]
        page = diagnosis.report(tmp_path / "diagnosis.html")
        assert "coulomb_friction" in page.read_text()
        assert [each.name for each in tmp_path.iterdir()] == ["diagnosis.html"]

    def test_an_effect_of_ones_own_is_found_as_an_object_and_as_a_file(
        self, recording: upright.Recording, folder: Path, tmp_path: Path
    ) -> None:
        file = tmp_path / "rubbing.toml"
        file.write_text(RUBBING_TOML)
        model = folder / "pendulum.toml"
        as_object = upright.diagnose(recording, model, effects=["viscous_friction", RUBBING])
        as_file = upright.diagnose(recording, model, effects="viscous_friction", also=file)
        for found in (as_object, as_file):
            assert found.effects == ("rubbing",)
        assert as_object.findings[0].parameters == as_file.findings[0].parameters
        assert as_file.model is not None
        assert upright.Model.load(as_file.model.save(tmp_path / "repaired.toml")).effects == ("rubbing",)

    def test_recordings_that_cannot_be_used_are_a_verdict(self, recording: upright.Recording, folder: Path) -> None:
        found = upright.diagnose(recording.between(0.0, 0.2), folder / "pendulum.toml", effects=FEW)
        assert found.verdict == "insufficient_data"
        assert found.model is None
        assert found.reason in " ".join(str(found).split())
        with pytest.raises(upright.UprightError, match="nothing to draw"):
            found.plot()

    def test_a_wrong_budget_or_effect_names_the_remedy(self, recording: upright.Recording, folder: Path) -> None:
        with pytest.raises(upright.UprightError, match="more than 0 s"):
            upright.diagnose(recording, folder / "pendulum.toml", budget=0.0)
        with pytest.raises(upright.UprightError, match="did you mean backlash"):
            upright.diagnose(recording, folder / "pendulum.toml", effects="backlsh")


class TestComparison:
    def test_the_error_falls(self, comparison: upright.Comparison) -> None:
        assert comparison.adequate == {"before": False, "after": True}
        assert comparison.fails["before"]
        assert comparison.fails["after"] == []
        table = comparison.to_frame().set_index("model")
        assert table.loc["after", "rmse"] < 1.5 * table.loc["after", "noise_floor"]
        assert table.loc["before", "rmse"] > 10.0 * table.loc["before", "noise_floor"]

    def test_its_views(self, comparison: upright.Comparison, tmp_path: Path) -> None:
        assert str(comparison).startswith("run.csv")
        assert "adequate" in text_of(comparison._repr_html_())
        assert len(comparison.plot().axes) > 3
        assert "before" in comparison.report(tmp_path / "comparison.html").read_text()
        assert [each["recording"] for each in comparison.to_json()["models"]] == [comparison.answers[0][0]] * 2

    def test_models_of_the_same_name_are_numbered(self, recording: upright.Recording, folder: Path) -> None:
        model = upright.Model.load(folder / "pendulum.toml")
        found = upright.compare(recording.between(0.0, 5.0), [model, model.change({"inertia": 0.62})])
        assert list(found.adequate) == ["pendulum", "pendulum (2)"]
        with pytest.raises(upright.UprightError, match="there is none"):
            upright.compare(recording, [])

    def test_what_is_no_model_or_no_recording_names_the_remedy(self, folder: Path) -> None:
        recording, path = upright.load(folder / "run.csv"), str(folder / "run.csv")
        with pytest.raises(upright.UprightError, match=r"None is none.*says why"):
            upright.compare(recording, {"after": None})  # type: ignore[dict-item]
        for wrong in ([path], []):
            with pytest.raises(upright.UprightError, match=r"give what upright\.load returns"):
                upright.compare(wrong, folder / "pendulum.toml")  # type: ignore[arg-type]


class TestIdentification:
    def test_the_estimates_of_the_recommended_method(self, identification: upright.Identification) -> None:
        assert identification.best == "prediction_error"
        assert set(identification.methods) == {"prediction_error", "least_squares"}
        assert identification.parameters["inertia"].value == pytest.approx(0.62, rel=0.1)

    def test_its_model_has_them_and_knows_those_before(
        self, identification: upright.Identification, tmp_path: Path
    ) -> None:
        assert identification.model is not None
        again = upright.Model.load(identification.model.save(tmp_path / "identified.toml"))
        assert again.parameters["inertia"] == identification.parameters["inertia"]
        assert again.history[-1]["values_before"]["inertia"]["value"] == 0.5

    def test_its_views(self, identification: upright.Identification, tmp_path: Path) -> None:
        assert "Recommended method: prediction_error" in str(identification)
        assert "prediction_error" in text_of(identification._repr_html_())
        table = identification.to_frame()
        assert set(table[table["best"]]["method"]) == {"prediction_error"}
        assert identification.plot().axes
        assert "prediction_error" in identification.report(tmp_path / "identification.html").read_text()
        assert identification.to_json()["best"] == "prediction_error"

    def test_the_start_of_an_effect_is_no_value_from_before(
        self, recording: upright.Recording, diagnosis: upright.Diagnosis
    ) -> None:
        assert diagnosis.model is not None
        found = upright.identify(recording, diagnosis.model, methods="prediction_error")
        assert set(found.to_json()["before"]) == {"inertia", "stiffness"}
        assert "coulomb_friction.torque" in found.parameters

    def test_one_method_by_its_name(self, recording: upright.Recording, folder: Path) -> None:
        assert set(upright.identify(recording, folder / "pendulum.toml", methods="least_squares").methods) == {
            "least_squares"
        }
        with pytest.raises(upright.UprightError, match="choose among"):
            upright.identify(recording, folder / "pendulum.toml", methods="least_square")


class TestProgress:
    """What is being done, and that it can be ended."""

    @pytest.mark.parametrize("reason", [KeyboardInterrupt, Enough])
    @pytest.mark.parametrize("work", ["identify", "compare", "diagnose"])
    def test_progress_rises_and_can_end_the_work(
        self, work: str, reason: type[BaseException], recording: upright.Recording, folder: Path
    ) -> None:
        shares: list[float] = []

        def follow(text: str, share: float) -> None:
            assert text
            shares.append(share)
            if len(shares) == 2:
                raise reason

        parts = [recording.between(0.0, 7.0), recording.between(7.0, 15.0)]
        more = {"effects": FEW} if work == "diagnose" else {}
        with pytest.raises(reason):
            getattr(upright, work)(parts, folder / "pendulum.toml", progress=follow, **more)
        assert len(shares) == 2
        assert 0.0 <= shares[0] <= shares[1] <= 1.0

    def test_ctrl_c_ends_a_script_and_leaves_what_there_was(self, folder: Path, tmp_path: Path) -> None:
        kept = tmp_path / "repaired.toml"
        kept.write_text("title = 'before'\n")
        script = (
            "import signal, sys, upright\n"
            "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored under a shell's background job
            f"recording = upright.load({str(folder / 'run.csv')!r})\n"
            f"found = upright.diagnose(recording, {str(folder / 'pendulum.toml')!r},\n"
            "    progress=lambda text, share: print(text, flush=True))\n"
            f"found.model.save({str(kept)!r})\n"
        )
        command = [sys.executable, "-c", script]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                if line.startswith("scoring"):
                    break
            os.kill(process.pid, signal.SIGINT)
            _, messages = process.communicate(timeout=60)
        assert process.returncode == -signal.SIGINT
        assert messages.rstrip().endswith("KeyboardInterrupt")
        assert kept.read_text() == "title = 'before'\n"
        assert list(tmp_path.iterdir()) == [kept]


def test_blas_has_as_many_threads_afterwards_as_before(recording: upright.Recording, folder: Path) -> None:
    def threads() -> set[int]:
        return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}

    inside: set[int] = set()
    with threadpool_limits(2, "blas"):
        before = threads()
        upright.compare(
            recording.between(0.0, 3.0),
            folder / "pendulum.toml",
            progress=lambda text, share: inside.update(threads()),
        )
        assert threads() == before
    assert inside == {1}
