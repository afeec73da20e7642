"""The agents' end of the gateway: a ZeroMQ ROUTER that only known CURVE keys can talk to.

Who an agent is, its key tells (the ZAP handler's User-Id); what it says of itself and its routing
id, which it may choose, are not asked.
"""

import asyncio
import logging
import os
import re
import time
from typing import Any

import zmq
import zmq.asyncio
from zmq.auth.asyncio import AsyncioAuthenticator

from pup.files import sha256, write_atomic
from pup.wire import (
    CHUNK,
    SIZE_LIMIT,
    Accepted,
    Acknowledge,
    Armed,
    Body,
    Finished,
    Heartbeat,
    Hello,
    Message,
    RecordingChunk,
    Running,
    Sample,
    WireError,
    decode,
    encode,
)
from services.gateway.agents import AgentView
from services.gateway.conductor import Conductor
from services.gateway.config import Config
from services.gateway.keys import KeyRing, Stamp
from services.gateway.sockets import bind_link

log = logging.getLogger(__name__)

DOMAIN = "pup"
PIECES_LIMIT = 1024
"""Pieces of a recording."""
RECORDING = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,126}")
BACKLOG = 256
"""Messages of an agent that wait for the store."""
QUEUE = 1000
"""Messages to an agent that wait while it is slow."""


class Link:
    """The socket and what comes through it.

    Args:
      config: where to bind, and where files go.
      ring: keys.
      conductor: hears of trials.
    """

    def __init__(self, config: Config, ring: KeyRing, conductor: Conductor) -> None:
        self.config, self.ring, self.conductor = config, ring, conductor
        self.names: dict[bytes, str] = {}
        self.routes: dict[str, bytes] = {}
        self.context = zmq.asyncio.Context()
        self.authenticator = AsyncioAuthenticator(self.context)
        self.socket = self.context.socket(zmq.ROUTER)
        self.bound = False
        self._files: Stamp | None = None
        self._lacking: set[tuple[str, str | None]] = set()
        self._queues: dict[str, asyncio.Queue[Message]] = {}
        self._workers: list[asyncio.Task[None]] = []

    def start(self) -> None:
        """Bind.

        Raises:
          InputError: the address cannot be had.
        """
        public, secret = self.ring.gateway()
        self.authenticator.start()
        self.refresh_keys()
        self.authenticator.configure_curve_callback(DOMAIN, self)
        socket = self.socket
        socket.curve_server = True
        socket.curve_publickey, socket.curve_secretkey = public, secret
        socket.zap_domain = DOMAIN.encode()
        socket.router_mandatory = True  # no handover: routing ids are the clients' to choose
        socket.maxmsgsize, socket.linger = SIZE_LIMIT, 0
        socket.sndhwm = socket.rcvhwm = QUEUE
        socket.handshake_ivl = 5000
        socket.heartbeat_ivl, socket.heartbeat_timeout, socket.heartbeat_ttl = 1000, 5000, 5000
        bind_link(socket, self.config.link)
        self.bound = True
        self.conductor.courier.send = self.send

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a key, in z85, is let in; called by the authenticator."""
        self.refresh_keys()
        known = key in self.names
        if not known:
            self.conductor.metrics.refused.labels("unknown key").inc()
            log.warning("unknown CURVE key refused")
        return known

    def refresh_keys(self) -> None:
        """Read the agents' keys where a file changed; whose key is gone is let in no more.

        A new key in a file of the same name is another robot, or one that was set up anew: nothing
        goes to the connection of the old one.
        """
        files = self.ring.stamp()
        if files == self._files:
            return
        before = self.names
        self.names, self._files = self.ring.agents(), files
        for name in {n for key, n in before.items() if self.names.get(key) != n}:
            self.routes.pop(name, None)
            self.conductor.agents[name].hello = None  # it can be given no trial
        for name in self.names.values():
            self.conductor.agents.setdefault(name, AgentView(name))
        admitted = set(self.names.values())
        for name, view in self.conductor.agents.items():
            view.admitted = name in admitted
        self.conductor.notify("")

    async def run(self) -> None:
        """Receive until the process ends; what one agent says waits for no other's."""
        while True:
            frames = await self.socket.recv_multipart(copy=False)
            try:
                agent, message = self._read(frames)
                if isinstance(message.body, Heartbeat):
                    await self._handle(agent, message)
                else:
                    self._queue(agent).put_nowait(message)
            except WireError as error:
                self.conductor.metrics.refused.labels("malformed").inc()
                log.warning("message refused", extra={"why": str(error)})
            except asyncio.QueueFull:  # an end that is not acknowledged is sent again, and all
                self.conductor.metrics.refused.labels("too many").inc()
            except Exception:  # what one agent says must not end the others' link
                log.exception("message failed")

    async def watch(self) -> None:
        """Notice keys that are revoked while their agents are connected."""
        while True:
            await asyncio.sleep(1.0)
            self.refresh_keys()

    def send(self, agent: str, body: Body) -> None:
        """Send a message to an agent, if it is connected."""
        route = self.routes.get(agent)
        if route is None:
            return
        if error := self._told(route, body):
            log.info("not sent", extra={"agent": agent, "why": str(error)})

    def close(self) -> None:
        """Unbind."""
        self.bound = False
        for worker in self._workers:
            worker.cancel()
        self.authenticator.stop()
        self.socket.close(0)
        self.context.term()

    def _read(self, frames: list[Any]) -> tuple[str, Message]:
        """Who says what."""
        if len(frames) != 2:
            raise WireError(f"{len(frames) - 1} frames, not 1")
        agent = self.names.get(frames[1].get("User-Id").encode())
        if agent is None:
            raise WireError("its key was revoked")
        message = decode(bytes(frames[1].buffer))
        route = bytes(frames[0].buffer)
        if self.routes.get(agent, route) != route and self._connected(self.routes[agent]):
            raise WireError(f"another agent with the key of {agent} is connected")
        self.conductor.agents[agent].heard = time.monotonic()
        self.routes[agent] = route
        self.conductor.metrics.messages.labels(type(message.body).__name__).inc()
        return agent, message

    def _connected(self, route: bytes) -> bool:
        """Whether an agent is still there: a key that was copied must not move two robots."""
        error = self._told(route, Heartbeat())
        return error is None or isinstance(error, zmq.Again)

    def _told(self, route: bytes, body: Body) -> BaseException | None:
        """Send without waiting; why not: `zmq.Again` from who does not read, another from none."""
        sent = self.socket.send_multipart([route, encode(Message(body))], flags=zmq.DONTWAIT)
        assert sent.done(), "nothing else waits to be sent"
        return sent.exception()

    def _queue(self, agent: str) -> asyncio.Queue[Message]:
        if agent not in self._queues:
            queue = self._queues[agent] = asyncio.Queue(BACKLOG)
            self._workers.append(asyncio.get_running_loop().create_task(self._work(agent, queue)))
        return self._queues[agent]

    async def _work(self, agent: str, queue: asyncio.Queue[Message]) -> None:
        """Handle an agent's messages in turn; one that fails is not acknowledged."""
        while True:
            message = await queue.get()
            try:
                await self._handle(agent, message)
            except WireError as error:
                self.conductor.metrics.refused.labels("malformed").inc()
                log.warning("message refused", extra={"agent": agent, "why": str(error)})
            except Exception:
                log.exception("message failed", extra={"agent": agent})

    async def _handle(self, agent: str, message: Message) -> None:
        view = self.conductor.agents[agent]
        match message.body:
            case Hello() as hello:
                view.greet(hello)
                log.info("hello", extra={"agent": agent, "version": hello.version})
                self.send(agent, Heartbeat())
                for entry in hello.journal:
                    if entry.state in ("accepted", "running"):
                        kind = Accepted if entry.state == "accepted" else Running
                        await self._report(agent, kind(entry.trial, entry.attempt, entry.fence))
                self.conductor.tick()
            case Heartbeat() as heartbeat:
                before = view.state
                view.beat(heartbeat)
                self.conductor.heard(agent, heartbeat.trial)
                self.send(agent, Heartbeat())
                if heartbeat.state is not before:
                    self.conductor.tick()
                self.conductor.notify("")
            case Accepted() | Armed() | Running() as report:
                await self._report(agent, report)
            case Sample() as sample:
                self.conductor.heard(agent, sample.trial)
                if view.sampled(sample):
                    self.conductor.notify(sample.trial.rpartition("/")[0])
            case Finished() as finished:
                await self.conductor.finished(agent, finished)
                if (agent, finished.recording) not in self._lacking:
                    self._acknowledge(agent, message)
            case RecordingChunk() as piece:
                await self._kept(agent, piece)
                self._acknowledge(agent, message)
            case other:
                raise WireError(f"{type(other).__name__} is not for a gateway")

    async def _report(self, agent: str, report: Accepted | Armed | Running) -> None:
        self.conductor.heard(agent, report.trial)
        await self.conductor.reported(agent, report)

    def _acknowledge(self, agent: str, message: Message) -> None:
        body = message.body
        ticket = (
            (body.trial, body.attempt, body.fence) if isinstance(body, Finished) else (None,) * 3
        )
        self.send(agent, Acknowledge(message.id, *ticket))

    async def _kept(self, agent: str, piece: RecordingChunk) -> None:
        """Keep a piece, and know which recordings are not whole: their ends are owed still."""
        if not RECORDING.fullmatch(piece.recording):
            raise WireError("no id of a recording")
        if not piece.number < piece.of <= PIECES_LIMIT or len(piece.data) > CHUNK:
            raise WireError(f"piece {piece.number} of {piece.of}, {len(piece.data)} bytes")
        whole = False
        try:
            whole = await asyncio.to_thread(self._keep, agent, piece)
        finally:
            known = self._lacking.discard if whole else self._lacking.add
            known((agent, piece.recording))

    def _keep(self, agent: str, piece: RecordingChunk) -> bool:
        """Keep a piece of a recording and join them when all are there; whether they are."""
        folder = self.config.data / "recordings" / agent
        whole, parts = folder / f"{piece.recording}.parquet", folder / f".{piece.recording}.parts"
        if whole.exists():
            return True
        write_atomic(parts / f"{piece.number:04d}-{piece.of:04d}", piece.data)
        files = sorted(parts.glob(f"*-{piece.of:04d}"))
        if len(files) < piece.of:
            return False
        write_atomic(whole, b"".join(f.read_bytes() for f in files))
        for file in parts.iterdir():
            os.unlink(file)
        parts.rmdir()
        digest = sha256(whole)
        log.info("recording", extra={"agent": agent, "file": str(whole), "sha256": digest})
        return True
