"""`upright multisine`: what it predicts is what the model does, within its limits, and the command that prints it."""

from __future__ import annotations

import json
import tomllib
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from upright.diagnosis.information import information, predicted_information
from upright.diagnosis.prediction.closed_loop import causal, simulate
from upright.service.cli import app
from upright.service.offline.models import identified_model
from upright.service.offline.multisine import NAME, DesignedMultisine, MultisineError, designed_multisine
from upright.vehicles import registry
from upright.vehicles.experiment.excitation import make_excitation
from upright.vehicles.file import load
from upright.vehicles.sections import ExperimentSection

VEHICLE = load("monocab")
SHORT = {"duration": 12.0, "start": 0.25, "stop": 2.0, "lines": 8}


@cache
def designed(share: float = 0.5) -> DesignedMultisine:
    return designed_multisine(VEHICLE, identified_model(None, VEHICLE), share=share, **SHORT)  # type: ignore[arg-type]


def test_it_uses_the_share_of_the_limits_that_it_may() -> None:
    assert max(designed().largest.values()) == pytest.approx(0.5, rel=0.1)
    assert max(designed(0.25).largest.values()) == pytest.approx(0.25, rel=0.1)
    assert designed().section.amplitude_deg == pytest.approx(
        2.0 * (designed(0.25).section.amplitude_deg or 0.0), rel=0.1
    )


def test_no_experiment_of_the_vehicle_file_determines_as_much_in_that_time() -> None:
    found = designed()
    own, *others = found.candidates
    assert own.name == NAME
    assert {each.name for each in others} >= {"sweep", "multisine"}
    for each in others:
        assert found.seconds_like(each.name) < each.seconds, each.name
        if each.name == "sweep":
            assert found.seconds_like(each.name) < 0.7 * each.seconds


def test_written_section_is_the_same_experiment(tmp_path: Path) -> None:
    table = tomllib.loads(designed().toml)["experiments"][NAME]
    section = ExperimentSection.model_validate(table)
    excitation = make_excitation(section, 250.0)
    expected = make_excitation(designed().section, 250.0)
    times = np.linspace(0.0, 12.0, 500)
    one, other = ([each.value(t) for t in times] for each in (excitation, expected))
    np.testing.assert_allclose(one, other, atol=2e-3 * expected.peak)


def test_no_limit_is_reached_with_other_parameters() -> None:
    model = causal(identified_model(None, VEHICLE))
    file = VEHICLE.model_copy(update={"experiments": {NAME: designed().section}})
    experiment = registry.of("monocab").prediction().of(file)(NAME)
    random = np.random.default_rng(9)
    for _ in range(12):
        drawn = {
            name: each + VEHICLE.parameters.deviations[name] * float(np.clip(random.standard_normal(), -2.0, 2.0))
            for name, each in VEHICLE.parameters.values.items()
            if name in model.values
        }
        assert not simulate(model.change(drawn), experiment).broken


class TestInformation:
    def test_it_grows_with_the_square_of_a_small_amplitude(self) -> None:
        model = causal(identified_model(None, VEHICLE))
        still, *found = (self.of(model, size) for size in (1e-9, 0.1, 0.2))
        ratio = (found[1] - still)[:2, :2] / (found[0] - still)[:2, :2]
        np.testing.assert_allclose(ratio, 4.0, rtol=0.02)

    def test_deviations_are_those_of_the_inverse(self) -> None:
        model = causal(identified_model(None, VEHICLE))
        predict = registry.of("monocab").prediction().of(VEHICLE)
        found = predicted_information(model, predict("doublet"))
        covariance = np.linalg.inv(found.matrix)
        expected = dict(zip(found.names, np.sqrt(np.diag(covariance)).tolist(), strict=True))
        assert found.deviations() == pytest.approx(expected)

    @staticmethod
    def of(model: object, amplitude: float) -> np.ndarray:
        section = VEHICLE.experiments["doublet"].model_copy(update={"amplitude": amplitude, "duration": 6.0})
        file = VEHICLE.model_copy(update={"experiments": {"doublet": section}})
        course = simulate(model, registry.of("monocab").prediction().of(file)("doublet"))  # type: ignore[arg-type]
        return np.asarray(information(model, course.rows).matrix)  # type: ignore[arg-type]


class TestRefusals:
    def test_parameter_that_is_not_estimated(self) -> None:
        with pytest.raises(MultisineError, match="the model does not estimate trim_mass"):
            designed_multisine(VEHICLE, identified_model(None, VEHICLE), about=["trim_mass"])

    def test_period_that_does_not_fit_in(self) -> None:
        with pytest.raises(MultisineError, match=r"no whole period of 0\.0667 Hz fits in"):
            designed_multisine(VEHICLE, identified_model(None, VEHICLE), duration=15.0, start=0.06, stop=1.0, lines=2)


def test_hardly_known_vehicle_is_excited_less() -> None:
    few = {**SHORT, "lines": 3, "share": 0.75}
    sure, vague = (
        designed_multisine(VEHICLE, identified_model(None, VEHICLE).change(deviations=std), **few)  # type: ignore[arg-type]
        for std in ({"inertia": 10.0, "gravity_stiffness": 100.0}, {"inertia": 350.0, "gravity_stiffness": 3000.0})
    )
    assert vague.section.amplitude_si < 0.97 * sure.section.amplitude_si
    assert max(sure.largest.values()) == pytest.approx(0.75, rel=0.1)


class TestCommand:
    def test_result_of_an_identification_is_used(self, tmp_path: Path) -> None:
        """Also if it has the drives' lag, which the model does not have."""
        path = tmp_path / "result.json"
        of_roll = {"inertia": (1650.0, 8.0), "gravity_stiffness": (14500.0, 180.0)}
        methods = {"a": ("time", of_roll), "drive_lag": ("drives", {"speed_loop_lag": (0.04, 1e-4)})}
        entries = {
            method: {
                "domain": domain,
                "parameters": {name: {"value": value, "std": std} for name, (value, std) in found.items()},
            }
            for method, (domain, found) in methods.items()
        }
        path.write_text(json.dumps({"best": "a", "methods": entries}))
        words = ["multisine", str(path), "--duration", "12", "--start", "0.25", "--stop", "2", "--lines", "3"]
        done = CliRunner().invoke(app, words)
        assert done.exit_code == 0, done.output
        assert "[experiments.designed]" in done.stdout

    def test_it_writes_the_section(self, tmp_path: Path) -> None:
        target = tmp_path / "designed.toml"
        words = [
            "multisine",
            "--duration",
            "12",
            "--start",
            "0.25",
            "--stop",
            "2",
            "--lines",
            "4",
            "--write",
            str(target),
        ]
        done = CliRunner().invoke(app, [*words, "--json"])
        assert done.exit_code == 0, done.output
        answer = json.loads(done.stdout)
        assert answer["parameters"] == ["inertia", "gravity_stiffness"]
        assert answer["candidates"][0]["name"] == NAME
        assert tomllib.loads(target.read_text())["experiments"][NAME]["excitation"] == "multisine"

    @pytest.mark.parametrize("words", [["--start", "3", "--stop", "1"], ["--of-limits", "0.9"], ["--duration", "1"]])
    def test_impossible_options_are_usage_errors(self, words: list[str]) -> None:
        assert CliRunner().invoke(app, ["multisine", *words]).exit_code == 2
