"""Commands on this computer: a Unix socket, one JSON object a line each way."""

import json
import os
import socket
import socketserver
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from pup.errors import InputError

LONGEST = 2**20  # bytes of a line
PATIENCE = 10.0  # s, for an answer

Answer = Callable[[dict[str, Any]], dict[str, Any]]


class Unreachable(InputError):  # noqa: N818
    """Nobody listens."""


class ControlServer(threading.Thread):
    """Lets people and scripts at this computer talk to the agent.

    Args:
      path: of the socket; its folder's rights say who may.
      answer: what to do with a command; called from other threads.

    Raises:
      InputError: another agent listens there, or it cannot be made.
    """

    def __init__(self, path: Path, answer: Answer) -> None:
        super().__init__(name="control", daemon=True)
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.exists():
                with suppress(Unreachable):
                    say(path, {"do": "health"})
                    raise InputError(f"{path}: another agent listens there; end it first")
                path.unlink()
            self._server = _Server(str(path), answer)
            os.chmod(path, 0o660)
        except OSError as error:
            told = error.strerror or error
            raise InputError(f"{path}: no socket can be made there ({told})") from error

    def run(self) -> None:
        """Serve until closed."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Close the socket."""
        self._server.shutdown()
        self._server.server_close()
        self.path.unlink(missing_ok=True)


class _Server(socketserver.ThreadingUnixStreamServer):
    daemon_threads = True

    def __init__(self, path: str, answer: Answer) -> None:
        self.answer = answer
        super().__init__(path, _Handler)


class _Handler(socketserver.StreamRequestHandler):
    timeout = 600.0  # s, of silence

    def handle(self) -> None:
        """Answer one command after the other."""
        assert isinstance(self.server, _Server)
        with suppress(OSError):
            while line := self.rfile.readline(LONGEST):
                self.wfile.write(json.dumps(self._reply(line)).encode() + b"\n")

    def _reply(self, line: bytes) -> dict[str, Any]:
        assert isinstance(self.server, _Server)
        try:
            told = json.loads(line)
            if not isinstance(told, dict):
                raise InputError("a command is a JSON object")
            return {"ok": True, **self.server.answer(told)}
        except (InputError, ValueError, RecursionError) as error:
            return {"ok": False, "error": " ".join(str(error).split())}


def say(path: Path, command: dict[str, Any]) -> dict[str, Any]:
    """Send a command to whoever listens at a path: an agent, or a virtual robot's side door.

    Raises:
      Unreachable: none does.
      InputError: it refuses.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
            line.settimeout(PATIENCE)
            line.connect(str(path))
            line.sendall(json.dumps(command).encode() + b"\n")
            with line.makefile("rb") as answers:
                answer = answers.readline(LONGEST)
        told: dict[str, Any] = json.loads(answer)
    except (OSError, ValueError) as error:
        raise Unreachable(f"{path}: no agent answers; is `pup-agent run` running?") from error
    if not told.pop("ok", False):
        raise InputError(str(told.get("error")))
    return told
