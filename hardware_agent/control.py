"""Commands on this computer: a Unix socket, one JSON object a line each way."""

import json
import os
import socket
import socketserver
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

from pup.errors import InputError

LONGEST = 2**20  # bytes of a line
PATIENCE = 10.0  # s, for an answer
SILENCE = 600.0  # s, after which a connection is given up
ATTENTION = 3.0  # s likewise, of somebody who stands at the robot

Answer = Callable[[dict[str, Any]], dict[str, Any]]


class Unreachable(InputError):  # noqa: N818
    """Nobody listens."""


class ControlServer(threading.Thread):
    """Lets people and scripts at this computer talk to the agent.

    Args:
      path: of the socket; its folder's rights say who may.
      answer: what to do with a command; called from other threads.
      left: called from another thread when somebody who stood at the robot is gone; see attending.

    Raises:
      InputError: another agent listens there, or it cannot be made.
    """

    def __init__(self, path: Path, answer: Answer, left: Callable[[], None]) -> None:
        super().__init__(name="control", daemon=True)
        self.path = path
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_socket():  # left behind, perhaps; anything else is somebody's file
                with suppress(Unreachable):
                    say(path, {"do": "health"})
                    raise InputError(f"{path}: another agent listens there; end it first")
                path.unlink()
            self._server = _Server(str(path), answer, left)
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

    def __init__(self, path: str, answer: Answer, left: Callable[[], None]) -> None:
        self.answer, self.left = answer, left
        super().__init__(path, _Handler)


class _Handler(socketserver.StreamRequestHandler):
    timeout = SILENCE
    attends = False

    def handle(self) -> None:
        """Answer one command after the other."""
        assert isinstance(self.server, _Server)
        with suppress(OSError):
            while line := self.rfile.readline(LONGEST):
                self.wfile.write(json.dumps(self._reply(line)).encode() + b"\n")
        if self.attends:
            self.server.left()

    def _reply(self, line: bytes) -> dict[str, Any]:
        assert isinstance(self.server, _Server)
        try:
            told = json.loads(line)
            if not isinstance(told, dict):
                raise InputError("a command is a JSON object")
            if told.get("do") in ("attend", "leave"):
                self.attends = told["do"] == "attend"
                self.connection.settimeout(ATTENTION if self.attends else SILENCE)
                return {"ok": True}
            return {"ok": True, **self.server.answer(told)}
        except (InputError, ValueError, RecursionError) as error:
            return {"ok": False, "error": " ".join(str(error).split())}


class Talk:
    """A connection to whoever listens at a path: an agent, or a virtual robot's side door.

    Args:
      path: of the socket.

    Raises:
      Unreachable: nobody listens there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._line.settimeout(PATIENCE)
        try:
            self._line.connect(str(path))
        except OSError as error:
            self.close()
            raise self._unreachable() from error
        self._answers = self._line.makefile("rb")

    def say(self, command: dict[str, Any]) -> dict[str, Any]:
        """Send a command.

        Raises:
          Unreachable: nobody answers.
          InputError: it is refused.
        """
        try:
            self._line.sendall(json.dumps(command).encode() + b"\n")
            told: dict[str, Any] = json.loads(self._answers.readline(LONGEST))
        except (OSError, ValueError) as error:
            raise self._unreachable() from error
        if not told.pop("ok", False):
            raise InputError(str(told.get("error")))
        return told

    def close(self) -> None:
        """Hang up."""
        self._line.close()

    def _unreachable(self) -> Unreachable:
        return Unreachable(f"{self._path}: no agent answers; is `pup-agent run` running?")


def say(path: Path, command: dict[str, Any]) -> dict[str, Any]:
    """Send one command; see Talk."""
    with closing(Talk(path)) as talk:
        return talk.say(command)


@contextmanager
def attending(path: Path) -> Iterator[Talk]:
    """Stand at the robot: where this ends by an exception, a kill or a hang, the agent stops it.

    It stops a robot that a trial or a script moves. Whoever attends says something well within
    ATTENTION, again and again. A refusal is no reason to stop.

    Args:
      path: of the agent's socket.
    """
    with closing(Talk(path)) as talk:
        talk.say({"do": "attend"})
        try:
            yield talk
        except InputError:
            with suppress(InputError):
                talk.say({"do": "leave"})
            raise
        talk.say({"do": "leave"})
