"""MCAP: a log of JSON messages that Foxglove opens and `pup import mcap` reads back.

A message is a row. Topic `/recording` has the recording, `/simulated` its replay. A column
`position/l_knee` is the field `l_knee` of `position`: the path `/recording.position.l_knee` plots
it. A missing sample is null. What a recording says of itself stands in the metadata record
`pup.recording`. Time begins at 0.
"""

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Header
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from pup.exporters.common import Array, Take, nested

METADATA = "pup.recording"
RECORDING, SIMULATED = "/recording", "/simulated"
NANOSECONDS = 1e9
LIBRARY = "pup"
"""What the head of a log says it was written by."""


def write(take: Take, path: Path) -> None:
    """Write one log."""
    recording = take.recording
    buffer = io.BytesIO()
    writer = Writer(buffer, compression=CompressionType.ZSTD)
    writer.start(library=LIBRARY)
    writer.add_metadata(METADATA, {"json": json.dumps(recording.metadata())})
    log_time = np.round((recording.time - recording.time[0]) * NANOSECONDS).astype(np.int64)
    _topic(writer, RECORDING, log_time, list(recording.columns()))
    if take.simulated:
        columns = [("time", recording.time), *take.simulated.items()]
        _topic(writer, SIMULATED, log_time, columns)
    writer.finish()
    path.write_bytes(buffer.getvalue())


def is_own(path: Path) -> bool:
    """Whether a file is one that `write` made, and not somebody's own log."""
    try:
        with path.open("rb") as file:
            head = next(iter(StreamReader(file).records), None)
    except Exception:  # other files make the reader raise nearly anything
        return False
    return isinstance(head, Header) and head.library == LIBRARY


def _topic(
    writer: Writer, topic: str, log_time: np.ndarray[Any, Any], columns: list[tuple[str, Array]]
) -> None:
    schema = writer.register_schema(
        f"pup.{topic[1:]}", "jsonschema", json.dumps(_schema([n for n, _ in columns])).encode()
    )
    channel = writer.register_channel(topic, "json", schema)
    rows: Iterator[dict[str, Any]] = nested(iter(columns))
    for count, (now, row) in enumerate(zip(log_time.tolist(), rows, strict=True)):
        writer.add_message(channel, now, json.dumps(row).encode(), now, count)


def _schema(names: list[str]) -> dict[str, Any]:
    """A schema that Foxglove reads: it knows numbers, but no number-or-null."""
    properties: dict[str, Any] = {}
    for name in names:
        kind, slash, part = name.partition("/")
        if slash:
            group = properties.setdefault(kind, {"type": "object", "properties": {}})
            group["properties"][part] = {"type": "number"}
        else:
            properties[kind] = {"type": "number"}
    return {"type": "object", "properties": properties}
