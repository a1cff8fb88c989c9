"""A fleet: one row a recording, as `upright diagnose` has it; nothing done twice, nothing lost, nothing half."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import dask_scheduler
import numpy as np
import pendulum_plant
import pyarrow.parquet
import pytest
from dask_scheduler import environment, until
from typer.testing import CliRunner

from upright.models.file.model_file import load_model
from upright.service.cli import app
from upright.service.fleet import results
from upright.service.fleet.examine import Settings, examine
from upright.service.fleet.report import write_fleet
from upright.service.fleet.results import Parameter, Row
from upright.service.fleet.run import Fleet, fleet
from upright.service.fleet.store import Store, StoreError
from upright.service.fleet.trends import changes, trends
from upright.service.spread import SchedulerError, machines, processes
from upright.telemetry.storage import load, save

pytestmark = pytest.mark.timeout(300)
"""Worker processes import numpy, SciPy and numba; on a busy machine that takes long."""

MANUAL = Path(__file__).resolve().parents[2] / "docs" / "how-to" / "write-your-own-model.md"
EFFECT = "viscous_friction"
LONG, SHORT = 12.0, 0.1
"""s, of a recording that is diagnosed, and of one that is read and found too short."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the pendulum's model, a long recording, a short one, and a file that is no recording."""
    folder = tmp_path_factory.mktemp("made")
    model = re.findall(r"^```toml\n(.*?)^```", MANUAL.read_text(), re.DOTALL | re.MULTILINE)[0]
    (folder / "pendulum.toml").write_text(model)
    pendulum_plant.write(folder / "long.csv", seed=7, duration=LONG)
    pendulum_plant.write(folder / "short.csv", seed=7, duration=SHORT)
    (folder / "broken.csv").write_text("hello\n")
    return folder


@pytest.fixture
def runs(made: Path, tmp_path: Path) -> Path:
    """Recordings of three pendulums, one folder each."""
    folder = tmp_path / "runs"
    for name, recording in (("a/1.csv", "long"), ("a/2.csv", "short"), ("b/1.csv", "short"), ("c/1.csv", "broken")):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(made / f"{recording}.csv", folder / name)
    return folder


def many(made: Path, folder: Path, count: int) -> Path:
    """A folder with `count` short recordings of ten vehicles."""
    text = (made / "short.csv").read_text()
    for number in range(count):
        path = folder / f"vehicle_{number % 10}" / f"{number:04d}.csv"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def settings(made: Path) -> Settings:
    return Settings.of("monocab", str(made / "pendulum.toml"), effects=[EFFECT])


def upright(made: Path, folder: Path | str, out: Path, *more: Any, code: int = 0) -> Any:
    """The JSON document of `upright fleet`."""
    options = ["--model", made / "pendulum.toml", "--effect", EFFECT, "--out", out, "--workers", 1, "--json", *more]
    done = CliRunner().invoke(app, ["fleet", str(folder), *map(str, options)], catch_exceptions=False)
    assert done.exit_code == code, done.output
    return json.loads(done.stdout)


def by_name(out: Path) -> dict[str, Row]:
    return {row.recording: row for row in results.read(out)}


def test_row_is_the_diagnosis_of_the_recording(made: Path, runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "fleet.parquet"
    document = upright(made, runs, out, code=1)
    assert (document["recordings"], document["skipped"], list(document["failed"])) == (4, 0, ["c/1.csv"])
    alone = ["diagnose", str(runs / "a/1.csv"), "--model", str(made / "pendulum.toml"), "--effect", EFFECT, "--json"]
    expected = json.loads(CliRunner().invoke(app, alone, catch_exceptions=False).stdout)
    rows = by_name(out)
    row = rows["a/1.csv"]
    assert (row.verdict, row.reason) == (expected["verdict"], expected["reason"])
    assert [each.name for each in row.effects] == [each["effect"] for each in expected["findings"]]
    assert row.innovation_ratio_before == expected["innovation_ratio_before"]
    assert (row.vehicle, row.samples, row.began_by) == ("a", 2400, "file")
    inertia = next(each for each in row.parameters if each.name == "inertia")
    assert inertia.value == pytest.approx(pendulum_plant.INERTIA, rel=0.02)
    # The motor constant is known to 7 %, and is wrong by the same amount in all recordings.
    assert inertia.own_std < 0.1 * inertia.std  # type: ignore[operator]
    assert rows["b/1.csv"].verdict == "insufficient_data"
    assert rows["c/1.csv"].status == results.FAILED
    assert "Remedy:" in rows["c/1.csv"].reason


def test_recording_is_diagnosed_again_only_if_something_changed(made: Path, runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "fleet.parquet"
    upright(made, runs, out, code=1)
    before = by_name(out)
    os.utime(runs / "a/1.csv")
    shutil.copy(made / "broken.csv", runs / "a/2.csv")
    shutil.copy(made / "short.csv", runs / "c/1.csv")
    document = upright(made, runs, out, code=1)
    assert (document["skipped"], list(document["failed"])) == (1, ["a/2.csv"])
    assert document["failed"]["a/2.csv"].startswith("holds no rows. Remedy:")
    after = by_name(out)
    assert after["a/1.csv"].stamp != before["a/1.csv"].stamp
    # Same bytes: it was read and not diagnosed, so the computing time is that of before, too.
    assert replace(after["a/1.csv"], stamp="") == replace(before["a/1.csv"], stamp="")
    assert after["c/1.csv"].verdict == "insufficient_data"
    assert upright(made, runs, out, "--only", "b/*")["skipped"] == 1
    done = {name: row for name, row in after.items() if row.status == results.DONE}
    assert by_name(out) == done, "the others keep their rows, and one that failed is tried again"
    assert upright(made, runs, out, "--only", "b/*", "--budget", "20")["skipped"] == 0


def test_ctrl_c_keeps_what_is_finished_and_the_next_run_continues(made: Path, tmp_path: Path) -> None:
    folder, out = many(made, tmp_path / "runs", 200), tmp_path / "fleet.parquet"
    command = [sys.executable, "-m", "upright", "fleet", folder, "--model", made / "pendulum.toml", "--out", out]
    # Under a shell that runs the tests in the background, Ctrl-C would be ignored.
    start = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{start}; import sys; sys.argv[1:] = {[*map(str, command[3:]), '--workers', '1']!r}; "
    code += "from upright.service.cli import main; main()"
    running = subprocess.Popen(
        [sys.executable, "-c", code], env=environment(), start_new_session=True, stderr=subprocess.DEVNULL
    )
    try:
        until(out.exists, 120.0)
        os.killpg(running.pid, signal.SIGINT)  # as a terminal does
        assert running.wait(30.0) == 130
    finally:
        if running.poll() is None:
            os.killpg(running.pid, signal.SIGKILL)
            running.wait()
    kept = results.read(out)
    assert 0 < len(kept) < 200
    assert not list(tmp_path.glob(".*")), "nothing half is left"
    found = fleet(Store.of(str(folder)), out, Settings.of("monocab", str(made / "pendulum.toml")), processes(2))
    assert (found.skipped, found.missing, len(found.rows)) == (len(kept), 0, 200)
    assert results.read(out) == list(found.rows)


def test_recordings_of_an_object_store_are_read_and_need_no_other_process_to_see_them(
    made: Path, runs: Path, tmp_path: Path
) -> None:
    """memory:// is a real implementation of fsspec, with names for paths; the worker is another process."""
    import fsspec

    memory = fsspec.filesystem("memory")
    try:
        for path in runs.rglob("*.csv"):
            memory.pipe(f"/bucket/runs/{path.relative_to(runs)}", path.read_bytes())
        out = tmp_path / "fleet.parquet"
        document = upright(made, "memory://bucket/runs", out, code=1)
        assert list(document["failed"]) == ["c/1.csv"]
        assert tmp_path.name not in document["failed"]["c/1.csv"]
        rows = by_name(out)
        assert rows["a/1.csv"].verdict == "adequate"
        assert upright(made, "memory://bucket/runs", out, code=1)["skipped"] == 3
    finally:
        memory.rm("/bucket", recursive=True)


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A bucket on a server that speaks the protocol of S3 over HTTP: moto stands in for Amazon's own."""
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        for key, value in {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
            "AWS_ACCESS_KEY_ID": "nobody",
            "AWS_SECRET_ACCESS_KEY": "nothing",
            "AWS_DEFAULT_REGION": "us-east-1",
        }.items():
            monkeypatch.setenv(key, value)
        yield "s3://test-track/runs"
    finally:
        server.stop()


def test_recordings_in_a_bucket_are_read_by_the_workers_and_again_only_where_they_changed(
    made: Path, runs: Path, bucket: str, tmp_path: Path
) -> None:
    import s3fs

    files = s3fs.S3FileSystem(skip_instance_cache=True)
    files.mkdir("test-track")
    for path in runs.rglob("*.csv"):
        files.pipe(f"{bucket}/{path.relative_to(runs)}", path.read_bytes())
    out = tmp_path / "fleet.parquet"
    found = fleet(Store.of(bucket), out, settings(made), processes(2))
    assert [row.recording for row in found.failures] == ["c/1.csv"]
    assert by_name(out)["a/1.csv"].verdict == "adequate"

    files.pipe(f"{bucket}/a/1.csv", (runs / "b/1.csv").read_bytes())
    again = fleet(Store.of(bucket), out, settings(made), processes(2))
    assert again.skipped == 2, "all but the one that changed and the one that failed"
    assert by_name(out)["a/1.csv"].sha256 == by_name(out)["b/1.csv"].sha256


def test_a_bucket_that_is_not_there_is_said(bucket: str) -> None:
    with pytest.raises(StoreError, match=r"cannot be listed .*Check the path, its permissions, and the credentials"):
        Store.of("s3://nowhere/runs").recordings()


def test_recordings_of_an_archive_are_read_by_the_workers(made: Path, runs: Path, tmp_path: Path) -> None:
    archive = shutil.make_archive(str(tmp_path / "runs"), "zip", runs)
    found = fleet(Store.of(f"zip://::{archive}"), tmp_path / "out.parquet", settings(made), processes(2), only="?/*")
    assert [row.recording for row in found.rows] == ["a/1.csv", "a/2.csv", "b/1.csv", "c/1.csv"]
    assert found.rows[0].verdict == "adequate"
    assert [row.recording for row in found.failures] == ["c/1.csv"]
    assert "upright-fleet-" not in found.failures[0].reason


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    """A Dask scheduler with two workers, each a process of its own."""
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'upright[fleet]'")
    with dask_scheduler.scheduler(tmp_path) as address:
        yield address


@pytest.mark.filterwarnings("default")  # Dask's own, about its event loop
def test_dask_workers_give_the_same_rows(made: Path, runs: Path, tmp_path: Path, scheduler: str) -> None:
    store = Store.of(str(runs))
    here = fleet(store, tmp_path / "here.parquet", settings(made), processes(1))
    there = fleet(store, tmp_path / "there.parquet", settings(made), machines(scheduler))
    assert [replace(row, seconds=0.0) for row in there.rows] == [replace(row, seconds=0.0) for row in here.rows]
    assert len(there.rows) == 4


@pytest.mark.filterwarnings("default")
def test_scheduler_that_does_not_answer_costs_no_result(
    made: Path, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'upright[fleet]'")
    monkeypatch.setattr("upright.service.spread.CONNECT_TIMEOUT", 0.5)
    out = tmp_path / "fleet.parquet"
    results.write(out, [Row("a/1.csv", settings="others")])
    with pytest.raises(SchedulerError, match="dask scheduler"):
        fleet(Store.of(str(runs)), out, settings(made), machines("tcp://127.0.0.1:1"))
    assert results.read(out) == [Row("a/1.csv", settings="others")]


def test_thousand_recordings_have_a_thousand_rows(made: Path, tmp_path: Path) -> None:
    """The smallest recordings there are, so that everything but the diagnosis counts."""
    folder, done = many(made, tmp_path / "runs", 1000), []
    found = fleet(
        Store.of(str(folder)),
        tmp_path / "fleet.parquet",
        settings(made),
        processes(2),
        progress=lambda count, total: done.append((count, total)),
    )
    assert done == [(count, 1000) for count in range(1001)]
    assert [row.recording for row in found.rows] == sorted(
        row.recording for row in results.read(tmp_path / "fleet.parquet")
    )
    assert {row.verdict for row in found.rows} == {"insufficient_data"}
    assert {row.vehicle for row in found.rows} == {f"vehicle_{number}" for number in range(10)}


def test_what_a_recording_states_comes_before_its_folder_and_its_file(made: Path, tmp_path: Path) -> None:
    folder = tmp_path / "runs"
    (folder / "folder").mkdir(parents=True)
    whole, start = load(made / "short.csv"), datetime(2026, 5, 3, 12, tzinfo=UTC)
    stamped = whole.timestamp_ns + int(start.timestamp()) * 1_000_000_000
    save(replace(whole, timestamp_ns=stamped, metadata={"vehicle": "seven"}), folder / "folder" / "run.arrow")
    store = Store.of(str(folder))
    (stored,) = store.recordings()
    row = examine(settings(made), store, (stored, None))
    assert (row.vehicle, row.began, row.began_by) == ("seven", start, "recording")


def test_only_recordings_are_listed(tmp_path: Path) -> None:
    for name in (
        "run.arrow", "run.log", "run.estimates.json", "other.log", ".hidden.csv", ".git/x.csv", "notes.md",
        "bag/metadata.yaml", "bag/bag_0.mcap", "bag/bag_1.mcap", "day/RUN.CSV", "day/metadata.yaml", "fleet.parquet",
    ):  # fmt: skip
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
    found = {each.name: each.files for each in Store.of(str(tmp_path)).recordings(besides=tmp_path / "fleet.parquet")}
    assert set(found) == {"run.arrow", "other.log", "bag", "day/RUN.CSV"}
    assert [Path(each).name for each in found["bag"]] == ["bag_0.mcap", "bag_1.mcap"]


def test_example_makes_recordings_and_their_model(tmp_path: Path) -> None:
    example = Path(__file__).resolve().parents[2] / "examples" / "pendulum_fleet.py"
    subprocess.run([sys.executable, example, tmp_path, "1"], check=True, timeout=60)
    found = [each.name for each in Store.of(str(tmp_path)).recordings()]
    assert found == [f"pendulum_{number}/2026-03-02.csv" for number in range(1, 5)]
    assert "coulomb_friction.torque" in load_model(tmp_path / "pendulum.toml").values


def test_folder_that_cannot_be_used_is_refused_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for url, what in ((str(tmp_path), "holds no recordings"), (str(tmp_path / "none"), "holds no"), ("x1y://a", "x1y")):
        with pytest.raises(StoreError, match=what) as caught:
            Store.of(url).recordings()
        assert caught.value.remedy
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(StoreError, match=r"upright\[fleet\]"):
        Store.of(str(tmp_path))


def test_file_of_something_else_is_not_replaced(made: Path, runs: Path, tmp_path: Path) -> None:
    out = tmp_path / "other.parquet"
    save(load(made / "short.csv"), out)
    bytes_before = out.read_bytes()
    for _ in range(2):
        with pytest.raises(results.ResultsError, match="--out"):
            fleet(Store.of(str(runs)), out, settings(made), processes(1))
        assert out.read_bytes() == bytes_before
        out.write_text("no Parquet")
        bytes_before = out.read_bytes()


# --- over time


def history(vehicles: int, count: int, *, changed: str = "", place: int = 0) -> list[Row]:
    """Rows with an inertia and a friction, which doubles for the vehicle `changed`."""
    random = np.random.default_rng(23)
    rows = []
    for vehicle in (f"vehicle_{number}" for number in range(vehicles)):
        for number in range(count):
            friction = 20.0 if vehicle == changed and number >= place else 10.0
            parameters = tuple(
                Parameter(name, true + random.normal(0.0, 0.6), 2.0, 0.4, unit, "")
                for name, true, unit in (("inertia", 40.0, "kg m^2"), ("coulomb_friction.torque", friction, "N m"))
            )
            began = datetime(2026, 3, 1, tzinfo=UTC) + timedelta(days=7 * number)
            rows.append(Row(f"{vehicle}/{number}", vehicle, began, verdict="adequate", parameters=parameters))
    return rows


def test_change_is_found_in_the_right_vehicle_and_said_in_one_sentence() -> None:
    found = trends(reversed(history(10, 14, changed="vehicle_7", place=9)))
    assert len(found) == 20
    ((trend, step),) = changes(found)
    assert re.fullmatch(
        r"Since 2026-05-03, coulomb_friction\.torque of vehicle_7 is [12]\.\d+ ± 0\.\d+ times what it was before:"
        r" (19|20)\.\d+ ± 0\.\d+ N m after \d+\.\d+ ± 0\.\d+ N m, p < 0\.001",
        trend.change(step),
    )
    document = trend.to_json(step)
    assert (document["recording"], document["vehicle"]) == ("vehicle_7/9", "vehicle_7")


def test_fleet_without_a_change_has_none() -> None:
    assert changes(trends(history(30, 12))) == []


def test_page_has_changes_figures_and_what_could_not_be_read() -> None:
    rows = [
        *history(3, 8, changed="vehicle_1", place=4),
        Row("x.csv", status=results.FAILED, reason="holds <no> rows."),
    ]
    found = trends(rows)
    text = write_fleet(Fleet(tuple(rows), 0, 2), found, "s3://bucket/runs")
    assert "<h1>1 change</h1>" in text
    assert text.count("<svg ") == 3
    assert text.index('id="vehicle_1"') < text.index('id="vehicle_0"'), "what changed comes first"
    assert "holds &lt;no&gt; rows." in text
    assert "2 more are not finished" in text
    assert "src=" not in text


def test_results_are_a_table_for_other_programs(tmp_path: Path) -> None:
    rows = history(1, 2)
    results.write(tmp_path / "fleet.parquet", rows)
    table = pyarrow.parquet.read_table(tmp_path / "fleet.parquet")
    assert table.num_rows == 2
    assert str(table.schema.field("began").type) == "timestamp[us, tz=UTC]"
    first = table.column("parameters").to_pylist()[0][0]
    assert set(first) == {"name", "value", "std", "own_std", "unit", "reason"}
