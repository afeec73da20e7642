"""The other end of an agent's link: a gateway that hands out trials, for tests."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import zmq
import zmq.auth
from zmq.auth.thread import ThreadAuthenticator

from pup.wire import Acknowledge, Assign, Body, Finished, Message, decode, encode

T = TypeVar("T")


class Gateway:
    """A ROUTER with CURVE that keeps what it is told.

    Args:
      folder: for the keys.
      acknowledges: whether ends of trials are acknowledged.
      port: to bind; 0 for any.
    """

    def __init__(self, folder: Path, acknowledges: bool = True, port: int = 0) -> None:
        self.folder, self.acknowledges = folder, acknowledges
        self.told: list[Message] = []
        self.context = zmq.Context()
        self._authenticator = ThreadAuthenticator(self.context)
        self._authenticator.start()
        keys(folder)
        self._authenticator.configure_curve(domain="robots", location=str(folder / "known"))
        self._socket = self.context.socket(zmq.ROUTER)
        public, secret = zmq.auth.load_certificate(folder / "gateway.key_secret")
        self._socket.curve_publickey, self._socket.curve_secretkey = public, secret
        self._socket.curve_server = True
        self._socket.setsockopt_string(zmq.ZAP_DOMAIN, "robots")
        self._socket.setsockopt(zmq.LINGER, 0)
        if port:
            self._socket.bind(f"tcp://127.0.0.1:{port}")
        self.port = port or self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._peer: bytes | None = None
        self._lock = threading.Lock()
        self._ending = False
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    @property
    def config(self) -> str:
        """For the agent."""
        return (
            f'[link]\ngateway = "tcp://127.0.0.1:{self.port}"\nheartbeat = 0.2\n'
            f'key = "{self.folder}/agent.key_secret"\ngateway_key = "{self.folder}/gateway.key"\n'
        )

    def send(self, body: Body) -> None:
        assert self._peer is not None
        with self._lock:
            self._socket.send_multipart([self._peer, encode(Message(body))])

    def raw(self, data: bytes) -> None:
        """Send what need not be a message."""
        assert self._peer is not None
        with self._lock:
            self._socket.send_multipart([self._peer, data])

    def of(self, kind: type[T]) -> list[T]:
        """Bodies of a kind, in the order they came."""
        return [m.body for m in list(self.told) if isinstance(m.body, kind)]

    def wait(self, kind: type[T], seconds: float = 30.0, told: Callable[[], Any] = str) -> T:
        """The next of a kind that comes."""
        before, deadline = len(self.of(kind)), time.monotonic() + seconds
        while len(self.of(kind)) == before:
            assert time.monotonic() < deadline, f"no {kind.__name__}: {self.told[-3:]} {told()}"
            time.sleep(0.01)
        return self.of(kind)[before]

    def run(self, assign: Assign, seconds: float = 60.0, told: Callable[[], Any] = str) -> Finished:
        """Hand a trial out and wait for its end."""
        self.send(assign)
        deadline = time.monotonic() + seconds
        while True:
            ended = [f for f in self.of(Finished) if f.trial == assign.trial]
            if ended:
                return ended[-1]
            assert time.monotonic() < deadline, f"{self.told[-3:]} {told()}"
            time.sleep(0.01)

    def close(self) -> None:
        self._ending = True
        self._thread.join()
        self._socket.close()
        self._authenticator.stop()
        self.context.term()

    def _serve(self) -> None:
        while not self._ending:
            if not self._socket.poll(20):
                continue
            with self._lock:
                peer, data = self._socket.recv_multipart()
            self._peer = peer
            message = decode(data)
            self.told.append(message)
            body = message.body
            if isinstance(body, Finished) and self.acknowledges:
                self.send(Acknowledge(message.id, body.trial, body.attempt, body.fence))
            else:
                self.send(Acknowledge(message.id))


def keys(folder: Path) -> None:
    """Keys of both ends, and the folder of those that the gateway knows."""
    if (folder / "gateway.key").exists():
        return
    (folder / "known").mkdir(parents=True)
    for name in ("gateway", "agent", "stranger"):
        zmq.auth.create_certificates(folder, name)
    (folder / "known" / "agent.key").write_text((folder / "agent.key").read_text())
