"""`upright bundle`: what is in the archive, how large it is, and that no secret is."""

from __future__ import annotations

import base64
import json
import os
import tarfile
from pathlib import Path
from urllib.parse import quote

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from upright.service.cli import app
from upright.service.doctor.bundle import BundleError, Wanted, pack
from upright.service.doctor.secrets import REMOVED, Redactor, files_of, files_on, of_environment
from upright.vehicles.file import load, shipped_file

BROKER, TOKEN, LOGGED, COMMENT = "br0ker/pass&wörd", "t0ken-of-env-4711", "l0gged-secret-9", "c0mment-secret-8"
PRIVATE = "-----BEGIN RSA PRIVATE KEY-----\nMIIEpAIBAAKCAQEAsecretkeymaterial\n-----END RSA PRIVATE KEY-----"
PLANTED = (BROKER, TOKEN, LOGGED, COMMENT, "secretkeymaterial", "envfile-passw0rd", "m0del-note-secret")


def contents(path: Path) -> dict[str, bytes]:
    with tarfile.open(path) as archive:
        members = [(each, archive.extractfile(each)) for each in archive.getmembers()]
        return {each.name.partition("/")[2]: file.read() for each, file in members if file is not None}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder of recordings, four of them, each older than the next."""
    folder = tmp_path / "data"
    folder.mkdir()
    for number in range(4):
        for suffix, content in ((".arrow", b"\0arrow\xff" * 100), (".log", b"(1.0) can0 181#00\n" * 50)):
            path = folder / f"2026112{number}_hold{suffix}"
            path.write_bytes(content)
            os.utime(path, (1000 + number, 1000 + number))
        (folder / f"2026112{number}_hold.estimates.json").write_text('{"methods": {}}')
    return folder


@pytest.fixture
def planted(tmp_path: Path, data: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The words of the command, on a computer with secrets wherever people leave them."""
    monkeypatch.chdir(tmp_path)
    password = tmp_path / "password"
    password.write_text(f"{BROKER}\n")
    file = tmp_path / "vehicle.toml"
    mqtt = f'broker = "127.0.0.1:1"\nusername = "u"\npassword_file = "{password}"'
    shipped = shipped_file("monocab").read_text()
    assert 'broker = ""' in shipped
    file.write_text(f"# {COMMENT}\n" + shipped.replace('broker = ""', mqtt, 1))
    monkeypatch.setenv("UPRIGHT_TOKEN", TOKEN)
    monkeypatch.setenv("UPRIGHT_NOTE", f"the token is {TOKEN}")
    monkeypatch.setenv("HOME_OF_NOBODY", TOKEN)
    environment = tmp_path / "upright.env"
    environment.write_text("VEHICLE=/etc/upright/vehicle.toml\nMQTT_PASSWORD='envfile-passw0rd'\n")
    monkeypatch.setattr("upright.service.doctor.bundle.ENVIRONMENT_FILE", environment)
    coded = base64.b64encode(f"upright:{BROKER}".encode()).decode()
    log = tmp_path / "daemon.log"
    log.write_text(
        f"connecting with {BROKER} and {quote(BROKER, safe='')} as {coded}, {BROKER.encode().hex()}\n"
        f"mqtt://upright:{LOGGED}@host:1883\nAuthorization: Bearer {LOGGED}\napi_key = '{LOGGED}'\n"
        f"run --broker-password {LOGGED} --port 1\npassword:\n  {LOGGED}\n"
        f'{{"token": "{LOGGED}", "port": 1883}}\n{json.dumps({"said": BROKER})}\n{PRIVATE}\nenvfile-passw0rd\n'
        "the control loop missed 3 cycles\n"
    )
    models = data / "models"
    models.mkdir()
    (models / "monocab.toml").write_text('base = "monocab_roll"\nsecret_note = "m0del-note-secret"\n')
    (data / "20261123_hold.log").write_bytes(b"(1.0) can0 181#00\n" + TOKEN.encode())
    (data / "20261123_hold.estimates.json").write_text(json.dumps({"methods": {}, "note": TOKEN}))
    return ["bundle", str(file), "--data", str(data), "--log", str(log), "--socket", str(tmp_path / "none.sock")]


def test_no_byte_of_a_planted_secret_is_in_the_archive(planted: list[str], tmp_path: Path) -> None:
    target = tmp_path / "out.tar.gz"
    done = CliRunner().invoke(app, [*planted, "--output", str(target)])
    assert done.exit_code == 0, done.output
    found = contents(target)
    everything = b"\n".join(
        [*found.values(), *(name.encode() for name in found), target.read_bytes(), done.output.encode()]
    )
    for secret in PLANTED:
        plain = secret.encode()
        for form in (plain, quote(secret, safe="").encode(), json.dumps(secret)[1:-1].encode(), plain.hex().encode()):
            assert form not in everything, form
    assert base64.b64encode(f"upright:{BROKER}".encode())[12:24] not in everything
    assert b"the control loop missed 3 cycles" in found["logs/daemon.log"]
    assert b"1883" in found["logs/daemon.log"], "what is no secret stays"
    assert json.loads(found["configuration/vehicle.json"])["mqtt"]["broker"] == "127.0.0.1:1"
    assert "recordings/20261123_hold.log" not in found, "a recording that holds a secret is left out"
    assert "recordings/20261123_hold.arrow" in found
    assert "it holds a secret" in done.output


def test_password_file_of_a_vehicle_file_with_a_mistake_is_read(planted: list[str], tmp_path: Path) -> None:
    file, target = Path(planted[1]), tmp_path / "out.tar.gz"
    file.write_text(file.read_text().replace("[mqtt]", "[mqtt]\nmistaken = 1", 1))
    done = CliRunner().invoke(app, [*planted, "--output", str(target)])
    assert done.exit_code == 0, done.output
    found = contents(target)
    assert "configuration/vehicle.json" not in found
    assert "mistaken" in json.loads(found["doctor.json"])["checks"][3]["text"]
    assert not any(BROKER.encode() in content for content in found.values())


def test_everything_that_helps_is_in_the_archive_and_listed(planted: list[str], tmp_path: Path) -> None:
    target = tmp_path / "out.tar.gz"
    done = CliRunner().invoke(app, [*planted, "--output", str(target), "--recordings", "2", "--json"])
    found = contents(target)
    names = {"doctor.json", "status.json", "versions.json", "configuration/vehicle.json", "logs/daemon.log"}
    assert names | {"models/monocab.toml", "configuration/environment.json"} <= set(found)
    assert {name for name in found if name.endswith(".arrow")} == {f"recordings/2026112{n}_hold.arrow" for n in (2, 3)}
    listed = {each["file"]: each for each in json.loads(found["contents.json"])["packed"]}
    assert set(listed) == set(found) - {"contents.json"}
    assert all(listed[name]["bytes"] == len(found[name]) for name in listed)
    document = json.loads(done.stdout)
    assert set(document["packed"]) == set(listed)
    assert document["bytes"] == target.stat().st_size
    assert (
        any(each["file"] == "configuration/unit.txt" for each in document["left_out"])
        or "configuration/unit.txt" in found
    )
    assert json.loads(found["doctor.json"])["facts"]["disk"]["folder"]
    assert json.loads(found["versions.json"])["numpy"]
    assert target.stat().st_mode & 0o777 == 0o600


def test_archive_stays_below_its_limit_and_says_what_did_not_fit(data: Path, tmp_path: Path) -> None:
    newest = data / "20261123_hold.arrow"
    newest.write_bytes(os.urandom(900_000))
    packed = pack(tmp_path / "a.tar.gz", Wanted(data, 4, 1_000_000, environment={}), {})
    found = contents(packed.path)
    assert packed.size == packed.path.stat().st_size <= 1_000_000
    assert "recordings/20261123_hold.arrow" in found
    left_out = {each["file"] for each in packed.left_out}
    newest.write_bytes(os.urandom(990_000))
    packed = pack(tmp_path / "b.tar.gz", Wanted(data, 4, 1_000_000, environment={}), {})
    assert "recordings/20261123_hold.arrow" in {each["file"] for each in packed.left_out} - left_out
    assert "recordings/20261120_hold.arrow" in contents(packed.path), "smaller ones still fit"


def test_links_and_devices_are_not_followed(data: Path, tmp_path: Path) -> None:
    (tmp_path / "private").write_text("nobody's business")
    for suffix in (".arrow", ".log", ".estimates.json"):
        (data / f"20261129_evil{suffix}").symlink_to(tmp_path / "private")
    os.mkfifo(data / "20261130_pipe.arrow")
    packed = pack(tmp_path / "a.tar.gz", Wanted(data, 9, 10_000_000, environment={}), {})
    assert not any(b"nobody's business" in content for content in contents(packed.path).values())
    reasons = {each["file"]: each["why"] for each in packed.left_out}
    assert reasons["recordings/20261129_evil.arrow"] == "it is a link"
    assert reasons["recordings/20261130_pipe.arrow"] == "it is no ordinary file"


def test_long_log_keeps_its_end(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("upright.service.doctor.bundle.LARGEST_TEXT", 1000)
    log = tmp_path / "long.log"
    log.write_text("old\n" * 10_000 + "the end\n")
    packed = pack(tmp_path / "a.tar.gz", Wanted(data, 0, 10_000_000, (log,), environment={}), {})
    kept = contents(packed.path)["logs/long.log"]
    assert len(kept) == 1000
    assert kept.endswith(b"the end\n")
    assert any("its beginning" in each["file"] for each in packed.left_out)


def test_archive_that_cannot_be_written_leaves_nothing(data: Path, tmp_path: Path) -> None:
    with pytest.raises(BundleError, match="--output"):
        pack(tmp_path / "none" / "a.tar.gz", Wanted(data, 0, 1_000_000, environment={}), {})
    assert list(tmp_path.glob("*.gz*")) == []
    (tmp_path / "there.tar.gz").write_text("mine")
    words = ["bundle", "--output", str(tmp_path / "there.tar.gz"), "--data", str(data)]
    assert CliRunner().invoke(app, words).exit_code == 2
    assert (tmp_path / "there.tar.gz").read_text() == "mine"


def test_files_with_secrets_that_cannot_be_read_are_named(tmp_path: Path, data: Path) -> None:
    file = load("monocab")
    mqtt = file.mqtt.model_copy(update={"broker": "h:1", "password_file": str(tmp_path / "gone")})
    wanted = Wanted(data, 0, 1_000_000, vehicle=file.model_copy(update={"mqtt": mqtt}), environment={})
    packed = pack(tmp_path / "a.tar.gz", wanted, {})
    assert "gone: No such file" in json.loads(contents(packed.path)["contents.json"])["not_known"][0]


SECRET = st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Z")), min_size=4, max_size=24)


@given(SECRET, st.text(max_size=40), st.text(max_size=40))
def test_known_secret_is_removed_wherever_it_stands(secret: str, before: str, after: str) -> None:
    redactor = Redactor([secret])
    shown = f"{before} {secret} {after}"
    texts = [redactor.text(shown), redactor.document({"a": [shown]})["a"][0], *redactor.document({shown: 1})]
    assert not [text for text in texts if secret in text.replace(REMOVED, " ")]
    assert redactor.holds_known(shown.encode())


@pytest.mark.parametrize(
    "line",
    [
        "the control loop missed 3 cycles",
        "unexpected token in the file",
        "bandpass: 5 Hz, compass, author: anna",
        "-> sudo ip link set can0 up txqueuelen 100 type can bitrate 1000000",
        "http://127.0.0.1:8765/metrics",
    ],
)
def test_harmless_line_stays_as_it_is(line: str) -> None:
    assert Redactor(["s3cret"]).text(line) == line


def test_files_with_secrets_are_found_on_command_lines_and_in_variables() -> None:
    words = ["upright", "dashboard", "--password-file", "/a", "--port", "1", "--token-file=/b"]
    assert files_on(words) == {"/a", "/b"}
    assert files_of({"MQTT_PASSWORD_FILE": "/c", "MQTT_PASSWORD": "d", "LOG_FILE": "/e"}) == {"/c"}
    assert of_environment({"MQTT_PASSWORD_FILE": "/c", "MQTT_PASSWORD": "d", "LOG_FILE": "/e"}) == {"d"}
