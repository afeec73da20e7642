"""What a lab finds between the agent and its servos on the first day."""

import itertools
import os
import select
import threading
import tty
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
import serial
from virtual_robots import BOARD, IDS, virtual_robot

from hardware_agent.bus import Bus
from hardware_agent.config import BusSettings, ImuSettings
from hardware_agent.imu import Bno055, Uart
from hardware_agent.port import BusError, Port
from pup.errors import InputError

pytest.importorskip("mujoco")


@contextmanager
def device(serve: Callable[[int, threading.Event], None]) -> Iterator[str]:
    """A serial port behind which a thread serves a file descriptor until it is to end."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    ended = threading.Event()
    thread = threading.Thread(target=serve, args=(ours, ended))
    thread.start()
    try:
        yield os.ttyname(theirs)
    finally:
        ended.set()
        thread.join()
        os.close(ours)
        os.close(theirs)


def echoing(bus: Path) -> AbstractContextManager[str]:
    """A half-duplex adapter on a bus: whoever sends hears that, too."""

    def pass_on(ours: int, ended: threading.Event) -> None:
        with serial.Serial(str(bus), 1_000_000, timeout=0) as far:
            while not ended.is_set():
                ready, _, _ = select.select([far.fileno(), ours], [], [], 0.05)
                if ours in ready:
                    sent = os.read(ours, 4096)
                    os.write(ours, sent)
                    far.write(sent)
                if far.fileno() in ready:
                    os.write(ours, far.read(4096))

    return device(pass_on)


@pytest.mark.parametrize("protocol", [1, 2])
def test_an_adapter_that_echoes_is_named_or_does_no_harm(tmp_path: Path, protocol: int) -> None:
    """With Protocol 1.0 the question passes for an answer; the status of 2.0 tells them apart."""
    with virtual_robot(tmp_path, protocol) as bench:
        bench.power()
        with echoing(tmp_path / "link") as port:
            bus = Bus(BusSettings(port, protocol=protocol, timeout=0.3), IDS)
            if protocol == 1:
                with pytest.raises(InputError, match="comes back as its answer; switch the adap"):
                    bus.open()
            else:
                bus.open()
                assert len(bus.read().servos) == len(IDS)
            bus.close()


def test_a_bus_where_nobody_answers_says_what_to_look_at(tmp_path: Path) -> None:
    """At another rate, or another protocol, or without current, all are silent."""
    with virtual_robot(tmp_path) as bench:
        settings = BusSettings(str(tmp_path / "link"), timeout=0.02, tries=1)
        dark = Bus(settings, IDS)
        with pytest.raises(BusError, match=f"servo {IDS[0]}, .*; do they have current, baud 1000"):
            dark.open()
        dark.close()
        slow = Bus(BusSettings(settings.port, 57_600, board=BOARD, timeout=0.02, tries=1), IDS)
        with pytest.raises(
            BusError, match="the board, id 200; does it have current and baud 57600"
        ):
            slow.open()
        slow.close()
        bench.port.setBaudRate(1_000_000)
        bench.power()
        bench.side("fault", kind="dead_servo", id=IDS[3])
        one = Bus(BusSettings(settings.port, timeout=0.3), IDS)
        with pytest.raises(BusError, match=f"no answer from servo {IDS[3]}$"):
            one.open()
        one.close()


def test_bytes_that_are_told_a_moment_early_are_waited_for_and_a_pulled_port_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Linux may call a terminal readable too early, and pyserial takes that for its end."""
    hollow = 1
    read = os.read
    opened = threading.Event()

    def early(descriptor: int, length: int) -> bytes:
        nonlocal hollow
        hollow -= 1
        return b"" if hollow >= 0 else read(descriptor, length)

    def answer(ours: int, ended: threading.Event) -> None:
        opened.wait(20)
        os.write(ours, b"abc")
        ended.wait()

    with device(answer) as path:
        port = Port(path, 1_000_000, timeout=5.0)
        port.open()
        opened.set()
        port.setPacketTimeout(3)
        monkeypatch.setattr("serial.serialposix.os.read", early)
        assert port.readPort(3) == b"abc"
        hollow = 2
        monkeypatch.setattr("serial.serialposix.select.select", lambda *told: (told[0][:1], [], []))
        with pytest.raises(serial.SerialException):
            port.readPort(3)
        monkeypatch.undo()
        port.close()


def chip(answers: Iterator[bytes]) -> AbstractContextManager[str]:
    """A BNO055 that is configured as it should be, and then answers like this."""

    def answer(ours: int, ended: threading.Event) -> None:
        while not ended.is_set():
            if select.select([ours], [], [], 0.05)[0]:
                _, writes, _, length = os.read(ours, 64)[:4]
                found = b"\xbb\x01\xa0" if length == 1 else next(answers)
                os.write(ours, b"\xee\x01" if writes == 0 else found)

    return device(answer)


def test_an_answer_of_the_imu_that_lost_bytes_is_none() -> None:
    """An odd number of them as well: no cable may end the control loop of a robot that stands."""
    upright = bytes(24) + (1 << 14).to_bytes(2, "little") + bytes(6)
    whole = b"\xbb\x20" + upright
    cut = [whole[:size] for size in range(len(whole))]
    with chip(itertools.cycle(cut)) as port:
        imu = Bno055(ImuSettings("bno055-uart", port), Uart(ImuSettings("", port)))
        imu.open()
        for _ in cut:
            imu.ask()
            assert imu.take(None, 0.0) is None
        imu.close()
    with chip(itertools.repeat(whole)) as port:
        imu = Bno055(ImuSettings("bno055-uart", port), Uart(ImuSettings("", port, timeout=0.3)))
        imu.open()
        imu.ask()
        told = imu.take(None, 0.0)
        assert told is not None and (told.roll, told.pitch) == (0.0, 0.0)
        imu.close()
