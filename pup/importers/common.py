"""What the importers share: options, limited reading, and joining commands with readings."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import MISTAKES

Array = NDArray[np.float64]

MAX_TEXT = 64 * 2**20  # bytes of a text file, which takes 20 times as much once parsed
MAX_UNPACKED = 2**30  # bytes of a compressed file once unpacked
MAX_CELLS = 20_000_000  # numbers in one recording
SAME = 1e-9  # s; times that are the same but for how a program added them up are nearer


@dataclass(frozen=True)
class ImportOptions:
    """What a file does not say of itself; what is given here also wins over the file.

    Attributes:
      robot: name of the robot.
      motion: motion type.
      support: `suspended`, `ground` or `bench`.
      source: `hardware`, `simulation` or `unknown`.
      repeat_of: id of the recording that the one of the file repeats.
      setup: knobs, added to those of the file.
      notes: added to the importer's own notes.
      joints: joint names in column order, where the file has none.
      state_topic: MCAP topic of the readings, where it is not evident.
      command_topic: MCAP topic of the commands, where it is not evident.
    """

    robot: str | None = None
    motion: str | None = None
    support: str | None = None
    source: str | None = None
    repeat_of: str | None = None
    setup: Mapping[str, float] = field(default_factory=dict)
    notes: str = ""
    joints: tuple[str, ...] = ()
    state_topic: str | None = None
    command_topic: str | None = None

    def metadata(self, of_file: Mapping[str, Any]) -> dict[str, Any]:
        """Metadata of the contract, from the file's and the options.

        Args:
          of_file: `id` and what else the file tells; None where it tells nothing.
        """
        known: dict[str, Any] = {"schema": 1, "source": "unknown", "notes": "", "setup": {}}
        known |= {key: value for key, value in of_file.items() if value is not None}
        for key in ("robot", "motion", "support", "source"):
            if (value := getattr(self, key)) is not None:
                known[key] = value
            elif key not in known:
                raise InputError(f"the file does not tell the {key}; give it with --{key}")
        if self.repeat_of is not None:
            known["repeat_of"] = self.repeat_of
        if isinstance(known["setup"], dict):
            known["setup"] = known["setup"] | dict(self.setup)
        if self.notes:
            known["notes"] = f"{known['notes']} {self.notes}".strip()
        return known


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """A binary log; one that cannot be opened is not told as a damaged one."""
    try:
        file = path.open("rb")
    except MISTAKES as error:
        raise InputError(f"cannot be read ({error.strerror})") from error
    with file:
        yield file


def read_text(path: Path, limit: int = MAX_TEXT) -> str:
    """Read a UTF-8 text file of limited size."""
    try:
        if not path.is_file():
            raise InputError("not a file" if path.exists() else "no such file")
        if path.stat().st_size > limit:
            raise InputError(f"larger than {limit} bytes; is this the right file?")
        return path.read_text(encoding="utf-8-sig")
    except MISTAKES as error:
        raise InputError(f"cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"not UTF-8 text ({error}); save it as UTF-8") from error


def parse_json(text: str) -> Any:
    """Parse a JSON document."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"not a JSON document ({error})") from error


def item(document: object, key: str) -> Any:
    """A member of a JSON object."""
    if not isinstance(document, dict):
        raise InputError(f"expected a JSON object with {key!r}")
    if key not in document:
        raise InputError(f"{key!r} is missing")
    return document[key]


def text(document: object, key: str) -> str:
    """A member that must be a text."""
    value = item(document, key)
    if not isinstance(value, str):
        raise InputError(f"{key!r} is {value!r}; expected a text")
    return value


def number(document: object, key: str) -> float:
    """A member that must be a finite number."""
    value = item(document, key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{key!r} is {value!r}; expected a number")
    return float(finite(value, key))


def finite(values: object, what: str, shape: tuple[int | None, ...] = ()) -> Array:
    """Numbers as an array, none of them missing, NaN or infinite.

    Args:
      values: a number or nested lists of numbers.
      what: the column, for the message.
      shape: the expected shape; None stands for any length.
    """
    try:
        raw = np.asarray(values)
    except ValueError as error:
        raise InputError(f"column {what!r} has rows of different lengths") from error
    if raw.dtype.kind not in "biuf":  # null, text and whole numbers beyond 64 bits end up here
        raise InputError(f"column {what!r} is not made of numbers only")
    array = raw.astype(np.float64)
    fits = len(array.shape) == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=True)
    )
    if not fits:
        told = " x ".join("any" if n is None else str(n) for n in shape)
        raise InputError(f"column {what!r} has shape {array.shape}; expected {told or 'a number'}")
    for place in np.argwhere(~np.isfinite(array)):
        row = f", row {place[0]}" if len(place) else ""
        raise InputError(f"column {what!r}{row}: {array[tuple(place)]} is not a finite number")
    return array


def check_increasing(time: Array, what: str) -> None:
    """Refuse times that do not increase strictly."""
    for row in np.flatnonzero(np.diff(time) <= 0) + 1:
        raise InputError(
            f"column {what!r}, row {row}: {time[row]:.9g} does not come after {time[row - 1]:.9g} "
            "of the row before; time must increase strictly"
        )


def join(
    command_time: Array,
    state_time: Array,
    commands: Mapping[str, Array],
    states: Mapping[str, Array],
) -> tuple[dict[str, Array], str]:
    """Put commands and readings, each with its own times, in one table.

    Rows stand at the times of both. A command is held; a reading exists only at its own times.
    Readings before the first command are left out: what held the robot there is not known.

    Args:
      command_time: shape (n_commands,), s, strictly increasing.
      state_time: shape (n_states,), s, strictly increasing.
      commands: columns of shape (n_commands,).
      states: columns of shape (n_states,).

    Returns:
      The columns, time from 0, and a note on what was left out.
    """
    check_increasing(command_time, "command time")
    check_increasing(state_time, "state time")
    if not len(command_time) or not len(state_time):
        raise InputError("no commands" if len(state_time) else "no readings")
    after = np.minimum(np.searchsorted(command_time, state_time - SAME), len(command_time) - 1)
    beside = np.abs(command_time[after] - state_time) <= SAME
    state_time = np.where(beside, command_time[after], state_time)
    kept = state_time >= command_time[0]
    if not kept.any():
        raise InputError(
            f"the last reading is {command_time[0] - state_time[-1]:.9g} s before the first "
            "command, so that none is left; are both of one clock?"
        )
    if len(command_time) > 1 and command_time[-1] < state_time[0]:
        raise InputError(
            f"the last command is {state_time[0] - command_time[-1]:.9g} s before the first "
            "reading, so that none is seen to be followed; are both of one clock?"
        )
    time = np.union1d(command_time, state_time[kept])
    if len(time) * (1 + len(commands) + len(states)) > MAX_CELLS:
        raise InputError(f"more than {MAX_CELLS} numbers; cut the log")
    held = np.searchsorted(command_time, time, side="right") - 1
    rows = np.searchsorted(time, state_time[kept])
    columns = {"time": time - time[0]}
    columns |= {name: values[held] for name, values in commands.items()}
    for name, values in states.items():
        columns[name] = np.full(len(time), np.nan)
        columns[name][rows] = values[kept]
    early = int(np.sum(~kept))
    return columns, f"{early} readings before the first command left out." if early else ""


def joint_columns(kind: str, joints: Sequence[str], values: Array) -> dict[str, Array]:
    """Columns `<kind>/<joint>` of an array (n_rows, n_joints)."""
    return {f"{kind}/{name}": values[:, j] for j, name in enumerate(joints)}
