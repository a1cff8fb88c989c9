"""Integration into Home Assistant: MQTT discovery, sensors only. Opt-in ([mqtt] home_assistant).

Source: Home Assistant's documentation, "MQTT", section "MQTT Discovery". Each entity is one retained message on
homeassistant/COMPONENT/NODE/OBJECT/config. No component that sends commands is used. Telemetry is left out, as its
recorder is not suited for twenty values per second.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

PREFIX = "homeassistant"


def discovery(topic: str, vehicle: str, version: str, parameters: Mapping[str, str]) -> Iterable[tuple[str, Any]]:
    """Topic and document of each entity. `topic` is BASE/VEHICLE; `parameters` are units by name."""
    node = f"upright-{vehicle}"
    common = {
        "availability_topic": f"{topic}/status",
        "payload_available": "online",
        "payload_not_available": "offline",
        "device": {"identifiers": [node], "name": vehicle, "manufacturer": "upright", "sw_version": version},
        "origin": {"name": "upright", "sw_version": version},
    }

    def sensor(name: str, source: str, template: str, **more: Any) -> tuple[str, Any]:
        document = {
            "name": name.replace("_", " "),
            "unique_id": f"{node}-{name}",
            "state_topic": f"{topic}/{source}",
            "value_template": template,
            **common,
            **more,
        }
        return f"{PREFIX}/sensor/{node}/{name}/config", document

    yield (
        f"{PREFIX}/binary_sensor/{node}/connection/config",
        {
            "name": "connection",
            "unique_id": f"{node}-connection",
            "state_topic": f"{topic}/status",
            "payload_on": "online",
            "payload_off": "offline",
            "device_class": "connectivity",
            "device": common["device"],
            "origin": common["origin"],
        },
    )
    yield sensor("mode", "state", "{{ value_json.mode }}")
    yield sensor("experiment", "state", "{{ value_json.experiment or 'none' }}")
    yield sensor("fault", "state", "{{ value_json.faults[0].text[:250] if value_json.faults else 'none' }}")
    yield sensor("interlocks", "state", "{{ value_json.interlocks | count }}", state_class="measurement")
    yield sensor(
        "missing_effect",
        "diagnosis",
        "{{ value_json.findings[0].effect if value_json.findings else value_json.verdict }}",
    )
    for name, unit in parameters.items():
        yield sensor(
            name,
            "parameters",
            f"{{{{ value_json['{name}'].value if '{name}' in value_json else none }}}}",
            json_attributes_topic=f"{topic}/parameters",
            json_attributes_template=f"{{{{ value_json.get('{name}', {{}}) | tojson }}}}",
            unit_of_measurement=unit,
            state_class="measurement",
        )
