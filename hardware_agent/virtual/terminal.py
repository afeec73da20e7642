"""A pseudo-terminal under a name of one's choice, as a serial port would be."""

import heapq
import os
import termios
import tty
from contextlib import suppress
from itertools import count
from pathlib import Path

from pup.errors import InputError

SPEEDS = {
    getattr(termios, name): int(name[1:])
    for name in dir(termios)
    if name.startswith("B") and name[1:].isdecimal()
}
CHUNK = 4096  # bytes
TERMINALS = "/dev/pts/"


class Terminal:
    """A serial port whose other end is ours.

    Args:
      path: of the symbolic link to it.

    Raises:
      InputError: something else is in the path's place.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._later: list[tuple[float, int, bytes]] = []
        self._number = count()
        self.plugged = False
        self.plug()

    def plug(self) -> None:
        """Make the port appear."""
        if self.plugged:
            return
        self._ours, self._theirs = os.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        try:
            if self.path.is_symlink() and os.readlink(self.path).startswith(TERMINALS):
                self.path.unlink()  # left behind by another
            self.path.symlink_to(os.ttyname(self._theirs))
        except OSError as error:
            os.close(self._ours)
            os.close(self._theirs)
            raise InputError(f"{self.path}: cannot be made ({error.strerror})") from error
        self.plugged = True

    def pull(self) -> None:
        """Make the port go away, as when its plug is pulled; who has it open gets an error."""
        if not self.plugged:
            return
        with suppress(OSError):
            if os.readlink(self.path) == os.ttyname(self._theirs):
                self.path.unlink()
        os.close(self._ours)
        os.close(self._theirs)
        self.drop()
        self.plugged = False

    def fileno(self) -> int:
        """Our end, for select."""
        return self._ours

    @property
    def baud(self) -> int:
        """Bits per second that the other end is set to."""
        return SPEEDS.get(termios.tcgetattr(self._theirs)[5], 0)

    def read(self) -> bytes:
        """What has come in."""
        try:
            return os.read(self._ours, CHUNK)
        except (BlockingIOError, OSError):
            return b""

    def send(self, data: bytes, due: float = 0.0) -> None:
        """Send bytes, or have them sent when their time has come."""
        heapq.heappush(self._later, (due, next(self._number), data))

    @property
    def due(self) -> float | None:
        """When the next bytes are to be sent."""
        return self._later[0][0] if self._later else None

    def drop(self) -> None:
        """Lose what waits to be sent."""
        self._later.clear()

    def flush(self, now: float) -> None:
        """Send what is due; what nobody takes is lost, as on a wire."""
        ready = bytearray()
        while self._later and self._later[0][0] <= now:
            ready += heapq.heappop(self._later)[2]
        if ready and self.plugged:
            with suppress(BlockingIOError, OSError):
                os.write(self._ours, ready)
