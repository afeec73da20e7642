"""The link to the gateway: a DEALER that only calls out, encrypted and known by its CURVE key.

ZeroMQ guide, chapter 4. Lazy pirate: when nothing comes from the gateway for some heartbeats, the
socket is thrown away and a new one made, later each time. Paranoid pirate: heartbeats go both ways,
for a connection proves nothing about the programs at its ends.
"""

import logging
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import zmq
import zmq.auth
from zmq.utils import z85

from hardware_agent.config import LinkSettings
from pup.errors import InputError
from pup.wire import SIZE_LIMIT, Body, Message, WireError, decode, encode

log = logging.getLogger("pup-agent")

QUEUE = 64  # messages that wait for the gateway; what counts is resent from the journal
LONGEST = 30.0  # s between two tries to connect


class Link:
    """The connection.

    Args:
      settings: of the configuration.
      greet: called when a connection has come about.

    Raises:
      InputError: a key cannot be read.
    """

    def __init__(
        self,
        settings: LinkSettings,
        greet: Callable[[], None],
    ) -> None:
        self._settings = settings
        self._greet = greet
        self._context: zmq.Context[Any] = zmq.Context.instance()
        self._own = _key(settings.key, secret=True)
        self._gateway = _key(settings.gateway_key, secret=False)[0]
        self._socket: zmq.Socket[Any] | None = None
        self._monitor: zmq.Socket[Any] | None = None
        self._heard = self._opened = -1e9
        self._pause = settings.heartbeat * settings.liveness
        self.refused = 0

    @property
    def connected(self) -> bool:
        """Whether the gateway was heard of lately."""
        return time.monotonic() - self._heard < self._settings.heartbeat * self._settings.liveness

    @property
    def sockets(self) -> "list[zmq.Socket[Any]]":
        """To poll; others after `tend`."""
        return [s for s in (self._socket, self._monitor) if s is not None]

    def tend(self) -> bool:
        """Greet in a connection that has come about; make a new one if the old has gone silent.

        Returns:
          Whether the sockets are others now.
        """
        if self._come():
            self._greet()
        now = time.monotonic()
        silence = now - max(self._heard, self._opened)
        if self._socket is not None and silence < self._pause:
            return False
        if self._socket is not None and self._heard < self._opened:
            self._pause = min(LONGEST, self._pause * 2)
        self._open()
        return True

    def send(self, *bodies: Body) -> None:
        """Send what the gateway gets if it is there; nothing waits, and nothing counts on it."""
        if self._socket is None:
            return
        for body in bodies:
            try:
                self._socket.send(encode(Message(body)), zmq.NOBLOCK)
            except zmq.Again:
                return
            except WireError as error:
                log.error("%s cannot be sent: %s", type(body).__name__, error)

    def receive(self) -> list[Message]:
        """What has come; what is no message is counted and dropped."""
        messages = []
        while self._socket is not None:
            try:
                frames = self._socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            try:
                messages.append(decode(frames[-1]))
            except WireError:
                self.refused += 1
                continue
            self._heard = time.monotonic()
            self._pause = self._settings.heartbeat * self._settings.liveness
        return messages

    def close(self, linger: int = 200) -> None:
        """Close the sockets; what is not sent is resent next time.

        Args:
          linger: for what is being sent, ms.
        """
        if self._socket is not None:
            self._socket.disable_monitor()
            self._socket.close(linger=linger)
            self._socket = self._monitor = None

    def _come(self) -> bool:
        """Whether a connection has come about, ours or one that ZeroMQ made again by itself."""
        come = False
        while self._monitor is not None:
            try:
                self._monitor.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                break
            come = True
        return come

    def _open(self) -> None:
        self.close(linger=0)
        socket = self._context.socket(zmq.DEALER)
        socket.curve_publickey, socket.curve_secretkey = self._own
        socket.curve_serverkey = self._gateway
        for option, value in (
            (zmq.LINGER, 0),
            (zmq.SNDHWM, QUEUE),
            (zmq.RCVHWM, QUEUE),
            (zmq.IMMEDIATE, 1),
            (zmq.MAXMSGSIZE, SIZE_LIMIT),
            (zmq.RECONNECT_IVL, 100),
            (zmq.RECONNECT_IVL_MAX, 5000),
            (zmq.HANDSHAKE_IVL, 5000),
        ):
            socket.setsockopt(option, value)
        self._monitor = socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_SUCCEEDED)
        socket.connect(self._settings.gateway)
        self._socket, self._opened = socket, time.monotonic()


def _key(path: str, secret: bool) -> tuple[bytes, bytes | None]:
    """A key file as `zmq.auth.create_certificates` writes them."""
    try:
        public, private = zmq.auth.load_certificate(Path(path))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a CURVE key file ({error}); see docs/agent.md") from error
    if secret and private is None:
        raise InputError(f"{path}: has no secret key; link.key is the file *.key_secret")
    if not _whole(public) or (private is not None and not _whole(private)):
        raise InputError(f"{path}: a key in it is damaged or cut off; copy the file again")
    return public, private


def _whole(key: bytes) -> bool:
    """Whether ZeroMQ takes a key: 40 characters of Z85."""
    try:
        return len(key) == 40 and len(z85.decode(key)) == 32
    except (ValueError, KeyError, struct.error):
        return False
