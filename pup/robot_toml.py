"""Strict reading of TOML tables: every mistake becomes one line naming file, key and remedy."""

import math
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, TypeGuard

from pup.errors import InputError
from pup.files import MISTAKES

NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")


def read_text(path: Path, limit: int) -> str:
    """Read a UTF-8 text file of at most `limit` bytes; the mark that Notepad puts before it goes.

    Raises:
      InputError: the file is absent, too large or not UTF-8.
      OSError: the storage cannot be read now.
    """
    try:
        if path.stat().st_size > limit:
            raise InputError(f"{path}: larger than {limit} bytes; is this the right file?")
        return path.read_text(encoding="utf-8-sig")
    except MISTAKES as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text; save it as UTF-8") from error


class Table:
    """One TOML table whose keys are taken one by one; what is left over is a mistake.

    Args:
      value: the parsed table.
      file: the file it stands in, for messages.
      place: where in the file, such as `joint[3]`; empty for the whole file.
    """

    def __init__(self, value: object, file: Path, place: str = "") -> None:
        self._file = file
        self._place = place
        if not isinstance(value, dict):
            raise InputError(f"{file}: {place}: expected a table of keys, got {value!r}")
        self._rest: dict[str, Any] = dict(value)
        self._known: list[str] = []

    @classmethod
    def read(cls, text: str, file: Path) -> "Table":
        """Parse a whole TOML file."""
        try:
            return cls(tomllib.loads(text), file)
        except tomllib.TOMLDecodeError as error:
            raise InputError(f"{file}: not a TOML document ({error})") from error
        except RecursionError as error:
            raise InputError(f"{file}: nested too deeply; is this the right file?") from error

    def mistake(self, key: str, problem: str) -> InputError:
        """The error for one key of this table."""
        place = ".".join(part for part in (self._place, key) if part)
        return InputError(f"{self._file}: {place}: {problem}")

    def _take(self, key: str) -> object:
        self._known.append(key)
        return self._rest.pop(key, None)

    def close(self) -> None:
        """Refuse keys that nobody asked for."""
        known = ", ".join(sorted(set(self._known)))
        for key in self._rest:
            raise self.mistake(key, f"unknown key; known here: {known}")

    def left(self) -> list[str]:
        """The keys not taken yet, in file order."""
        return list(self._rest)

    def has(self, key: str) -> bool:
        """Whether a key is present and not taken yet; one that may be is known from here on."""
        self._known.append(key)
        return key in self._rest

    def text(self, key: str) -> str:
        """Take a required string."""
        value = self._take(key)
        if not isinstance(value, str):
            raise self._wrong(key, value, "a text in quotes")
        return value

    def name(self, key: str) -> str:
        """Take a required name: letters, digits, `_`, `.` and `-`."""
        value = self.text(key)
        if not NAME.fullmatch(value):
            raise self.mistake(key, f"{value!r} is no name; use letters, digits, '_', '.' and '-'")
        return value

    def optional_name(self, key: str) -> str | None:
        """Take a name that may be left out."""
        return self.name(key) if self.has(key) else None

    def names(self, key: str) -> tuple[str, ...]:
        """Take a list of distinct strings; empty when the key is left out."""
        value = self._take(key)
        if value is None:
            return ()
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self._wrong(key, value, "a list of texts")
        if len(set(value)) < len(value):
            raise self.mistake(key, f"{value} names something twice; name each once")
        return tuple(value)

    def number(self, key: str, default: float | None = None) -> float:
        """Take a finite number."""
        value = self._take(key)
        if value is None and default is not None:
            return default
        if not _is_number(value):
            raise self._wrong(key, value, "a finite number")
        return float(value)

    def integer(self, key: str) -> int | None:
        """Take a whole number that may be left out."""
        value = self._take(key)
        if value is not None and (isinstance(value, bool) or not isinstance(value, int)):
            raise self._wrong(key, value, "a whole number")
        return value

    def flag(self, key: str) -> bool:
        """Take a required true or false."""
        value = self._take(key)
        if not isinstance(value, bool):
            raise self._wrong(key, value, "true or false")
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Take a required list of strings."""
        value = self._take(key)
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise self._wrong(key, value, "a list of texts")
        return tuple(value)

    def numbers(
        self, key: str, count: int | None = None, default: tuple[float, ...] | None = None
    ) -> tuple[float, ...]:
        """Take a list of finite numbers, of a given length when `count` is given."""
        value = self._take(key)
        if value is None and default is not None:
            return default
        if not isinstance(value, list) or not all(_is_number(item) for item in value):
            raise self._wrong(key, value, "a list of finite numbers")
        if count is not None and len(value) != count:
            raise self.mistake(key, f"expected {count} numbers, got {len(value)}")
        return tuple(float(item) for item in value)

    def interval(self, key: str) -> tuple[float, float]:
        """Take a required pair [low, high] with low < high."""
        low, high = self.numbers(key, 2)
        if not low < high:
            raise self.mistake(key, f"[{low:g}, {high:g}] is empty; write [low, high], low < high")
        return low, high

    def table(self, key: str) -> "Table":
        """Take a sub-table; empty when the key is left out."""
        value = self._take(key)
        return self._child({} if value is None else value, key)

    def tables(self, key: str) -> "list[Table]":
        """Take a list of sub-tables; empty when the key is left out."""
        value = self._take(key)
        if value is None:
            return []
        if not isinstance(value, list):
            raise self._wrong(key, value, "a list of tables")
        return [self._child(item, f"{key}[{i}]") for i, item in enumerate(value, 1)]

    def _child(self, value: object, key: str) -> "Table":
        return Table(value, self._file, f"{self._place}.{key}" if self._place else key)

    def _wrong(self, key: str, value: object, wanted: str) -> InputError:
        if value is None:
            return self.mistake(key, f"missing; write {wanted}")
        return self.mistake(key, f"expected {wanted}, got {value!r}")


def listed(names: Iterable[str]) -> str:
    """Names in a row, for a message."""
    return ", ".join(names)


def _is_number(value: object) -> TypeGuard[float]:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond float64
        return False
