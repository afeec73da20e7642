"""The link: known by its key, made anew when it is silent, unmoved by what is no message."""

import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zmq
from far_end import Gateway, keys

from hardware_agent.config import LinkSettings
from hardware_agent.link import Link
from pup.errors import InputError
from pup.wire import Acknowledge, Heartbeat, Hello, Stop


def link(gateway: Gateway, key: str = "agent") -> Link:
    folder = gateway.folder
    made = Link(
        LinkSettings(
            f"tcp://127.0.0.1:{gateway.port}",
            str(folder / f"{key}.key_secret"),
            str(folder / "gateway.key"),
            heartbeat=0.1,
        ),
        lambda: made.send(Hello("tested", "darwin_op2", "1")),
    )
    return made


def tended(made: Link, happened: Callable[[], object], seconds: float = 10.0) -> bool:
    """Let the link live until something has happened."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        made.tend()
        made.send(Heartbeat("tested"))
        made.receive()
        if happened():
            return True
        time.sleep(0.02)
    return False


@pytest.fixture
def gateway(tmp_path: Path) -> Iterator[Gateway]:
    made = Gateway(tmp_path)
    yield made
    made.close()


def test_hello_is_first_and_again_when_the_gateway_comes_back(tmp_path: Path) -> None:
    first = Gateway(tmp_path)
    made = link(first)
    assert tended(made, lambda: made.connected and first.of(Hello))
    assert isinstance(first.told[0].body, Hello)
    first.close()
    assert tended(made, lambda: not made.connected)
    second = Gateway(tmp_path, port=first.port)
    assert tended(made, lambda: made.connected and second.of(Hello))
    assert any(isinstance(m.body, Hello) for m in second.told[:3])
    made.close()
    second.close()


def test_an_unknown_key_gets_nothing_through(gateway: Gateway) -> None:
    stranger = link(gateway, "stranger")
    assert not tended(stranger, lambda: stranger.connected, 1.5)
    assert gateway.told == []
    stranger.close()


def test_what_is_no_message_is_dropped_and_the_link_goes_on(gateway: Gateway) -> None:
    made = link(gateway)
    assert tended(made, lambda: gateway.of(Hello))
    for data in (b"", b"\xff" * 50, b"\x81\xa1v\x02", bytes(2**20 - 100)):
        gateway.raw(data)
    assert tended(made, lambda: made.refused == 4)
    gateway.send(Stop("heard"))
    heard: list[object] = []

    def listen() -> bool:
        heard.extend(m.body for m in made.receive())
        return Stop("heard") in heard

    deadline = time.monotonic() + 5
    while not listen():
        assert time.monotonic() < deadline
    assert any(isinstance(body, Acknowledge | Stop) for body in heard)
    made.close()


def test_a_message_beyond_the_limit_ends_the_connection_not_the_link(gateway: Gateway) -> None:
    made = link(gateway)
    assert tended(made, lambda: gateway.of(Hello))
    gateway.raw(bytes(2**20 + 1))
    before = len(gateway.of(Hello))
    assert tended(made, lambda: len(gateway.of(Hello)) > before)
    made.close()


def test_a_key_that_is_none_is_told(tmp_path: Path) -> None:
    keys(tmp_path)
    for key in ("none.key_secret", "agent.key"):
        with pytest.raises(InputError, match=r"key"):
            Link(
                LinkSettings("tcp://a:1", str(tmp_path / key), str(tmp_path / "gateway.key")),
                lambda: None,
            )


@pytest.mark.parametrize("damage", [lambda key: key[:10], lambda key: "~" + key[1:]])
def test_a_key_that_was_badly_copied_is_told_before_anything_starts(
    tmp_path: Path, damage: Callable[[str], str]
) -> None:
    """ZeroMQ takes it for a mistake of the program, and the link would end with it."""
    keys(tmp_path)
    for name, line in (("agent.key_secret", "secret-key"), ("gateway.key", "public-key")):
        file = tmp_path / name
        sound = file.read_text()
        (key,) = re.findall(f'{line} = "(.{{40}})"', sound)
        file.write_text(sound.replace(key, damage(key)))
        with pytest.raises(InputError, match=f"{name}: a key in it is damaged or cut off"):
            Link(
                LinkSettings(
                    "tcp://a:1", str(tmp_path / "agent.key_secret"), str(tmp_path / "gateway.key")
                ),
                lambda: None,
            )
        file.write_text(sound)


def test_nothing_waits_for_a_gateway_that_is_not_there(tmp_path: Path) -> None:
    keys(tmp_path)
    with zmq.Context().socket(zmq.ROUTER) as free:
        port = free.bind_to_random_port("tcp://127.0.0.1")
    made = Link(
        LinkSettings(
            f"tcp://127.0.0.1:{port}",
            str(tmp_path / "agent.key_secret"),
            str(tmp_path / "gateway.key"),
        ),
        lambda: None,
    )
    before = time.monotonic()
    for _ in range(200):
        made.tend()
        made.send(Heartbeat("tested"))
        made.receive()
    assert time.monotonic() - before < 1.0
    made.close()
