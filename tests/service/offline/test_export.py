"""Recordings in other tools' formats, read back with those tools' own readers."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from monocab_channels import MONOCAB

from upright.service.offline.inputs.replay import CONVERTED, convert
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording
from upright.telemetry.storage import load


@pytest.fixture
def recording() -> Recording:
    random = np.random.default_rng(5)
    values = {name: 0.1 * random.standard_normal(50) for name in MONOCAB.names}
    values["excitation"][7] = np.nan
    stamps = 1_795_258_604_290_842_800 + 4_000_000 * np.arange(50, dtype=np.int64)
    return Recording(MONOCAB, stamps, values, {"vehicle": "monocab", "experiment": "sweep"})


@pytest.mark.parametrize("suffix", CONVERTED)
def test_what_is_written_is_read_back(recording: Recording, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"run{suffix}"
    convert(recording, path)
    found = load(path)
    assert found.channels.names == recording.channels.names
    np.testing.assert_allclose(found.time, recording.time, rtol=0.0, atol=1e-9)
    for name in recording.channels.names:
        np.testing.assert_array_equal(found[name], recording[name])
    if suffix != ".csv":
        assert found.metadata == recording.metadata
        assert [each.unit for each in found.channels] == [each.unit for each in recording.channels]


def test_mf4_keeps_values_units_and_time(recording: Recording, tmp_path: Path) -> None:
    from asammdf import MDF

    convert(recording, tmp_path / "run.mf4")
    with MDF(tmp_path / "run.mf4") as file:
        roll = file.get("roll")
        assert roll.unit == "rad"
        np.testing.assert_array_equal(roll.samples, recording["roll"])
        np.testing.assert_allclose(roll.timestamps, recording.time, atol=1e-12)


def test_mcap_keeps_every_sample_at_its_nanosecond(recording: Recording, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    convert(recording, tmp_path / "run.mcap")
    with (tmp_path / "run.mcap").open("rb") as stream:
        messages = list(make_reader(stream).iter_messages(topics=["/vehicle"]))
    assert [message.log_time for _, _, message in messages] == recording.timestamp_ns.tolist()
    rows = [json.loads(message.data) for _, _, message in messages]
    assert [row["roll"] for row in rows] == recording["roll"].tolist()
    assert rows[7]["excitation"] is None
    schema = json.loads(messages[0][0].data)
    assert {each["type"] for each in schema["properties"].values()} == {"number"}, "Lichtblick reads no list of types"


def test_missing_package_error_names_the_extra(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "asammdf", None)
    with pytest.raises(RecordingError, match=r"needs the package asammdf.*upright\[mf4\]"):
        convert(recording, tmp_path / "run.mf4")


def test_unsupported_format_error_lists_the_supported_ones(recording: Recording, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"does not write \.xlsx.*\.mcap"):
        convert(recording, tmp_path / "run.xlsx")
