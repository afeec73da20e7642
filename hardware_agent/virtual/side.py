"""The side door: a Unix socket for what people and motion capture do in a laboratory.

One JSON object a line each way. `{"ok": true, ...}` or `{"ok": false, "error": "..."}`.
"""

import json
import os
import socket
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from pup.errors import InputError

LONGEST = 65536  # bytes of a line

Answer = Callable[[Mapping[str, Any]], dict[str, Any]]


class Side:
    """The socket and those who are connected.

    Args:
      path: of the socket; one that nobody listens at any more is replaced.
      answer: what is done with a command.

    Raises:
      InputError: the socket cannot be made there.
    """

    def __init__(self, path: Path, answer: Answer) -> None:
        self.path = path
        self._answer = answer
        self._guests: dict[socket.socket, bytearray] = {}
        self._door = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            if path.is_socket():
                _make_way(path)
            self._door.bind(str(path))
            os.chmod(path, 0o600)
        except InputError:
            self._door.close()
            raise
        except OSError as error:
            self._door.close()
            told = error.strerror or error
            raise InputError(f"{path}: no socket can be made there ({told})") from error
        self._door.listen()
        self._door.setblocking(False)

    @property
    def sockets(self) -> list[socket.socket]:
        """All to listen to."""
        return [self._door, *self._guests]

    def serve(self, ready: socket.socket) -> None:
        """Let somebody in, or do what somebody says."""
        if ready is self._door:
            with suppress(OSError):
                guest, _ = self._door.accept()
                guest.setblocking(False)
                self._guests[guest] = bytearray()
            return
        try:
            data = ready.recv(LONGEST)
            said = self._guests[ready]
            said += data
            while data and (end := said.find(b"\n")) >= 0:
                line = bytes(said[:end])
                del said[: end + 1]
                ready.sendall(self._reply(line))
            if not data or len(said) > LONGEST:
                self._dismiss(ready)
        except OSError:
            self._dismiss(ready)

    def close(self) -> None:
        """Shut the door."""
        for guest in list(self._guests):
            self._dismiss(guest)
        self._door.close()
        self.path.unlink(missing_ok=True)

    def _dismiss(self, guest: socket.socket) -> None:
        self._guests.pop(guest, None)
        guest.close()

    def _reply(self, line: bytes) -> bytes:
        try:
            told = json.loads(line)
            if not isinstance(told, dict):
                raise InputError("a command is a JSON object")
            answer = {"ok": True, **self._answer(told)}
        except (InputError, ValueError, RecursionError) as error:
            answer = {"ok": False, "error": " ".join(str(error).split())}
        return json.dumps(answer).encode() + b"\n"


def _make_way(path: Path) -> None:
    """Take away a socket that was left behind."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as door:
        try:
            door.connect(str(path))
        except OSError:
            path.unlink()
            return
    raise InputError(f"{path}: another robot is there; use another path, or end it")
