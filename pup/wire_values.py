"""How values go over the wire: read by the types of a data class, within limits."""

import math
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from enum import StrEnum
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import msgpack
import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError

SIZE_LIMIT = 2**20  # bytes of a message
DEPTH_LIMIT = 8  # maps and lists in each other
LENGTH_LIMIT = 4096  # entries of a map or list, characters of a text
WHOLE_LIMIT = 2**53  # as far as JSON and floating point count exactly
DTYPES = ("<f8", "<f4", "<i8", "<i4", "|u1")
NUMBERS = tuple[float, ...]


class WireError(InputError):
    """Bytes or values that are no message; told in one line."""


def pack(value: Any) -> bytes:
    """Bytes of a value; WireError where `unpack` would refuse them."""
    _check(value)
    data: bytes = msgpack.packb(value)
    if len(data) > SIZE_LIMIT:
        raise WireError(f"a message of {len(data)} bytes; {SIZE_LIMIT} at most")
    return data


def unpack(data: bytes) -> Any:
    """A value of some bytes, whoever sent them; WireError where they break a limit."""
    if len(data) > SIZE_LIMIT:
        raise WireError(f"a message of {len(data)} bytes; {SIZE_LIMIT} at most")
    try:
        told = msgpack.unpackb(
            data,
            max_ext_len=0,
            max_array_len=LENGTH_LIMIT,
            max_map_len=LENGTH_LIMIT,
            object_pairs_hook=_once,
        )
    except WireError:
        raise
    except Exception as error:  # damaged bytes make msgpack raise nearly anything
        raise WireError(f"not msgpack ({type(error).__name__})") from error
    _check(told)
    return told


def _once(pairs: list[tuple[Any, Any]]) -> dict[Any, Any]:
    told = dict(pairs)
    if len(told) < len(pairs):
        raise WireError("a map holds a key twice")
    return told


def _check(value: Any, depth: int = 0) -> None:
    """Whether a value is one that may be sent at all."""
    if depth > DEPTH_LIMIT:
        raise WireError(f"more than {DEPTH_LIMIT} levels deep")
    if isinstance(value, Mapping | list | tuple | str) and len(value) > LENGTH_LIMIT:
        raise WireError(f"a {type(value).__name__} of {len(value)} entries; {LENGTH_LIMIT} at most")
    if isinstance(value, str) and "\0" in value:
        raise WireError("a text with a zero, which no database keeps")
    if isinstance(value, Mapping):
        for key, entry in value.items():
            if not isinstance(key, str) or len(key) > LENGTH_LIMIT:
                raise WireError(f"key {str(key)[:40]!r} is no text")
            _check(entry, depth + 1)
    elif isinstance(value, list | tuple):
        for entry in value:
            _check(entry, depth + 1)
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise WireError(f"{value} is not finite")
    elif isinstance(value, int):
        if abs(value) > WHOLE_LIMIT:
            raise WireError(f"{value} is beyond {WHOLE_LIMIT}")
    elif not isinstance(value, str | bytes | NoneType):
        raise WireError(f"a value of type {type(value).__name__}")


def plain(value: Any, hint: Any = None) -> Any:
    """What msgpack knows of a value; numbers in a row become an array.

    Args:
      value: a data class, or what stands in its fields.
      hint: its type.
    """
    if is_dataclass(value):
        hints = _hints(type(value))
        return {f.name: plain(getattr(value, f.name), hints[f.name]) for f in fields(value)}
    if hint == NUMBERS:
        return _packed(value)
    if isinstance(value, tuple):
        return [plain(entry) for entry in value]
    return str(value) if isinstance(value, StrEnum) else value


def read(hint: Any, value: Any, place: str) -> Any:
    """A value as its type wants it; WireError says where one is not.

    Args:
      hint: a data class, or the type of a field.
      value: as it was sent.
      place: what the message calls it.
    """
    if isinstance(hint, UnionType):
        (kind,) = (h for h in get_args(hint) if h is not NoneType)
        return None if value is None else read(kind, value, place)
    if hint == NUMBERS:
        return tuple(_unpacked(value, place).tolist())
    if get_origin(hint) is tuple:
        if not isinstance(value, list):
            raise WireError(f"{place} is no list")
        return tuple(read(get_args(hint)[0], entry, place) for entry in value)
    if get_origin(hint) is dict:
        hint = dict
        if _holds_bytes(value):
            raise WireError(f"{place} holds bytes; use numbers, texts, lists and maps of them")
    if is_dataclass(hint) and isinstance(hint, type):
        return _body(hint, value, place)
    if issubclass(hint, StrEnum):
        if value not in list(hint):
            raise WireError(f"{place} is {str(value)[:40]!r}; use {', '.join(hint)}")
        return hint(value)
    if hint is float and type(value) is int:
        return float(value)
    if hint is int and type(value) is int and value < 0:
        raise WireError(f"{place} is {value}, below 0")
    if type(value) is not hint:
        raise WireError(f"{place} is {type(value).__name__}, not {hint.__name__}")
    return value


def _holds_bytes(value: Any) -> bool:
    """Whether bytes stand in a map or list: what is passed on as JSON cannot tell them."""
    entries = (
        value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    )
    return isinstance(value, bytes) or any(map(_holds_bytes, entries))


def _hints(kind: type[Any]) -> dict[str, Any]:
    if kind not in _known:
        _known[kind] = get_type_hints(kind)
    return _known[kind]


_known: dict[type[Any], dict[str, Any]] = {}


def _body(kind: type[Any], value: Any, place: str) -> Any:
    if not isinstance(value, dict):
        raise WireError(f"{place} is no map")
    hints, known = _hints(kind), {}
    for f in fields(kind):
        if f.name in value:
            known[f.name] = read(hints[f.name], value[f.name], f"{place}.{f.name}")
        elif f.default is MISSING and f.default_factory is MISSING:
            raise WireError(f"{place}.{f.name} is missing")
    return kind(**known)


def _packed(values: Any) -> dict[str, Any]:
    array = np.ascontiguousarray(np.asarray(values, dtype="<f8"))
    return {"dtype": "<f8", "shape": list(array.shape), "data": array.tobytes()}


def _unpacked(value: Any, place: str) -> NDArray[np.float64]:
    """A row of finite numbers from an array as it is sent."""
    if not isinstance(value, dict) or value.get("dtype") not in DTYPES:
        raise WireError(f"{place} is no array of {', '.join(DTYPES)}")
    shape, data = value.get("shape"), value.get("data")
    if not isinstance(data, bytes) or not isinstance(shape, list) or len(shape) != 1:
        raise WireError(f"{place} is no array of one dimension")
    dtype = np.dtype(value["dtype"])
    if type(shape[0]) is not int or shape[0] > LENGTH_LIMIT:
        raise WireError(f"{place} has a shape of {str(shape)[:40]}")
    if len(data) != shape[0] * dtype.itemsize:
        raise WireError(f"{place} has {len(data)} bytes for a shape of {shape}")
    array = np.frombuffer(data, dtype).astype(np.float64)
    if not np.isfinite(array).all():
        raise WireError(f"{place} is not finite")
    return array
