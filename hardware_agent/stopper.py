"""The emergency stop at the robot: a command that runs as long as the robot may move."""

import subprocess
import threading
from collections.abc import Callable, Sequence
from shutil import which

from pup.errors import InputError

BEGUN = 0.5  # s; a command that has ended by then says that the switch is pressed already


class Stopper:
    """The command that waits for the emergency stop, if there is one.

    It ends with an agent that is killed, where setpriv is there: it may own a line that the next
    one needs.

    Args:
      command: its words; empty for none.
      stop: called when the command ends, from a thread of its own: the agent's loop writes files.
    """

    def __init__(self, command: Sequence[str], stop: Callable[[], None]) -> None:
        self._command, self._stop = tuple(command), stop
        self._process: subprocess.Popen[bytes] | None = None

    def watch(self) -> None:
        """Start the command, where it does not run yet.

        Raises:
          InputError: it cannot be started, or has ended already: the switch may be pressed.
        """
        if not self._command or (self._process is not None and self._process.poll() is None):
            return
        name = self._command[0]
        if which(name) is None:
            raise InputError(f"stop.command: {name}: no such program")
        bound = ("setpriv", "--pdeathsig", "KILL") if which("setpriv") else ()
        try:
            self._process = subprocess.Popen([*bound, *self._command], stdin=subprocess.DEVNULL)
        except OSError as error:
            raise InputError(f"stop.command: {name}: {error.strerror}") from error
        try:
            code = self._process.wait(BEGUN)
        except subprocess.TimeoutExpired:
            threading.Thread(target=self._wait, args=(self._process,), daemon=True).start()
        else:
            raise InputError(
                f"stop.command: {name} ended at once, with {code}; release the emergency stop, or "
                "try the command by hand"
            )

    def close(self) -> None:
        """End the command."""
        if self._process is not None:
            self._process.terminate()

    def _wait(self, process: "subprocess.Popen[bytes]") -> None:
        process.wait()
        self._stop()
