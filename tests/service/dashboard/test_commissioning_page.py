"""The view Commissioning in a real browser: a broker, the page's server, and a vehicle that says what the test wants.

The command line of a job is replaced by a process that waits for its answer. Screenshots go to the folder
UPRIGHT_ARTIFACTS, or .pytest_cache/dashboard.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import paho.mqtt.client as mqtt
import pytest
from playwright.sync_api import Browser, Page, expect
from served import TOKEN, free_port, listening, served
from watched import Watched, chromium

from upright.service.dashboard import jobs
from upright.service.dashboard.app import Dashboard, Settings
from upright.service.mqtt import topics
from upright.vehicles import commissioning
from upright.vehicles.commissioning import Entry, State, Steps
from upright.vehicles.file import load

pytestmark = [pytest.mark.browser, pytest.mark.timeout(180)]

BASE = "upright/monocab"
RECORDING = "20260101-101500_tilt.arrow"
STEPS = Steps.model_validate({
    "step": [
        {
            "id": "wiring",
            "title": "Every device answers",
            "why": "A device that is missing, or has another firmware, would be found when the vehicle is up.",
            "why_now": "It needs no motion, and everything else needs the devices.",
            "evaluate": "wiring",
            "acceptance": [
                {"quantity": "answered", "title": "Devices that answer", "least": 5, "most": 5, "remedy": "See bus."}
            ],
        },
        {
            "id": "imu_rest",
            "title": "Noise, bias and axes of the IMU",
            "why": "The roll filter takes its noise and its axes from the vehicle file.",
            "why_now": "It is the sensor that all later steps look through.",
            "needs": ["wiring"],
            "prepare": "The vehicle lies on its left support. Nobody touches it.",
            "experiment": "rest",
            "evaluate": "imu_rest",
            "acceptance": [
                {"quantity": "noise", "title": "Noise of the gyro", "unit": "rad/s", "most": 0.002,
                 "remedy": "Look for vibration: are the flywheels off?"}
            ],
        },
        {
            "id": "gyro",
            "title": "Sign and scale of the gyro",
            "why": "With the wrong sign the controller drives the vehicle onto its support with full force.",
            "why_now": "The axes are known, and the drives are still off.",
            "needs": ["imu_rest"],
            "prepare": "One person is at the vehicle, and tilts it over when the page says so.\nThe drives are off.",
            "experiment": "tilt",
            "evaluate": "gyro",
            "of": ["imu_rest"],
            "acceptance": [
                {"quantity": "scale", "title": "Integrated rate over the change of the angle",
                 "least": 0.97, "most": 1.03,
                 "remedy": "Correct imu.axes, or the unit of the angular rate; then repeat this step."},
                {"quantity": "acceleration", "title": "Acceleration at rest", "unit": "m/s^2",
                 "least": 9.7, "most": 9.9, "remedy": "Check acceleration_sign."},
            ],
        },
        {
            "id": "drives",
            "title": "Speed loops of the drives",
            "why": "The controller assumes how fast a drive follows.",
            "why_now": "Sensor and signs are known.",
            "needs": ["gyro"],
            "experiment": "drives",
            "evaluate": "drives",
        },
        {
            "id": "report",
            "title": "Report",
            "why": "Whoever takes over the vehicle reads what was checked.",
            "why_now": "Everything else is done.",
            "needs": ["drives"],
            "evaluate": "report",
        },
    ]
})  # fmt: skip

NUMBERS = {
    "scale": {"value": -1.0123456, "std": 0.0034, "unit": "1"},
    "acceleration": {"value": 9.8123, "std": 0.002, "unit": "m/s^2"},
    "tilt": {"value": 8.01, "std": 0.05, "unit": "deg"},
}
BEGIN = Entry(date="2026-01-01 09:00:00")
WIRING = Entry(
    step="wiring", state=State.ACCEPTED, date="2026-01-01 09:20:11", by="mqtt operator",
    text=["All five devices answer."], numbers={"answered": {"value": 5.0}},
)  # fmt: skip
REST = Entry(
    step="imu_rest", state=State.SKIPPED, date="2026-01-01 09:40:00", by="cli", reason="measured in the workshop"
)
WRONG = Entry(
    step="gyro", state=State.NOT_ACCEPTED, date="2026-01-01 10:15:40", by="page-17", numbers=NUMBERS,
    text=["The gyro turns against the accelerometer: its sign is wrong."],
    recording=f"/data/{RECORDING}", files={"commissioning/gyro.html": "ab" * 32, "commissioning/gyro.toml": "cd" * 32},
)  # fmt: skip
RIGHT = Entry(**{
    **WRONG.model_dump(), "state": State.ACCEPTED, "text": [],
    "numbers": NUMBERS | {"scale": {"value": 1.0021, "std": 0.0034, "unit": "1"}},
})  # fmt: skip
DONE = [RIGHT, Entry(step="drives", state=State.ACCEPTED),
        Entry(step="report", state=State.ACCEPTED, files={"commissioning/report.html": "ef" * 32})]  # fmt: skip

STUB = """
import json, pathlib, sys, time
folder = pathlib.Path(sys.argv[1])
(folder / "words").write_text(json.dumps(sys.argv[2:]))
while not (folder / "answer").exists():
    time.sleep(0.02)
answer = (folder / "answer").read_text()
(folder / "answer").unlink()
print(json.dumps({"type": "progress", "fraction": 0.5}))
print(answer)
"""
"""In place of the command line: waits for its answer."""


class Vehicle:
    """What a daemon publishes, as the test wants it; commands are kept, an experiment is accepted at once."""

    def __init__(self, port: int) -> None:
        self.commands: list[dict[str, Any]] = []
        self.client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2)
        self.client.on_message = self._on_message
        self.client.connect("127.0.0.1", port)
        self.client.subscribe(f"{BASE}/cmd/anyone/experiment", qos=1)
        self.client.loop_start()
        self.publish("status", "online")
        self.say()

    def publish(self, topic: str, payload: object) -> None:
        """Publish a retained message; None removes it."""
        text = payload if isinstance(payload, str) else "" if payload is None else json.dumps(payload)
        self.client.publish(f"{BASE}/{topic}", text, qos=1, retain=True).wait_for_publish(10.0)

    def say(self, **changes: Any) -> None:
        """The state: ready for an experiment, with these changes."""
        ready = {
            "vehicle": "monocab", "mode": "disarmed", "experiment": None, "phase": "none",
            "load": None, "tilt": None, "spin": None,
            "code": "", "reason": "", "interlocks": [], "stays_down": [],
            "faults": [], "version": "0", "since": 1.0, "held_by": None,
            "commands": True,
        }  # fmt: skip
        self.publish("state", topics.State.model_validate(ready | changes).model_dump())

    def record(self, *entries: Entry) -> None:
        """What has been done of the commissioning."""
        message = STEPS.to_json([BEGIN, *entries])
        self.publish("commissioning", topics.Commissioning.model_validate(message).model_dump())

    def finish(self, **reply: Any) -> None:
        """The last reply to the experiment."""
        command = self.commands[-1]
        whole = {"id": command["id"], "code": "done", "text": "", "done": True, **reply}
        self.client.publish(f"{BASE}/reply/anyone/{command['client']}", json.dumps(whole), qos=1).wait_for_publish(10.0)

    def _on_message(self, client: mqtt.Client, _: object, message: mqtt.MQTTMessage) -> None:
        command = json.loads(message.payload)
        reply = {"id": command["id"], "ok": True, "code": "accepted", "text": "", "done": False}
        client.publish(f"{BASE}/reply/anyone/{command['client']}", json.dumps(reply), qos=1)
        self.commands.append(command)


class Process:
    """The process in place of a job."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def words(self) -> list[str]:
        """Wait for it to be started: its command line, up to its options for the daemon."""
        end = time.monotonic() + 30.0
        while time.monotonic() < end:
            if (self.folder / "words").exists():
                words: list[str] = json.loads((self.folder / "words").read_text() or "[]")
                if words:
                    (self.folder / "words").unlink()
                    assert words[-1] == "--json"
                    return words[: words.index("--vehicle")]
            time.sleep(0.05)
        raise AssertionError("no job was started")

    def answer(self, text: str, exit_code: int = 0) -> None:
        part = self.folder / "part"
        part.write_text(json.dumps({"type": "result", "exit_code": exit_code, "text": text}))
        part.rename(self.folder / "answer")


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as launched:
        yield launched


@pytest.fixture(scope="module")
def ports(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[int, int]]:
    """mosquitto without passwords: its ports for MQTT and for websockets."""
    command = shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin")
    if command is None:
        pytest.skip("no mosquitto here: apt-get install mosquitto")
    plain, websocket = free_port(), free_port()
    file = tmp_path_factory.mktemp("broker") / "mosquitto.conf"
    file.write_text(
        f"allow_anonymous true\nlistener {plain} 127.0.0.1\nlistener {websocket} 127.0.0.1\nprotocol websockets\n"
        "log_type error\n" + ("user root\n" if os.geteuid() == 0 else "")
    )
    with subprocess.Popen([command, "-c", file]) as process:
        try:
            listening(plain, websocket)
            yield plain, websocket
        finally:
            process.kill()


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    (folder / RECORDING).touch()
    (folder / "commissioning").mkdir()
    (folder / "commissioning" / "gyro.html").write_text("<p>The gyro</p>")
    return folder


@pytest.fixture(scope="module")
def address(ports: tuple[int, int], data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(commissioning, "steps_of", lambda kind: STEPS)
        patch.setattr(jobs, "UPRIGHT", (sys.executable, "-c", STUB, str(data)))
        with served(Dashboard(Settings(load("monocab"), data, f"ws://127.0.0.1:{ports[1]}", token=TOKEN))) as made:
            yield f"{made}#token={TOKEN}"


@pytest.fixture(scope="module")
def vehicle(ports: tuple[int, int]) -> Iterator[Vehicle]:
    made = Vehicle(ports[0])
    yield made
    made.client.loop_stop()
    made.client.disconnect()


@pytest.fixture
def process(data: Path) -> Process:
    for name in ("words", "answer"):
        (data / name).unlink(missing_ok=True)
    return Process(data)


@pytest.fixture
def watched(browser: Browser, address: str, vehicle: Vehicle) -> Iterator[Watched]:
    """The view of a vehicle of which two steps are done."""
    vehicle.say()
    vehicle.record(WIRING, REST)
    context = browser.new_context(viewport={"width": 1280, "height": 900}, color_scheme="light")
    made = Watched(context, f"{address}&commissioning", link=None)
    expect(made.page.locator("#next-step")).to_be_visible()
    yield made
    assert made.errors == []
    context.close()


@pytest.fixture(scope="module")
def picture(pytestconfig: pytest.Config) -> Callable[[Watched, str], None]:
    """Takes pictures of a page: wide, dark and narrow. The page has to fit."""
    folder = Path(os.environ.get("UPRIGHT_ARTIFACTS") or pytestconfig.rootpath / ".pytest_cache" / "dashboard")
    folder.mkdir(parents=True, exist_ok=True)

    def take(watched: Watched, name: str) -> None:
        page = watched.page
        for look, width, scheme in (("wide", 1280, "light"), ("dark", 1280, "dark"), ("narrow", 360, "light")):
            page.set_viewport_size({"width": width, "height": 800})
            page.emulate_media(color_scheme=scheme)  # type: ignore[arg-type]
            watched.picture(folder / f"commissioning-{name}-{look}.png")
            wide = page.evaluate("document.documentElement.scrollWidth")
            assert wide <= width, f"{name} is {wide} px wide of {width}"
        page.set_viewport_size({"width": 1280, "height": 900})
        page.emulate_media(color_scheme="light")

    return take


def start(watched: Watched, vehicle: Vehicle) -> None:
    """Start the experiment of the next step, and wait until it is accepted."""
    before, end = len(vehicle.commands), time.monotonic() + 20.0
    watched.page.click("#carry-out")
    while len(vehicle.commands) == before:
        assert time.monotonic() < end, "the page sent no command"
        time.sleep(0.02)
    expect(watched.page.locator("#step-running")).to_be_visible()


Picture = Callable[[Watched, str], None]


def test_next_step_is_shown_with_its_reasons_limits_and_one_button(watched: Watched, picture: Picture) -> None:
    page = watched.page
    card = page.locator("#next-step")
    expect(card.get_by_role("heading", name="Sign and scale of the gyro open")).to_be_visible()
    for words in ("Next: step 3 of 5", "full force", "Why now: The axes are known", "tilts it over when",
                  "0.97 to 1.03", "9.7 to 9.9 m/s²", "stays on its support", "drives off"):  # fmt: skip
        expect(card).to_contain_text(words)
    expect(page.locator("#carry-out")).to_have_text("Run and evaluate")
    assert page.locator("#next-step button.primary").count() == 1
    badges = page.locator("#steps > li > details > summary .badge")
    expect(badges).to_have_text(["✓ accepted", "skipped", "open", "waiting", "waiting"])
    picture(watched, "next")


def test_steps_unfold_repeat_and_name_what_they_wait_for(watched: Watched, process: Process, picture: Picture) -> None:
    page = watched.page
    for each in ("wiring", "imu_rest", "drives"):
        page.click(f"#steps details[data-step={each}] > summary")
    expect(page.locator("#steps [data-step=imu_rest]")).to_contain_text("Skipped: measured in the workshop")
    waiting = page.locator("#steps [data-step=drives]")
    expect(waiting.get_by_role("button")).to_be_disabled()
    expect(waiting.get_by_role("button")).to_have_attribute("title", "Waits for 3. Sign and scale of the gyro")
    expect(waiting).to_contain_text("Waits for 3. Sign and scale of the gyro.")
    picture(watched, "list")
    page.locator("#steps [data-step=wiring]").get_by_role("button", name="Repeat").click()
    assert process.words() == ["commission", "--step", "wiring", "--yes"]
    expect(page.locator("#next-step")).to_contain_text("Again: step 1 of 5")
    expect(waiting.get_by_role("button")).to_have_attribute("title", "A step is being carried out")
    process.answer("Accepted.")
    expect(page.locator("#step-outcome")).to_contain_text("1. Every device answers ✓ accepted")
    expect(page.locator("#step-outcome")).to_contain_text("All five devices answer.")
    expect(page.locator("#next-title")).to_contain_text("Sign and scale of the gyro")
    page.click("#step-outcome >> text=Close")
    expect(page.locator("#step-outcome")).to_have_count(0)


def test_step_runs_its_experiment_and_shows_what_is_wrong(
    watched: Watched, vehicle: Vehicle, process: Process, picture: Picture
) -> None:
    page = watched.page
    start(watched, vehicle)
    expect(page.locator("#next-title .badge")).to_have_text("under way")
    expect(page.locator("#carry-out")).to_have_count(0)
    assert vehicle.commands[-1]["arguments"] == {"name": "tilt"}
    ask = "Tilt the vehicle over to its other support now, slowly, and let go there"
    running = {"mode": "running", "experiment": "tilt", "phase": "at rest", "held_by": "x"}
    vehicle.say(**running, tilt={"duration": 5.0, "announcement": ask})
    vehicle.publish("progress", {"task": "tilt", "fraction": 0.4, "remaining": 8.4})
    expect(page.get_by_role("alert").filter(has_text=ask)).to_be_visible()
    expect(page.locator("#step-running")).to_contain_text("40 %, 8 s left")
    expect(page.locator("#step-progress")).to_have_attribute("value", "0.4")
    picture(watched, "tilt")
    vehicle.say()
    expect(page.locator("#announcement")).to_be_hidden()
    vehicle.finish(ok=True, recording=f"/somewhere/{RECORDING}")
    words = process.words()
    assert words[:4] == ["commission", "--step", "gyro", "--recording"]
    assert (Path(words[4]).name, words[5:]) == (RECORDING, ["--yes"])
    expect(page.locator("#step-busy")).to_contain_text(f"Evaluating {RECORDING}, 1 s …")
    expect(page.locator("#step-busy").get_by_role("button", name="Cancel")).to_be_visible()
    picture(watched, "evaluating")
    vehicle.record(WIRING, REST, WRONG)
    process.answer("Sign and scale of the gyro: not accepted.", exit_code=1)
    card = page.locator("#next-step")
    expect(card).to_contain_text("Sign and scale of the gyro: not accepted.")
    expect(card.locator("#next-title .badge")).to_have_text("✗ not accepted")
    scale = card.get_by_role("row").filter(has_text="Integrated rate")
    expect(scale).to_contain_text("-1.0123 ± 0.0034 ✗ outside")
    expect(card.get_by_role("row").filter(has_text="Acceleration at rest")).to_contain_text(
        "9.8123 ± 0.0020 m/s² ✓ within"
    )
    expect(card.locator(".remedies")).to_contain_text("Correct imu.axes")
    expect(card.locator(".remedies")).not_to_contain_text("acceleration_sign")
    expect(card).to_contain_text("its sign is wrong")
    expect(card.get_by_role("link", name=RECORDING)).to_have_attribute("href", f"api/recordings/{RECORDING}/recording")
    link = card.get_by_role("link", name="gyro.html").get_attribute("href")
    assert page.request.get(f"{page.url.partition('#')[0]}{link}").text() == "<p>The gyro</p>"
    expect(page.locator("#carry-out")).to_be_enabled()
    picture(watched, "not-accepted")
    vehicle.record(WIRING, REST, RIGHT)
    expect(page.locator("#step-outcome h2")).to_have_text("3. Sign and scale of the gyro ✓ accepted")
    expect(page.locator("#next-title")).to_contain_text("Speed loops of the drives")
    picture(watched, "accepted")


@pytest.mark.parametrize(
    ("reply", "words"),
    [
        ({"ok": True, "text": "an operator requested the end", "recording": RECORDING}, "ended early: an operator"),
        ({"ok": False, "text": "the roll angle is 6 deg", "recording": RECORDING}, "failed: the roll angle is 6 deg"),
        ({"ok": True}, "there is no recording"),
    ],
    ids=["ended early", "failed", "not recorded"],
)
def test_experiment_that_did_not_do_what_it_should_is_not_evaluated(
    reply: dict[str, Any], words: str, watched: Watched, vehicle: Vehicle, process: Process
) -> None:
    page = watched.page
    start(watched, vehicle)
    vehicle.finish(**reply)
    expect(page.locator("#step-busy").get_by_role("alert")).to_contain_text(words)
    expect(page.locator("#step-busy")).to_contain_text("Not evaluated")
    expect(page.locator("#step-running")).to_be_hidden()
    expect(page.locator("#carry-out")).to_be_enabled()
    assert not (process.folder / "words").exists()


def test_evaluation_is_cancelled_and_done_again_without_the_experiment(
    watched: Watched, vehicle: Vehicle, process: Process
) -> None:
    page = watched.page
    start(watched, vehicle)
    before = len(vehicle.commands)
    vehicle.finish(ok=True, recording=RECORDING)
    process.words()
    page.click("#step-busy >> text=Cancel")
    expect(page.locator("#step-busy").get_by_role("alert")).to_contain_text("cancelled")
    page.click("text=Evaluate this recording again")
    assert process.words()[4].endswith(RECORDING)
    process.answer("Accepted.")
    expect(page.locator("#step-busy")).to_have_text("Accepted.")
    assert len(vehicle.commands) == before


def test_step_is_not_skipped_without_a_reason(watched: Watched, vehicle: Vehicle, process: Process) -> None:
    page = watched.page
    expect(page.locator("#skip-form")).to_be_hidden()
    page.click("#skip")
    expect(page.locator("#skip-reason")).to_be_focused()
    for words in ("", "no", "   \n "):
        page.fill("#skip-reason", words)
        expect(page.locator("#skip-send")).to_be_disabled()
    page.fill("#skip-reason", "The gyro was calibrated by its maker")
    vehicle.record(WIRING, REST.model_copy(update={"reason": "another one"}))  # a message must not disturb
    expect(page.locator("#steps [data-step=imu_rest]")).to_contain_text("another one")
    expect(page.locator("#skip-reason")).to_have_value("The gyro was calibrated by its maker")
    expect(page.locator("#skip-reason")).to_be_focused()
    page.click("#skip-send")
    assert process.words() == ["commission", "--skip", "gyro", "--reason=The gyro was calibrated by its maker"]
    process.answer("Skipped.")
    vehicle.record(WIRING, REST, Entry(step="gyro", state=State.SKIPPED, reason="The gyro was calibrated by its maker"))
    expect(page.locator("#step-outcome")).to_contain_text("Skipped: The gyro was calibrated by its maker")
    expect(page.locator("#next-title")).to_contain_text("Speed loops of the drives")
    expect(page.locator("#skip-form")).to_be_hidden()


@pytest.mark.parametrize(
    ("state", "why"),
    [
        ({"commands": False}, "Commands over MQTT are off"),
        ({"interlocks": ["Drive gimbal_front does not answer."]}, "Drive gimbal_front does not answer."),
        ({"mode": "running", "experiment": "hold"}, "An experiment is running"),
    ],
    ids=["commands off", "interlock", "running"],
)
def test_interlocks_hold_only_steps_with_an_experiment(
    state: dict[str, Any], why: str, watched: Watched, vehicle: Vehicle
) -> None:
    page = watched.page
    vehicle.say(**state)
    button = page.locator("#carry-out")
    expect(button).to_be_disabled()
    assert why in (button.get_attribute("title") or "")
    expect(page.locator("#why-not")).to_contain_text(why.removesuffix("."))
    expect(page.locator("#skip")).to_be_enabled()
    vehicle.record()
    expect(page.locator("#next-title")).to_contain_text("Every device answers")
    expect(button).to_be_enabled()


def test_refusal_of_a_job_is_shown(watched: Watched, vehicle: Vehicle) -> None:
    page = watched.page
    start(watched, vehicle)
    vehicle.finish(ok=True, recording="gone.arrow")
    expect(page.locator("#step-busy").get_by_role("alert")).to_contain_text("there is no recording with that name")
    watched.errors.clear()  # the browser reports the refusal, too


def test_completed_commissioning_links_its_report_and_begins_a_new_one(
    watched: Watched, vehicle: Vehicle, process: Process, picture: Picture
) -> None:
    page = watched.page
    vehicle.record(WIRING, REST, *DONE)
    done = page.locator("#completed")
    expect(done).to_contain_text("All steps are done")
    expect(done).to_contain_text("4 accepted, 1 skipped with a reason")
    expect(done.get_by_role("link", name="report.html")).to_have_attribute("href", "commissioning/report.html")
    picture(watched, "completed")
    expect(page.locator("#begin-sure")).to_be_hidden()
    page.click("#begin")
    page.click("#begin-sure")
    assert process.words() == ["commission", "--begin"]
    expect(page.locator("#completed")).to_contain_text("Beginning")
    expect(page.locator("#begin")).to_be_disabled()
    vehicle.record()
    process.answer("Begun.")
    expect(page.locator("#next-title")).to_contain_text("Every device answers")


def test_vehicle_without_steps_has_its_experiments_alone(
    browser: Browser, address: str, vehicle: Vehicle, picture: Picture
) -> None:
    """Also under the earlier name of the view. The cards say which experiments do not get up."""
    vehicle.publish("commissioning", None)
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    watched = Watched(context, f"{address}&experiments", link=None)
    page = watched.page
    expect(page.locator("#tab-commissioning")).to_have_attribute("aria-selected", "true")
    expect(page.locator("[data-experiment=hold]")).to_be_enabled()
    assert page.locator("#all-experiments, #next-step, #steps").count() == 0
    card = page.locator("#view-commissioning li.card")
    for name, words in (
        ("tilt", "14 s, drives off, tilted over by hand after 2 s, in 5 s"),
        ("silence", "3 s, no setpoints and no heartbeat for 0.5 s"),
        ("trim", "30 s, sine, amplitude 0.05 m/s, 0.2 Hz"),
        ("drives", "16 s, square of the drives, amplitude 0.08 rad/s, 0.5 Hz"),
    ):
        its = card.filter(has=page.locator(f"[data-experiment={name}]"))
        expect(its).to_contain_text(words)
        assert its.get_by_text("stays on its support", exact=True).count() == (name != "trim")
    picture(watched, "experiments")
    assert watched.errors == []
    context.close()


def test_hostile_and_malformed_steps(watched: Watched, vehicle: Vehicle) -> None:
    """Markup is text; a message of another shape is ignored."""
    page = watched.page
    hostile = "<img src=x onerror=window.hacked=1>"
    vehicle.record(WIRING, REST, WRONG.model_copy(update={"text": [hostile], "files": {f"{hostile}.html": "00"}}))
    expect(page.locator("#next-step")).to_contain_text(hostile)
    assert page.evaluate("window.hacked") is None
    assert page.locator("#view-commissioning img").count() == 0
    for message in ({"steps": []}, {"steps": [{"id": 3}], "next": None}, {"steps": "x"}, {"next": "x"}):
        vehicle.publish("commissioning", message)
    expect(page.locator("#ignored")).to_have_attribute("data-count", "4")
    expect(page.locator("#next-step")).to_contain_text(hostile)


def test_view_is_used_by_keyboard(watched: Watched, vehicle: Vehicle, process: Process) -> None:
    page: Page = watched.page
    vehicle.record()
    expect(page.locator("#next-title")).to_contain_text("Every device answers")
    page.focus("#tab-commissioning")
    page.keyboard.press("Tab")
    expect(page.locator("#carry-out")).to_be_focused()
    page.keyboard.press("Enter")
    process.words()
    expect(page.get_by_role("button", name="Cancel")).to_be_visible()
    vehicle.record(WIRING)
    process.answer("Accepted.")
    # Not the next button: a second Enter must not start what follows.
    expect(page.locator("#step-outcome h2")).to_be_focused()
