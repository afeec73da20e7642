"""A robot's agent for tests of the gateway: speaks the wire over ZeroMQ CURVE, walks a landscape.

It keeps the rules of the wire: a journal that outlives it, each (trial, attempt) walked at most
once, results resent until they are acknowledged. What it can do wrong is asked for by the tests.
"""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import zmq
import zmq.auth

from pup.wire import (
    Accepted,
    Acknowledge,
    AgentState,
    Armed,
    Assign,
    Body,
    Cancel,
    Finished,
    Heartbeat,
    Hello,
    JournalEntry,
    Message,
    Outcome,
    Policy,
    Progress,
    Running,
    Sample,
    Stop,
    decode,
    encode,
)

POLICY = "a" * 64
Walk = Callable[[Assign], Finished | None]


@dataclass
class Journal:
    """What an agent has on its disk.

    Attributes:
      walked: (trial, attempt, fence) in the order of the robot's motions.
      results: of them.
      acknowledged: of them.
    """

    walked: list[tuple[str, int, int]] = field(default_factory=list)
    results: dict[tuple[str, int, int], Finished] = field(default_factory=dict)
    acknowledged: set[tuple[str, int, int]] = field(default_factory=set)


class FakeAgent:
    """An agent in a thread.

    Args:
      key: file with its secret CURVE key.
      gateway_key: file with the gateway's public key.
      address: of the gateway's link.
      walk: gives the result of an assignment; None for a walk that never ends.
      journal: of an agent that was killed, to go on with.
      beat: s between heartbeats.
    """

    def __init__(
        self,
        key: Path,
        gateway_key: Path,
        address: str,
        walk: Walk,
        journal: Journal | None = None,
        beat: float = 0.1,
        pause: float = 0.0,
    ) -> None:
        self.name = key.name.removesuffix(".key_secret")
        self.journal = journal or Journal()
        self.walk, self.address, self.beat, self.pause = walk, address, beat, pause
        self.state = AgentState.ENABLED
        self.deaf, self.limp = False, True
        self.received: list[Body] = []
        self.refused: list[tuple[str, int, int]] = []
        self._fence: dict[str, int] = {}
        self._public, self._secret = zmq.auth.load_certificate(key)
        self._server, _ = zmq.auth.load_certificate(gateway_key)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> "FakeAgent":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(10)

    def socket(self, context: zmq.Context) -> zmq.Socket:
        """A DEALER with this agent's key."""
        socket = context.socket(zmq.DEALER)
        socket.linger, socket.reconnect_ivl, socket.reconnect_ivl_max = 0, 50, 500
        socket.curve_publickey, socket.curve_secretkey = self._public, self._secret
        socket.curve_serverkey = self._server
        socket.connect(self.address)
        return socket

    def _run(self) -> None:
        context = zmq.Context()
        self._socket = self.socket(context)
        beaten = heard = resent = 0.0
        greeted = False
        while not self._stop.is_set():
            now = time.monotonic()
            if not greeted:
                self._hello()
                greeted, heard = True, now
            if now - heard > 20 * self.beat:  # the gateway may have been started anew
                self._socket.close(0)
                self._socket = self.socket(context)
                greeted = False
                continue
            if now - beaten > self.beat:
                health = {"temperature": 41.5, "voltage": 12.1, "limp": self.limp}
                self._send(Heartbeat(self.name, self.state, health))
                beaten = now
            if now - resent > 4 * self.beat:
                self._resend()
                resent = now
            if self._socket.poll(20):
                message = decode(self._socket.recv())
                heard = time.monotonic()
                self.received.append(message.body)
                self._handle(message.body)
        self._socket.close(0)
        context.term()

    def _hello(self) -> None:
        open_ = [k for k in self.journal.walked if k not in self.journal.acknowledged]
        entries = tuple(
            JournalEntry(
                *k, Progress(r.state) if (r := self.journal.results.get(k)) else Progress.RUNNING
            )
            for k in open_
        )
        self._send(Hello(self.name, "darwin_op2", "test", (Policy("walk", POLICY),), entries))

    def _handle(self, body: Body) -> None:
        match body:
            case Assign():
                self._assigned(body)
            case Acknowledge(trial=str()):
                self.journal.acknowledged.add((body.trial, body.attempt or 0, body.fence or 0))
            case Cancel():
                ticket = (body.trial, body.attempt, body.fence)
                if ticket in self.journal.walked and ticket not in self.journal.results:
                    self.journal.results[ticket] = Finished(
                        *ticket, Outcome.ABORTED, reason="cancelled"
                    )
                    self._resend()
            case Stop() if not self.deaf:
                self.state = AgentState.STOPPED

    def _assigned(self, body: Assign) -> None:
        ticket = (body.trial, body.attempt, body.fence)
        if body.fence < self._fence.get(body.trial, 0) or ticket in self.journal.walked:
            self.refused.append(ticket)
            return
        self._fence[body.trial] = body.fence
        self.journal.walked.append(ticket)  # written down before anything moves
        self._send(Accepted(*ticket))
        self._send(Armed(*ticket))
        self._send(Running(*ticket))
        self._send(Sample(*ticket, number=0, time=0.5, distance=0.1))
        time.sleep(self.pause)
        result = self.walk(body)
        if result is not None:
            self.journal.results[ticket] = result
            self._send(result)

    def _resend(self) -> None:
        for ticket, result in self.journal.results.items():
            if ticket not in self.journal.acknowledged:
                self._send(result)

    def _send(self, body: Body) -> None:
        with suppress(zmq.Again):
            self._socket.send(encode(Message(body)), zmq.DONTWAIT)


def walks(distance: Callable[[tuple[float, ...]], float]) -> Walk:
    """Walks that all succeed, with a distance by eta."""

    def walk(body: Assign) -> Finished:
        return Finished(
            body.trial,
            body.attempt,
            body.fence,
            Outcome.SUCCEEDED,
            distance=float(distance(body.eta)),
            time=10.0,
        )

    return walk
