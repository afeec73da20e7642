"""The serial port of the bus: one owner, and waiting that sleeps and keeps its time."""

import contextlib
import fcntl
import select
import termios
import time

import serial
from dynamixel_sdk import PortHandler

from pup.errors import InputError


class BusError(Exception):
    """The bus does not work; told in one line."""


class BusyError(InputError):
    """Another program has the bus."""


FAILURES = (OSError, termios.error)
"""What a port raises that was pulled; pyserial's exception is an OSError."""


class Port(PortHandler):  # type: ignore[misc]  # the SDK has no types
    """A port for the SDK whose waiting for an answer fits into a control period.

    The SDK's own waits at least 34 ms, which is more than a period, by a clock that can jump, and
    with a core at full load.

    Args:
      path: of the device.
      baud: rate, 1/s.
      timeout: largest delay of an answer beside its time on the wire, s.
    """

    def __init__(self, path: str, baud: int, timeout: float) -> None:
        super().__init__(path)
        self.baudrate = baud
        self._slack = timeout
        self._deadline = 0.0
        self._written = 0

    def open(self) -> None:
        """Open it; what was on the way is dropped.

        Raises:
          BusError: it cannot be opened.
        """
        try:
            opened = self.openPort()
        except (*FAILURES, ValueError) as error:
            told = getattr(error, "strerror", None) or error
            raise BusError(f"{self.port_name}: cannot be opened ({told})") from error
        if not opened:
            raise BusError(f"{self.port_name}: {self.baudrate} is no rate that the port knows")
        with contextlib.suppress(*FAILURES, ValueError, NotImplementedError):
            self.ser.set_low_latency_mode(True)  # 1 ms instead of 16 on USB adapters of FTDI

    @property
    def descriptor(self) -> int | None:
        """Its file descriptor; None while it is closed."""
        return int(self.ser.fileno()) if self.is_open else None

    def claim(self) -> None:
        """Become the owner: nobody else who asks can, until this process closes it or ends.

        Raises:
          BusyError: there is an owner.
        """
        try:
            fcntl.flock(self.ser.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise BusyError(
                f"{self.port_name}: another program owns the bus; end it, or is an agent running?"
            ) from error

    def close(self) -> None:
        """Close it, if it is open."""
        if self.is_open:
            with contextlib.suppress(*FAILURES):
                self.closePort()

    def writePort(self, packet: list[int]) -> int:  # noqa: N802
        """Send bytes; as the SDK calls it."""
        self._written = len(packet)
        self.ser.write(bytes(packet))
        return self._written

    def readPort(self, length: int) -> bytes:  # noqa: N802
        """Bytes that are there; none after waiting for as long as an answer may take."""
        left = self._deadline - time.monotonic()
        if left > 0:
            select.select([self.ser.fileno()], [], [], left)
        try:
            read: bytes = self.ser.read(length)
        except serial.SerialException:  # a kernel may say a moment early that bytes are there
            read = self.ser.read(length)  # and a port that was pulled fails again
        return read

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        """Expect an answer of that many bytes."""
        wire = (self._written + packet_length) * self.tx_time_per_byte / 1000
        self._deadline = time.monotonic() + wire + self._slack

    def setPacketTimeoutMillis(self, msec: float) -> None:  # noqa: N802
        """Expect an answer within a time."""
        self._deadline = time.monotonic() + msec / 1000

    def isPacketTimeout(self) -> bool:  # noqa: N802
        """Whether no answer can be expected any more."""
        return time.monotonic() > self._deadline


def device_error(error: Exception) -> str:
    """What a failing port says, in one line."""
    if isinstance(error, serial.SerialException):
        return " ".join(str(error).split())
    return getattr(error, "strerror", None) or str(error)
