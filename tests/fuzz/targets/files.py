"""Files that people write and programs keep: vehicle, model, data sheet, result, record."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from model_files import BUMP

from fuzz.mutation import anything, exchanged, mutated
from fuzz.target import Target, of_file
from fuzz.targets.equations import TOWERS
from fuzz.trial import REPOSITORY
from upright.drivers.cia402 import eds
from upright.models import library, rendering
from upright.models.file import model_file
from upright.models.file.own_effects import load_effect
from upright.service.control import assembly
from upright.service.control.adopted import History
from upright.service.control.commissioned import Record
from upright.service.control.cycle.sequence import plan
from upright.service.offline.design import read_result
from upright.vehicles import registry
from upright.vehicles.file import load

VALUES = (
    *(b"nan", b"inf", b"-inf", b"1e999", b"-1", b"0", b"-0.0", b"0.5", b"1e-320", b"1e308", b"9" * 22, b"9" * 5000),
    *(b"true", b'""', b"[]", b"{}", b"[[[[[]]]]]", b"1979-05-27", b"1979-05-27T07:32:00Z", b'"../../etc/passwd"'),
    *(
        b'"\\u0000"',
        b'"' + b"a" * 100_000 + b'"',
        b"[" * 500 + b"]" * 500,
        b"{ a = 1 }",
        b'["x", 1]',
        b'"/"',
        b'"nul\\n"',
    ),
    *(json.dumps(tower).encode() for tower in TOWERS if len(tower) < 1000),
)
DEEP = (
    b"a=" + b"[" * 5000 + b"]" * 5000,
    b"a." * 20_000 + b"b=1",
    b"[" + b"a." * 5000 + b"b]\n",
    b"a = { " + b"b = { " * 2000 + b"}" * 2001,
    b'x="""' + b"\\" * 100_001 + b'"""',
    b"a." * 300 + b"b=1\n" + b"c." * 300 + b"d=1\n",
    b"",
    b"\xff\xfe",
)


def toml(seeds: Callable[[], Sequence[bytes]]) -> Callable[[], st.SearchStrategy[bytes]]:
    """Inputs near the `seeds`, which are TOML."""
    tokens = (*(value for value in VALUES if len(value) < 2000), b"[a]\n", b"[[effects]]\n", b"a.b.c = 1\n", b"\\u0000")

    def inputs() -> st.SearchStrategy[bytes]:
        keys = st.lists(st.sampled_from(["a", "b", '"a b"', "0"]), min_size=1, max_size=4000)
        deep = st.tuples(keys, st.sampled_from(VALUES)).map(lambda each: ".".join(each[0]).encode() + b" = " + each[1])
        return st.one_of(exchanged(seeds(), VALUES), exchanged(seeds(), VALUES), anything(seeds(), tokens), deep)

    return inputs


# Vehicle files


@cache
def vehicles() -> list[bytes]:
    """Those that are shipped."""
    return [(REPOSITORY / "vehicles" / name / "vehicle.toml").read_bytes() for name in registry.names()]


WILD = b"\n".join(
    b"bias_random_walk = 1e308" if line.startswith(b"bias_random_walk") else line for line in vehicles()[0].split(b"\n")
)
"""A number whose square is not finite."""


def check_vehicle(path: Path) -> None:
    """As `upright config check`, without the design of the controller, which takes long."""
    vehicle = load(str(path))
    kind = registry.kind_of(vehicle, assembly.vehicle_io(vehicle))
    assembly.roll_filter(vehicle)
    assembly.bus_load(vehicle)
    pilot = kind.pilot()
    for name in vehicle.experiments:
        plan(vehicle, name, pilot, kind.angle)


# Model files


REVISED = b"""base = "monocab_roll"

[[effects]]
name = "static_torque"
[effects.parameters]
torque = { value = 3.0, std = 1.0 }

[[history]]
action = "add"
effect = "static_torque"
date = 2026-01-01
error_before = 1.0
error_after = 0.5
"""


@cache
def models() -> list[bytes]:
    return [*(each.read_bytes() for each in sorted((REPOSITORY / "examples").glob("*.toml"))), REVISED]


def check_model(path: Path) -> None:
    """Read it, and write it beside: what is read back is the same."""
    file = model_file.read(path)
    rendering.equations(file.model)
    beside = path.with_name("beside.toml")
    beside.unlink(missing_ok=True)
    model_file.write(file, beside)
    assert model_file.read(beside) == dataclasses.replace(file), "written and read back, it is another model"


# Effects of one's own

EFFECT = BUMP.encode()


def check_effect(path: Path) -> None:
    """Read it, and put it into a model."""
    effect = load_effect(path)
    rendering.equations(library.get("monocab_roll").add(effect))


# Electronic data sheets


@cache
def sheets() -> list[bytes]:
    return [each.read_bytes() for each in sorted((REPOSITORY / "drivers" / "eds").glob("*.eds"))]


@cache
def drive() -> Any:
    vehicle = load("monocab")
    return assembly.drive_config(vehicle, vehicle.drive[0])


def check_eds(path: Path) -> None:
    eds.load(dataclasses.replace(drive(), eds=str(path)))


# JSON that is kept

ADOPTED = [
    {"source": "result.json", "sha256": "0" * 64, "values": {"inertia": 1600.0}, "deviations": {}, "date": "2026"}
]
ENTRIES = [
    {"step": "", "date": "2026-01-01 00:00:00"},
    {
        "step": "bus",
        "state": "accepted",
        "numbers": {"drives": {"value": 3, "std": 0.1, "unit": "1"}},
        "text": ["fine"],
    },
    {"step": "imu", "state": "skipped", "reason": "none here", "files": {"a": "0"}},
]
PARAMETERS = {"inertia": {"value": 1600.0, "std": 20.0}, "gravity_stiffness": {"value": 14e3, "std": 100.0}}
RESULT = {
    "best": "prediction_error",
    "methods": {
        "prediction_error": {
            "domain": "time",
            "parameters": PARAMETERS,
            "correlation": {"inertia": {"gravity_stiffness": 0.9}},
        },
        "drive_lag": {"domain": "drives", "parameters": {"speed_loop_lag": {"value": 0.02, "std": 0.001}}},
    },
}


def documents(*seeds: Any) -> Callable[[], st.SearchStrategy[bytes]]:
    """JSON near the `seeds`: bytes changed, and values exchanged for others."""
    written = [json.dumps(each).encode() for each in seeds]
    lines = [json.dumps(each, indent=1).encode() for each in seeds]
    values = (
        b"null,",
        b"[],",
        b"{},",
        b"NaN,",
        b"-Infinity,",
        b"1e999,",
        b'"x",',
        b"true,",
        b"-1,",
        b"1" * 5000 + b",",
        b"0,",
    )
    nested = st.integers(1, 100_000).map(lambda depth: b"[" * depth)
    tokens = [b"null", b"NaN", b"[", b"{", b"]", b"}", b'"', b"1e999", b"\\ud800", b"-1"]
    return lambda: st.one_of(
        mutated(written, tokens),
        exchanged(lines, values, b":"),
        exchanged(lines, [each[:-1] for each in values], b":"),
        nested,
    )


def check_adopted(path: Path) -> None:
    path.rename(path.with_name("controller.json"))
    History.read(path.parent).acting.of(load("monocab"))


def check_record(path: Path) -> None:
    path.rename(path.with_name("commissioning.json"))
    Record.read(path.parent, load("monocab")).to_json()


def check_result(path: Path) -> None:
    vehicle = load("monocab")
    result = read_result(path, vehicle)
    vehicle.with_values(result.values, result.deviations)


TARGETS = (
    Target(
        "vehicle", "a vehicle file", of_file(".toml", check_vehicle), toml(vehicles), lambda: [*vehicles(), WILD, *DEEP]
    ),
    Target("model", "a model file", of_file(".toml", check_model), toml(models), lambda: [*models(), *DEEP]),
    Target(
        "effect",
        "an effect of one's own",
        of_file(".toml", check_effect),
        toml(lambda: [EFFECT]),
        lambda: [EFFECT, *DEEP],
    ),
    Target(
        "eds",
        "an electronic data sheet",
        of_file(".eds", check_eds),
        lambda: st.one_of(
            anything(sheets()),
            exchanged(
                sheets(),
                (
                    b"",
                    b"0x",
                    b"-1",
                    b"0x" + b"F" * 5000,
                    b"$NODEID+",
                    b"%(a)s",
                    b"nan",
                    b"0xFFFFFFFFF",
                    b"ro",
                    b"7",
                    b"9" * 5000,
                ),
            ),
        ),
        lambda: [*sheets(), b"", b"[DeviceInfo]\n"],
        short=40,
    ),
    Target(
        "controllers",
        "the controllers that the daemon keeps",
        of_file(".json", check_adopted),
        documents(ADOPTED),
        lambda: [json.dumps(ADOPTED).encode(), b"[" * 100_000],
    ),
    Target(
        "record",
        "the record of a commissioning",
        of_file(".json", check_record),
        documents(ENTRIES),
        lambda: [json.dumps(ENTRIES).encode(), b"[" * 100_000],
    ),
    Target(
        "result",
        "a result of the identification",
        of_file(".json", check_result),
        documents(RESULT),
        lambda: [json.dumps(RESULT).encode(), b"[" * 100_000],
    ),
)
