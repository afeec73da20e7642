"""What goes over the wire: every message, byte by byte, and what is refused."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pup import wire
from pup.wire import Message, WireError, decode, encode

GOLDEN = Path(__file__).parent / "golden"

OF = ("trial-7", 2, 5)
BODIES = (
    wire.Hello(
        "op2-a",
        "darwin_op2",
        "0.1.0",
        (wire.Policy("walk", "ab" * 32),),
        (wire.JournalEntry(*OF, wire.Progress.RUNNING),),
    ),
    wire.Heartbeat("op2-a", wire.AgentState.ARMED, {"volt": 11.9, "hot": [41, 43]}, "trial-7"),
    wire.Accepted(*OF),
    wire.Armed(*OF),
    wire.Running(*OF),
    wire.Sample(*OF, 12, 0.36, 0.021),
    wire.Finished(*OF, wire.Outcome.SUCCEEDED, 0.81, 9.3, "fell", "study-trial-7-2", "cd" * 32),
    wire.RecordingChunk("study-trial-7-2", 0, 3, b"PAR1\x00\xff"),
    wire.Assign("study", *OF, "ab" * 32, (0.1, -0.5, 1 / 3), 14.0),
    wire.Cancel(*OF),
    wire.Acknowledge("m-1", *OF),
    wire.Stop("somebody pressed it"),
)
"""One of each."""


def message(body: Any) -> Message:
    return Message(body, "m-1", 1760000000.25)


def envelope(**changes: Any) -> bytes:
    whole = {"v": 1, "type": "Stop", "id": "m", "time": 1.0, "body": {"reason": "x"}}
    return msgpack.packb(whole | changes)


@pytest.mark.parametrize("body", BODIES, ids=lambda b: type(b).__name__)
def test_every_message_is_the_bytes_it_always_was(body: wire.Body) -> None:
    """The fixtures are version 1: they change only together with the version."""
    golden = (GOLDEN / f"{type(body).__name__}.msgpack").read_bytes()
    assert encode(message(body)) == golden
    assert decode(golden) == message(body)


def test_there_is_a_fixture_for_every_type() -> None:
    assert {type(body) for body in BODIES} == set(get_args(wire.Body))


NAMES = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=20)
COUNTS = st.integers(0, 2**53)
NUMBERS = st.floats(allow_nan=False, allow_infinity=False)
TRIAL = (NAMES, COUNTS, COUNTS)
ANY = st.one_of(
    st.builds(wire.Assign, NAMES, *TRIAL, NAMES, st.lists(NUMBERS).map(tuple), NUMBERS),
    st.builds(wire.Finished, *TRIAL, st.sampled_from(wire.Outcome), st.none() | NUMBERS),
    st.builds(wire.Sample, *TRIAL, COUNTS, NUMBERS, st.none() | NUMBERS),
    st.builds(wire.RecordingChunk, NAMES, COUNTS, COUNTS, st.binary(max_size=2000)),
    st.builds(
        wire.Hello, NAMES, NAMES, NAMES, st.lists(st.builds(wire.Policy, NAMES, NAMES)).map(tuple)
    ),
    st.builds(
        wire.Heartbeat, NAMES, st.sampled_from(wire.AgentState), st.dictionaries(NAMES, NUMBERS)
    ),
)


@given(ANY)
def test_what_is_encoded_is_decoded(body: wire.Body) -> None:
    assert decode(encode(message(body))) == message(body)


@settings(max_examples=300)
@given(st.binary(max_size=200))
def test_no_bytes_do_anything_but_be_refused(data: bytes) -> None:
    with pytest.raises(WireError) as refused:
        decode(data)
    assert "\n" not in str(refused.value)


@settings(max_examples=500)
@given(st.sampled_from(BODIES), st.data())
def test_a_changed_byte_is_another_message_or_refused(body: wire.Body, data: st.DataObject) -> None:
    whole = bytearray(encode(message(body)))
    place = data.draw(st.integers(0, len(whole) - 1))
    whole[place] = data.draw(st.integers(0, 255))
    try:
        decoded = decode(bytes(whole))
    except WireError:
        return
    assert decode(encode(decoded)) == decoded


@settings(max_examples=300)
@given(
    st.recursive(
        st.none() | st.booleans() | NUMBERS | NAMES | st.binary(max_size=9),
        lambda v: st.lists(v, max_size=4) | st.dictionaries(NAMES, v, max_size=4),
    ),
    st.sampled_from(sorted(wire.BODIES)),
)
def test_no_body_of_other_values_gets_through_unseen(body: Any, kind: str) -> None:
    try:
        decoded = decode(envelope(type=kind, body=body))
    except WireError:
        return
    assert decode(encode(decoded)) == decoded


def test_fields_of_later_versions_are_ignored() -> None:
    told = msgpack.packb(
        {
            "v": 1,
            "type": "Stop",
            "id": "m",
            "time": 1.0,
            "body": {"reason": "x", "new": [1]},
            "z": 2,
        }
    )
    assert decode(told) == Message(wire.Stop("x"), "m", 1.0)


DEEP: Any = "x"
for _ in range(9):
    DEEP = [DEEP]

REFUSED = {
    "another version": (envelope(v=2), "version 2; this program speaks 1"),
    "no version": (msgpack.packb({"type": "Stop"}), "no envelope with a version"),
    "a version that is true": (envelope(v=True), "no envelope with a version"),
    "no map": (msgpack.packb([1, 2]), "no envelope with a version"),
    "an unknown type": (envelope(type="Pickle"), "type 'Pickle' is not one of Hello"),
    "no body": (envelope(body=None), "Stop is no map"),
    "a missing field": (envelope(body={}), "Stop.reason is missing"),
    "a field of another type": (envelope(body={"reason": 3}), "Stop.reason is int, not str"),
    "time that is no number": (envelope(time="now"), "time is str, not float"),
    "time that is not finite": (envelope(time=math.inf), "inf is not finite"),
    "too deep": (envelope(body={"reason": "x", "d": DEEP}), "more than 8 levels deep"),
    "a huge number": (envelope(body={"reason": "x", "n": 2**60}), "is beyond"),
    "a long text": (envelope(body={"reason": "x" * 5000}), "a str of 5000 entries; 4096 at most"),
    "a long list": (envelope(body={"reason": "x", "l": [0] * 5000}), "not msgpack (ValueError)"),
    "an extension": (envelope(body={"reason": msgpack.ExtType(5, b"")}), "ExtType"),
    "a time stamp": (envelope(body={"reason": msgpack.Timestamp(1)}), "not msgpack (ValueError)"),
    "a key twice": (b"\x82\xa1v\x01\xa1v\x01", "a map holds a key twice"),
    "a number as key": (b"\x81\x01\x01", "not msgpack (ValueError)"),
    "cut off": (envelope()[:-1], "not msgpack (ValueError)"),
    "bytes after the end": (envelope() + b"\x00", "not msgpack (ExtraData)"),
    "no UTF-8": (b"\x81\xa1\xff\x01", "not msgpack (UnicodeDecodeError)"),
    "nested without end": (b"\x91" * 5000, "not msgpack (StackError)"),
    "a negative count": (
        envelope(type="Cancel", body={"trial": "t", "attempt": -1, "fence": 0}),
        "Cancel.attempt is -1, below 0",
    ),
    "bytes in what is told as JSON": (
        envelope(type="Heartbeat", body={"health": {"hot": [{"servo": b"A"}]}}),
        "Heartbeat.health holds bytes",
    ),
    "a count that is true": (
        envelope(type="Cancel", body={"trial": "t", "attempt": True, "fence": 0}),
        "Cancel.attempt is bool, not int",
    ),
}


@pytest.mark.parametrize(("data", "told"), REFUSED.values(), ids=REFUSED)
def test_it_is_refused_in_one_line(data: bytes, told: str) -> None:
    with pytest.raises(WireError) as refused:
        decode(data)
    assert told in str(refused.value)


ARRAYS = {
    "a list": ([0.1], "no array of"),
    "objects": ({"dtype": "|O", "shape": [1], "data": b"\0" * 8}, "no array of"),
    "two dimensions": ({"dtype": "<f8", "shape": [1, 1], "data": b"\0" * 8}, "one dimension"),
    "too few bytes": ({"dtype": "<f8", "shape": [2], "data": b"\0" * 8}, "8 bytes for a shape"),
    "a negative shape": ({"dtype": "<f8", "shape": [-1], "data": b"\0" * 8}, "8 bytes for"),
    "a huge shape": ({"dtype": "<f8", "shape": [2**40], "data": b""}, "has a shape of"),
    "NaN": ({"dtype": "<f4", "shape": [1], "data": b"\x00\x00\xc0\x7f"}, "not finite"),
}


@pytest.mark.parametrize(("eta", "told"), ARRAYS.values(), ids=ARRAYS)
def test_an_eta_that_is_no_array_is_refused(eta: Any, told: str) -> None:
    body = {"study": "s", "trial": "t", "attempt": 1, "fence": 1, "policy": "p", "horizon": 1.0}
    with pytest.raises(WireError) as refused:
        decode(envelope(type="Assign", body=body | {"eta": eta}))
    assert told in str(refused.value)


def test_what_would_be_refused_is_not_sent() -> None:
    assign = BODIES[8]
    assert isinstance(assign, wire.Assign)
    for body in (
        replace(assign, eta=(math.nan,)),
        replace(assign, attempt=-1),
        replace(assign, study="x" * 5000),
        wire.Stop(reason=None),  # type: ignore[arg-type]  # which is what is refused
        wire.RecordingChunk("r", 0, 1, bytes(wire.SIZE_LIMIT)),
        wire.Heartbeat(health={"a": object()}),
    ):
        with pytest.raises(WireError):
            encode(message(body))
    with pytest.raises(WireError, match="zero"):
        encode(Message(wire.Stop("a\0b")))
    with pytest.raises(WireError, match="at most"):
        decode(bytes(wire.SIZE_LIMIT + 1))
