"""A process that makes the robot limp when the agent cannot: killed, or hung.

The agent and this process hold the ends of a socket pair. The agent sends a byte every tick, which
says whether torque is on. When the agent dies, the kernel closes its end, and this process knows at
once; when it hangs with torque on, this process kills it. The bus has one owner: the lock that the
agent holds on the port falls when its process is gone, and only then this process takes it and
writes. Its own port was opened before, so that nothing can go wrong with that any more; where it
does, or no servo answers, it tries again for two minutes, or until another agent has the bus.

Run as `python -m hardware_agent.watchdog`, it imports only what it needs: 20 MB instead of 70.
"""

import argparse
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # imported where it is needed: the process is small, and starts at once
    from hardware_agent.bus import Bus

ON, OFF, READY, ENDED = b"1", b"0", b"r", b"e"
PERSISTENCE = 120.0  # s, of trying to make the robot limp: an adapter may be put in again
TAKEN = 5.0  # s for which the next agent has the bus, while a command has it for less
AGAIN = 0.25  # s between two tries, in which the next agent may take the bus
PATIENCE = 3.0  # s for which an agent that ends waits for it
SPACING = 0.004  # s between packets: a servo's answer may have garbled the first


class Watchdog:
    """The agent's side.

    Args:
      port: of the bus.
      baud: its rate.
      protocol: of the servos.
      ids: of the servos.
      timeout: without a tick while torque is on, after which the agent is killed, s.
    """

    def __init__(
        self, port: str, baud: int, protocol: int, ids: Sequence[int], timeout: float
    ) -> None:
        self._socket, theirs = socket.socketpair()
        command = [sys.executable, "-m", "hardware_agent.watchdog", "--port", port]
        command += ["--baud", str(baud), "--protocol", str(protocol), "--timeout", str(timeout)]
        command += ["--ids", ",".join(map(str, ids)), "--socket", str(theirs.fileno())]
        self._process = subprocess.Popen(
            command, pass_fds=(theirs.fileno(),), start_new_session=True, stdin=subprocess.DEVNULL
        )
        theirs.close()
        self._socket.settimeout(20.0)
        try:
            ready = self._socket.recv(1)
        except TimeoutError:
            ready = b""
        if ready != READY:
            raise RuntimeError("the watchdog process did not start")
        self._socket.setblocking(False)

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def beat(self, torque: bool) -> None:
        """Tell that a tick begins."""
        try:
            self._socket.send(ON if torque else OFF)
        except OSError:  # it is full or gone; `alive` tells which
            return

    def alive(self) -> bool:
        """Whether the process is there."""
        try:
            return self._socket.recv(1) != b""
        except BlockingIOError:
            return True
        except OSError:
            return False

    def close(self) -> None:
        """Let it make sure that the robot is limp, and end; the bus is given up by now."""
        with suppress(OSError):  # what is full or gone needs no word
            self._socket.send(ENDED)
        self._socket.close()
        with suppress(subprocess.TimeoutExpired):  # no servo answers it; it goes on trying alone
            self._process.wait(timeout=PATIENCE)


def watch(beats: socket.socket, agent: int, timeout: float, bus: "Bus") -> str:
    """Wait until the agent is gone, by itself or by us.

    Args:
      beats: the end of the socket pair.
      agent: file descriptor of its process.
      timeout: see Watchdog.
      bus: attached; a port that hangs up is let go, for an adapter that is plugged in again gets
        its name only once nobody holds the old one.

    Returns:
      What happened, in words.
    """
    torque = False
    poll = select.poll()
    for descriptor in (beats.fileno(), agent):
        poll.register(descriptor, select.POLLIN)
    port = bus.descriptor
    if port is not None:
        poll.register(port, 0)  # a hang-up is told in any case
    while True:
        ready = {descriptor for descriptor, _ in poll.poll(1000 * timeout if torque else None)}
        if agent in ready:
            return "the agent has ended"
        if port in ready:
            poll.unregister(port)
            bus.close()
            port = None
            if beats.fileno() not in ready:
                continue
        if not ready:
            signal.pidfd_send_signal(agent, signal.SIGKILL)
            select.select([agent], [], [])
            return f"the agent did not tick for {timeout:g} s with torque on, and was killed"
        told = beats.recv(4096)
        if not told:  # it closed the socket on its way to its end
            select.select([agent], [], [], 5.0)
            return "the agent has ended"
        if told.endswith(ENDED):  # it waits for us
            return "the agent has ended"
        torque = told[-1:] == ON


def make_limp(bus: "Bus", persistence: float, orphaned: Callable[[], bool] = lambda: True) -> bool:
    """Take the bus and turn torque off, until every servo that answers says so.

    Args:
      bus: of the servos; it is let go between two tries.
      persistence: for how long to try, s.
      orphaned: whether its owner is gone: who has it for long then is an agent, which makes the
        robot limp itself.

    Returns:
      Whether a servo answered, and none holds.
    """
    from hardware_agent.port import BusError, BusyError

    free, said = time.monotonic(), ""
    deadline = free + persistence
    while (now := time.monotonic()) < deadline:
        holding: set[bool | None] = set()
        busy = False
        try:
            bus.take()
            holding = _let_go(bus)
        except BusyError:
            busy = True
        except BusError as error:
            if str(error) != said:
                said = str(error)
                _say(said)
        free = free if busy else now
        if True in holding:
            continue
        if False in holding:
            return True
        if now - free > TAKEN and orphaned():
            return False
        bus.close()  # an adapter that was out and in again does not answer an old handle
        time.sleep(AGAIN)
    return False


def _let_go(bus: "Bus") -> set[bool | None]:
    """Turn torque off; whether servos hold none the less, None of those that do not answer."""
    bus.torque(False)
    time.sleep(SPACING)
    bus.torque(False)
    return {bus.torque_enabled(name) for name in bus.ids}


def _say(text: str) -> None:
    """Tell it where somebody listens; the robot is made limp where nobody does, too."""
    with suppress(OSError, ValueError):
        print(f"watchdog: {text}", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Watch the process that started this one."""
    from hardware_agent.bus import Bus
    from hardware_agent.config import BusSettings

    parser = argparse.ArgumentParser(prog="pup-agent watchdog")
    parser.add_argument("--port", required=True)
    for name in ("baud", "protocol", "socket"):
        parser.add_argument(f"--{name}", type=int, required=True)
    parser.add_argument("--timeout", type=float, required=True)
    parser.add_argument("--ids", required=True)
    options = parser.parse_args(arguments)
    for ignored in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(ignored, signal.SIG_IGN)  # it outlives the agent by its purpose
    beats = socket.socket(fileno=options.socket)
    agent = os.pidfd_open(os.getppid())
    ids = [int(name) for name in options.ids.split(",")]
    bus = Bus(BusSettings(options.port, options.baud, options.protocol), ids)
    bus.attach()
    beats.send(READY)
    told = watch(beats, agent, options.timeout, bus)
    safe = make_limp(bus, PERSISTENCE, lambda: bool(select.select([agent], [], [], 0)[0]))
    _say(f"{told}; {'torque is off' if safe else 'no servo answered'}")
    return 0 if safe else 1


if __name__ == "__main__":
    sys.exit(main())
