"""MCAP logs: ROS 2 `sensor_msgs/JointState` on two topics, or JSON messages.

ROS 2: one topic holds readings, another commands; both are joined by joint name. Times are the
header stamps where all messages have one, else the log times. A NaN speed is a missing sample, as
ROS writes it; efforts have no column in a recording. JSON: every message is a row whose keys are
the columns of the contract, `"position/l_knee"` or `"position": {"l_knee": ...}`; null or an absent
key is a missing sample. What `pup export mcap` wrote tells all of the recording.

Chunks are unpacked here and not by the `mcap` package, which bounds neither LZ4 nor Zstandard.
"""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import zstandard
from mcap.records import Channel, Chunk, Footer, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap_ros2.decoder import DecoderFactory

from pup.errors import InputError
from pup.importers.common import (
    MAX_CELLS,
    Array,
    ImportOptions,
    finite,
    item,
    join,
    joint_columns,
    opened,
    parse_json,
)
from pup.recording import Recording, from_columns

MAX_FILE = 2**29  # bytes
MAX_UNPACKED = 2**28  # bytes; unlike columns, messages are Python objects of several times the size
JOINT_STATES = ("sensor_msgs/msg/JointState", "sensor_msgs/JointState")
# The log's own definition is not used: it could ask for any amount of work.
JOINT_STATE = Schema(
    id=1,
    name=JOINT_STATES[0],
    encoding="ros2msg",
    data=b"""std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
""",
)
COMMAND_WORDS = ("command", "target", "goal", "desired")
NANOSECOND = 1e-9
METADATA, RECORDING = "pup.recording", "/recording"
"""Of `pup export mcap`: the metadata record of a recording, and the topic of its rows."""


@dataclasses.dataclass(frozen=True)
class Topic:
    """The messages of one topic.

    Attributes:
      name: of the topic.
      kind: `json` or `joint_state`.
      messages: log time in ns and content, in file order.
    """

    name: str
    kind: str
    messages: list[tuple[int, Any]]


def read(path: Path, options: ImportOptions) -> list[Recording]:
    """Read one log."""
    topics, told = _topics(path)
    chosen = (options.state_topic, options.command_topic)
    if told is not None and chosen == (None, None):
        chosen = (RECORDING, None)
    for name in chosen:
        if name is not None and name not in topics:
            raise InputError(f"no topic {name!r} that can be read; there are {', '.join(topics)}")
    rows = [t for t in topics.values() if t.kind == "json" and chosen[0] in (None, t.name)]
    states = [t for t in topics.values() if t.kind == "joint_state"]
    if len(rows) == 1 and (not states or chosen[0] is not None):
        columns, notes = _table(rows[0]), ""
    elif states and not (rows and chosen[0] is None):
        columns, notes = _joined(*_pick(states, *chosen))
    else:
        raise InputError(
            f"topics {', '.join(topics) or 'none'}: need one of JSON rows, or two of JointState; "
            "choose with --state-topic and --command-topic"
        )
    known = {"id": path.stem, "notes": notes} | (told or {})
    return [from_columns(options.metadata(known), columns)]


def _pick(topics: list[Topic], state: str | None, command: str | None) -> tuple[Topic, Topic]:
    """The topics of readings and of commands, which by default has such a word in its name."""
    names = [topic.name for topic in topics]
    if len(names) == 1:
        raise InputError(
            f"of JointState topics there is only {names[0]}: readings and commands are on two; "
            "record both"
        )
    by_word = [n for n in names if any(word in n.lower() for word in COMMAND_WORDS) and n != state]
    if command is None and len(by_word) == 1:
        command = by_word[0]
    others = [name for name in names if name != command]
    if state is None and len(others) == 1:
        state = others[0]
    if command not in names or state not in names or state == command:
        raise InputError(
            f"JointState topics {', '.join(names)}: which are the commands, which the readings? "
            "choose with --state-topic and --command-topic"
        )
    return topics[names.index(state)], topics[names.index(command)]


def _joined(states: Topic, commands: Topic) -> tuple[dict[str, Array], str]:
    stamped = all(_stamp(message) for topic in (states, commands) for _, message in topic.messages)
    target = _joint_states(commands, stamped)
    position = _joint_states(states, stamped)
    for name in target.names:
        if name not in position.names:
            raise InputError(f"topic {states.name!r}: joint {name!r} has commands but no reading")
    order = [position.names.index(name) for name in target.names]
    readings = joint_columns("position", target.names, position.position[:, order])
    if position.velocity is not None:
        readings |= joint_columns("velocity", target.names, position.velocity[:, order])
    first = min(target.time[0], position.time[0])
    columns, notes = join(
        (target.time - first) * NANOSECOND,
        (position.time - first) * NANOSECOND,
        joint_columns("target", target.names, target.position),
        readings,
    )
    idle = [name for name in position.names if name not in target.names]
    return (
        columns,
        f"{notes} Joints without commands left out: {', '.join(idle)}." if idle else notes,
    )


@dataclasses.dataclass(frozen=True)
class _JointStates:
    names: list[str]
    time: np.ndarray[Any, np.dtype[np.int64]]  # (n,), ns
    position: Array  # (n, n_joints)
    velocity: Array | None


def _joint_states(topic: Topic, stamped: bool) -> _JointStates:
    """The messages of a topic as arrays; all must list the same joints, in any order."""
    names = list(topic.messages[0][1].name)
    if len(set(names)) < len(names) or not names:
        raise InputError(
            f"topic {topic.name!r}, message 0: joints {names} are none or not distinct"
        )
    if len(topic.messages) * len(names) > MAX_CELLS:
        raise InputError(f"topic {topic.name!r}: more than {MAX_CELLS} numbers; cut the log")
    speeds = any(message.velocity for _, message in topic.messages)
    position, velocity = [], []
    for row, (_, message) in enumerate(topic.messages):
        where = f"{topic.name}, message {row}"
        if sorted(message.name) != sorted(names):
            raise InputError(f"topic {where}: joints {message.name} differ from {names}")
        order = [list(message.name).index(name) for name in names]
        position.append(finite(list(message.position), where, (len(names),))[order])
        speed = np.array(message.velocity or [np.nan] * len(names))
        if speed.shape != (len(names),):
            raise InputError(f"topic {where}: {len(speed)} velocities for {len(names)} joints")
        velocity.append(speed[order])
    times = [_stamp(message) if stamped else log for log, message in topic.messages]
    measured = speeds and not np.isnan(velocity).all()
    return _JointStates(
        names, np.array(times), np.array(position), np.array(velocity) if measured else None
    )


def _stamp(message: Any) -> int:
    """Header stamp, ns; 0 where it was not set."""
    return int(message.header.stamp.sec * 10**9 + message.header.stamp.nanosec)


def _table(topic: Topic) -> dict[str, Array]:
    names: dict[str, None] = {}
    rows: list[dict[str, Any]] = []
    for row, (_, message) in enumerate(topic.messages):
        if not isinstance(message, dict):
            raise InputError(f"topic {topic.name!r}, message {row}: not a JSON object")
        rows.append(_flat(message))
        names |= dict.fromkeys(rows[-1])
    if len(rows) * len(names) > MAX_CELLS:
        raise InputError(f"topic {topic.name!r}: more than {MAX_CELLS} numbers; cut the log")
    columns = {}
    for name in names:
        values = [message.get(name) for message in rows]
        known = [0.0 if value is None else value for value in values]
        missing = np.array([value is None for value in values], bool)
        columns[name] = np.where(missing, np.nan, finite(known, name, (len(rows),)))
    return columns


def _flat(message: dict[str, Any]) -> dict[str, Any]:
    """A row by columns, `position/l_knee` for `l_knee` of `position`."""
    row: dict[str, Any] = {}
    for name, value in message.items():
        nested = isinstance(value, dict)
        row |= {f"{name}/{part}": v for part, v in value.items()} if nested else {name: value}
    return row


def _topics(path: Path) -> tuple[dict[str, Topic], dict[str, Any] | None]:
    """The topics that can be read, by name, and what a log of `pup export` says of itself."""
    told: dict[str, Any] | None = None
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    topics: dict[str, Topic] = {}
    decode = DecoderFactory().decoder_for("cdr", JOINT_STATE)
    try:
        for record in _records(path):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Metadata) and record.name == METADATA:
                told = _told(record)
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Message):
                channel = channels[record.channel_id]
                schema = schemas.get(channel.schema_id)
                if channel.message_encoding == "json":
                    kind, content = "json", parse_json(record.data.decode())
                elif schema is not None and schema.name in JOINT_STATES:
                    if decode is None or channel.message_encoding != "cdr":
                        raise InputError(f"topic {channel.topic!r}: not encoded as ROS 2 does")
                    kind, content = "joint_state", decode(record.data)
                else:
                    continue
                topic = topics.setdefault(channel.topic, Topic(channel.topic, kind, []))
                if topic.kind != kind:
                    raise InputError(f"topic {channel.topic!r} has messages of different kinds")
                topic.messages.append((record.log_time, content))
    except InputError:
        raise
    except Exception as error:  # damaged logs make the readers raise nearly anything
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"not a whole MCAP file ({reason}); `mcap recover` saves what a power loss left"
        ) from error
    return topics, told


def _told(record: Metadata) -> dict[str, Any]:
    """What the log says of its recording; `from_columns` judges it."""
    known = parse_json(record.metadata.get("json", "null"))
    if item(known, "schema") != 1:
        raise InputError(
            f"metadata {METADATA!r}: schema is {known['schema']!r}; this version reads 1"
        )
    return dict(known)


def _records(path: Path) -> Iterator[Any]:
    """All records, those in chunks included, within the limits."""
    if path.stat().st_size > MAX_FILE:
        raise InputError(f"larger than {MAX_FILE} bytes; cut the log")
    unpacked = 0
    with opened(path) as file:
        reader = StreamReader(
            file, emit_chunks=True, validate_crcs=True, record_size_limit=MAX_FILE
        )
        for record in reader.records:
            if isinstance(record, Chunk):
                data = _unpack(record, MAX_UNPACKED - unpacked)
                unpacked += len(data)
                plain = dataclasses.replace(record, compression="", data=data)
                yield from breakup_chunk(plain, validate_crc=True)
            else:
                yield record
            if isinstance(record, Footer):
                return


def _unpack(chunk: Chunk, limit: int) -> bytes:
    """A chunk's data, of at most `limit` bytes."""
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as stream:
            data = stream.read(limit + 1)
    elif chunk.compression == "lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=limit + 1)
    elif chunk.compression == "":
        data = chunk.data
    else:
        raise InputError(f"chunks compressed with {chunk.compression!r} cannot be read")
    if len(data) > limit:
        raise InputError(f"more than {MAX_UNPACKED} bytes unpacked; cut the log")
    return bytes(data)
