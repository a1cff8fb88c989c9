"""Vehicle files: the shipped files load, and each error names its key and a remedy."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from upright.vehicles.file import VehicleFileError, load, schema, shipped, shipped_file

MONOCAB = (Path(__file__).parents[2] / "vehicles" / "monocab" / "vehicle.toml").read_text()


CANOPEN = 'protocol = "canopen"                # or "sequential"\nbase_id = 0x18A'
SEQUENTIAL = 'protocol = "sequential"\nbase_id = '


def changed(tmp_path: Path, old: str, new: str) -> str:
    """The path of a copy of the shipped file with one text replaced."""
    assert old in MONOCAB
    path = tmp_path / "mine.toml"
    path.write_text(MONOCAB.replace(old, new, 1))
    return str(path)


@pytest.mark.parametrize("name", shipped())
def test_shipped_files_load(name: str) -> None:
    vehicle = load(name)
    assert vehicle.vehicle.id == tomllib.loads(Path(vehicle.path).read_text())["vehicle"]["id"]
    assert len(vehicle.configuration_hash) == 16


def test_user_vehicle_file_loads_and_changes_the_hash(tmp_path: Path) -> None:
    path = changed(tmp_path, "roll_deg = 5.0", "roll_deg = 6.0")
    assert load(path).limits.roll_deg == 6.0
    assert load(path).configuration_hash != load("monocab").configuration_hash


@pytest.mark.parametrize(
    ("old", "new", "key", "said"),
    [
        ("master_node = 127", "master_nod = 127", "control.master_nod", "Did you mean 'master_node'?"),
        ("rate = 250 ", "rate = 240 ", "control.rate", "does not stream at 240 Hz"),
        ("heartbeat_timeout = 0.12", "heartbeat_timeout = 0.03", "control", "at least twice heartbeat_period"),
        ("support_deg = 4.0", "support_deg = 5.0", "limits", "resting on a support would be a fault"),
        ("precession_budget_deg = 45.0", "precession_budget_deg = 75.0", "limits", "cannot end in an orderly way"),
        ("precession_deg = 60.0", "precession_deg = 95.0", "limits.precession_deg", "below 90"),
        ("node = 2", "node = 1", "", "two drives have the same node id"),
        ("node = 2", "node = 127", "", "also the node id of a drive"),
        ("base_id = 0x18A", "base_id = 0x182", "", "is also a drive's node id"),
        (CANOPEN, SEQUENTIAL + "0x581", "", "frame 581h carries SDO answers of drive gimbal_left (node 1)"),
        (CANOPEN, SEQUENTIAL + "0x57F", "", "frame 581h carries SDO answers of drive gimbal_left"),
        (CANOPEN, SEQUENTIAL + "0x602", "", "SDO requests to drive gimbal_right"),
        (CANOPEN, SEQUENTIAL + "0x702", "", "the heartbeat of drive gimbal_right"),
        (CANOPEN, SEQUENTIAL + "0x77E", "", "this service's heartbeat (node 127)"),
        (CANOPEN, SEQUENTIAL + "0x07F", "", "the SYNC"),
        (CANOPEN, SEQUENTIAL + "0x082", "", "emergencies of drive gimbal_right (node 2) as well; set another id"),
        (CANOPEN, SEQUENTIAL + "0x1FF", "", "setpoints (RPDO 1) of drive gimbal_left"),
        (CANOPEN, SEQUENTIAL + "0x280", "", "for example 0x500"),
        ('role = "trim"', 'role = "gimbal"', "drive", "trim: a gimbal drive needs gear_ratio"),
        ("gear_ratio = 100.0 ", "gear_ratio = -1.0 ", "drive.0.gear_ratio", "greater than 0"),
        ("mode = 2   ", "mode = 3   ", "drive.0.mode", "found 3"),
        ('unit = "kg m^2"', 'unit = "g m^2"', "parameters", "give it in 'kg m^2'"),
        ("value = 12600.0", "value = -12600.0", "parameters", "gravity_stiffness must be positive"),
        ('"angular_rate_z"]', '"off"]', "imu.slots", "needs angular_rate_z"),
        ("amplitude_deg = 0.4", "amplitude = 0.4", "experiments.square", "needs amplitude_deg"),
        ("start_frequency = 0.05 ", "", "experiments.sweep", "a sweep needs start_frequency"),
        ('drives = "socketcan:can0"', 'drives = "can0"', "bus.drives", "found 'can0'"),
        ('[mqtt]\nbroker = ""', '[mqtt]\nbroker = "localhost"', "mqtt.broker", "found 'localhost'"),
    ],
)
def test_error_names_file_key_and_remedy(tmp_path: Path, old: str, new: str, key: str, said: str) -> None:
    path = changed(tmp_path, old, new)
    with pytest.raises(VehicleFileError) as caught:
        load(path)
    assert caught.value.file == path
    assert caught.value.key == key
    assert said in str(caught.value)
    assert "Remedy:" in str(caught.value)


def test_ids_of_two_buses_do_not_clash(tmp_path: Path) -> None:
    path = changed(tmp_path, CANOPEN, SEQUENTIAL + "0x581")
    Path(path).write_text(Path(path).read_text().replace('imu = "socketcan:can0"', 'imu = "socketcan:can1"'))
    assert load(path).imu.base_id == 0x581


def test_missing_section_is_named(tmp_path: Path) -> None:
    path = changed(tmp_path, "[limits]", "[limit]")
    with pytest.raises(VehicleFileError, match=r"limit.*Did you mean|limits: is missing"):
        load(path)


def test_invalid_toml_error_names_the_line(tmp_path: Path) -> None:
    with pytest.raises(VehicleFileError, match=r"not valid TOML.*line \d+"):
        load(changed(tmp_path, "rate = 250 ", "rate = = 250 "))


def test_missing_file_error_lists_the_shipped_vehicles() -> None:
    with pytest.raises(VehicleFileError, match=r"cannot be read: No such file.*monocab"):
        load("nowhere")


LIMITS = [(name, key) for name in shipped() for key in type(load(name).limits).model_fields]


@pytest.mark.parametrize("value", ["inf", "nan", "1e9", "0.0", "-1.0"])
@pytest.mark.parametrize(("name", "key"), LIMITS)
def test_limit_beyond_what_the_vehicle_survives_is_refused(tmp_path: Path, name: str, key: str, value: str) -> None:
    path = tmp_path / "limits.toml"
    head, limits = shipped_file(name).read_text().split("[limits]\n")
    section, rest = limits.split("\n[", 1)
    lines = [line for line in section.splitlines() if line.split(" =")[0] != key]
    path.write_text(f"{head}[limits]\n{key} = {value}\n" + "\n".join(lines) + f"\n[{rest}")
    with pytest.raises(VehicleFileError) as refused:
        load(str(path))
    assert refused.value.key == f"limits.{key}"
    if key != "missed_cycles":
        assert re.search(r"must be above 0 and at most [\d.]+: .{15,} \(found ", str(refused.value)), str(refused.value)


@pytest.mark.parametrize("name", shipped())
def test_every_limit_has_its_range_in_the_schema(name: str) -> None:
    kind = type(load(name)).__name__.removesuffix("File")
    properties = schema()["$defs"][f"{kind}Limits"]["properties"]
    assert all("maximum" in each for each in properties.values())


@pytest.mark.parametrize("value", ["1e308", "1e-320"])
def test_number_whose_square_cannot_be_computed_is_refused(tmp_path: Path, value: str) -> None:
    text = shipped_file("monocab").read_text()
    path = tmp_path / "wild.toml"
    path.write_text(re.sub(r"bias_random_walk = \S+", f"bias_random_walk = {value}", text))
    with pytest.raises(VehicleFileError, match="between 1e-15 and 1e\\+15") as refused:
        load(str(path))
    assert refused.value.key == "imu.filter.bias_random_walk"


def test_no_number_of_a_vehicle_file_is_infinite(tmp_path: Path) -> None:
    for key in ("acceleration_std = ", "rated_torque = ", "roll_weight = "):
        text = shipped_file("monocab").read_text()
        path = tmp_path / "infinite.toml"
        path.write_text(re.sub(rf"^{key}\S+", f"{key}inf", text, count=1, flags=re.MULTILINE))
        with pytest.raises(VehicleFileError, match="finite number"):
            load(str(path))


def test_drive_stops_soon_after_the_service_would_without_setpoints() -> None:
    vehicle = load("monocab")
    assert vehicle.setpoint_timeout == pytest.approx(0.034)  # 7 cycles of 4 ms, and a cycle and a half
    slow = vehicle.model_copy(update={"limits": vehicle.limits.model_copy(update={"missed_cycles": 50})})
    assert slow.setpoint_timeout == vehicle.control.heartbeat_timeout
