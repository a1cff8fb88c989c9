"""Recordings in the formats of other tools: MAT (MATLAB), MF4 (ASAM MDF 4, measurement tools) and MCAP (Foxglove).

The last two need optional packages: the extras `upright[mf4]` and `upright[mcap]`.
"""

from __future__ import annotations

import json
from pathlib import Path

from upright.telemetry.formats.files import missing
from upright.telemetry.recording import Recording

SUFFIXES = (".mat", ".mf4", ".mcap")


def export(recording: Recording, path: Path) -> None:
    """Write `recording` to `path` by its suffix, one of SUFFIXES.

    Raises:
        RecordingError: the package for this format is not installed.
        OSError: `path` cannot be written.
    """
    writers = {".mat": save_mat, ".mf4": save_mf4, ".mcap": save_mcap}
    with path.open("wb"):
        pass  # If `path` is not writable, this raises the system's error, not one of a library.
    try:
        writers[path.suffix](recording, path)
    except ModuleNotFoundError as error:
        raise missing(path, error) from error


def save_mat(recording: Recording, path: Path) -> None:
    """A MATLAB 5 file: `time` (s) and a column vector per channel, `timestamp_ns`, and the texts as structs."""
    from scipy.io import savemat

    columns = {"time": recording.time, "timestamp_ns": recording.timestamp_ns, **recording.values}
    units = {channel.name: channel.unit for channel in recording.channels}
    texts = {"unit": units, "metadata": {key[:31]: text for key, text in recording.metadata.items()}}
    savemat(path, {**columns, **texts}, oned_as="column")


def save_mf4(recording: Recording, path: Path) -> None:
    """One channel group over `time` (s), with units and meanings of the channels, and the metadata as a comment."""
    from asammdf import MDF, Signal

    signals = [
        Signal(recording[channel.name], recording.time, name=channel.name, unit=channel.unit, comment=channel.meaning)
        for channel in recording.channels
    ]
    with MDF(version="4.10") as file:
        file.append(signals, comment=json.dumps(dict(recording.metadata)))
        file.save(path, overwrite=True)


def save_mcap(recording: Recording, path: Path) -> None:
    """One topic `/vehicle` of JSON messages, one per sample, with the time stamps of the recording."""
    from mcap.writer import Writer

    properties = {
        channel.name: {"type": "number", "description": f"{channel.meaning} ({channel.unit})"}
        for channel in recording.channels
    }
    schema = json.dumps({"type": "object", "properties": properties}).encode()
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="", library="upright")
        schema_id = writer.register_schema(name="vehicle", encoding="jsonschema", data=schema)
        topic = writer.register_channel(topic="/vehicle", message_encoding="json", schema_id=schema_id)
        writer.add_metadata("upright", dict(recording.metadata))
        names = recording.channels.names
        for frame in recording.frames():
            row = {name: value if value == value else None for name, value in zip(names, frame.values, strict=True)}
            writer.add_message(
                topic, log_time=frame.timestamp_ns, publish_time=frame.timestamp_ns, data=json.dumps(row).encode()
            )
        writer.finish()  # type: ignore[no-untyped-call]
