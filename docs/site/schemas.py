"""Pages of JSON Schemas: a table of keys for each object, and the schema itself.

The schemas are those of the program: `upright config schema`, and the MQTT payloads of `service.mqtt.topics`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from upright.service.mqtt.topics import schemas
from upright.vehicles import file

Schema = Mapping[str, Any]
_LIMITS = {
    "minimum": "≥ {}",
    "exclusiveMinimum": "> {}",
    "maximum": "≤ {}",
    "exclusiveMaximum": "< {}",
    "minLength": "at least {} characters",
    "maxLength": "at most {} characters",
    "minItems": "at least {} entries",
    "maxItems": "at most {} entries",
    "pattern": "matches `{}`",
}


def vehicle_file() -> str:
    """The page of the vehicle file's schema."""
    lead = (
        "All keys of a [vehicle file](vehicle-file.md), section by section, as `upright config schema` prints them for "
        "an editor. Where kinds of vehicles differ, each kind has a table."
    )
    return _page("Schema of the vehicle file", lead, file.schema())


def topics() -> dict[str, str]:
    """The pages of the MQTT payloads, by their place in the site."""
    return {f"reference/mqtt/{topic}.md": _topic(topic, schema) for topic, schema in schemas().items()}


def _topic(topic: str, schema: Schema) -> str:
    title = f"MQTT: `{topic.replace('cmd.', 'cmd/USER/')}`"
    page = _page(title, "The payload of a topic of [MQTT](../mqtt.md).", schema)
    return f"---\norphan: true\n---\n\n{page}"  # mqtt.md leads there; the navigation need not


def _page(title: str, lead: str, schema: Schema) -> str:
    parts = [f"# {title}\n\n{lead}\n\n", _entry(schema)]
    parts += [f"## {name}\n\n{_entry(schema['$defs'][name])}" for name in _referenced(schema)]
    whole = json.dumps(schema, indent=2, ensure_ascii=False)
    return "".join([*parts, f"## The schema itself\n\n```json\n{whole}\n```\n"])


def _referenced(schema: Schema) -> list[str]:
    """The definitions, each level after the one that refers to it."""
    found: list[str] = []
    queue = [{key: value for key, value in schema.items() if key != "$defs"}]
    while queue:
        for name in re.findall(r'"#/\$defs/(\w+)"', json.dumps(queue.pop(0))):
            if name not in found:
                found.append(name)
                queue.append(schema["$defs"][name])
    return found


def _entry(schema: Schema) -> str:
    """What an object is, and its keys; for anything else its type."""
    said = f"{_text(schema['description'])}\n\n" if "description" in schema else ""
    keys = schema.get("properties", {})
    if not keys:
        return f"{said}{_type(schema)}\n\n"
    required = set(schema.get("required", ()))
    rows = [
        f"| `{key}` | {_type(each)} | {_meaning(each)} | {_default(key, each, required)} |"
        for key, each in keys.items()
    ]
    return "\n".join([f"{said}| key | type | meaning | default |", "|---|---|---|---|", *rows, "", ""])


def _type(schema: Schema) -> str:
    if "$ref" in schema:
        name = schema["$ref"].rsplit("/", 1)[1]
        return f"[{name}](#{name.lower()})"
    for several in ("anyOf", "oneOf", "allOf"):
        if several in schema:
            return " or ".join(_type(each) for each in schema[several])
    if "enum" in schema or "const" in schema:
        return " or ".join(f"`{json.dumps(each)}`" for each in schema.get("enum", [schema.get("const")]))
    kind = schema.get("type", "any")
    if kind == "array":
        items = schema.get("items") or {}
        return f"array of {_type(items)}" if items else "array"
    if kind == "object" and isinstance(schema.get("additionalProperties"), Mapping):
        return f"object of {_type(schema['additionalProperties'])}"
    return str(kind)


def _meaning(schema: Schema) -> str:
    limits = [text.format(schema[key]) for key, text in _LIMITS.items() if key in schema]
    parts = [_text(schema.get("description", "")).rstrip("."), ", ".join(limits)]
    return ". ".join(part.replace("|", "\\|") for part in parts if part)


def _default(key: str, schema: Schema, required: set[str]) -> str:
    if key in required:
        return "needed"
    return f"`{json.dumps(schema['default'])}`" if schema.get("default") not in (None, "") else ""


def _text(text: str) -> str:
    return text.replace("\n", " ").replace("<", "&lt;").replace("*", "\\*")
