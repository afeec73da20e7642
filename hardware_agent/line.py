"""The wire to the servos: it has one owner, and takes one question or packet at a time."""

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress

from dynamixel_sdk import COMM_SUCCESS, PacketHandler

from hardware_agent.config import BusSettings
from hardware_agent.port import FAILURES, BusError, Port, device_error
from hardware_agent.registers import REGISTERS, Span

PAUSE = 0.02  # s after a silence: an answer says not to which question, and may only be late
REFUSAL = {1: 0x58, 2: 0x7F}
"""Bits of a status packet's error byte, by protocol, that say that nothing was done."""
ABSENT = 0x08
"""That of 1.0 which says that there is no such register; 2.0 never has it."""


class Line:
    """Servos on a port, one by one.

    Args:
      settings: of the port.
      ids: of the servos, in the order of the joints.
    """

    def __init__(self, settings: BusSettings, ids: Sequence[int]) -> None:
        self.settings = settings
        self.ids = tuple(ids)
        self.registers = REGISTERS[settings.protocol]
        self._port = Port(settings.port, settings.baud, settings.timeout)
        self._packets = PacketHandler(float(settings.protocol))

    def attach(self) -> None:
        """Open the port without taking the bus: for who may have to take it over.

        A port that is not there is looked for again then.
        """
        with suppress(BusError):
            self._port.open()

    @property
    def descriptor(self) -> int | None:
        """File descriptor of the port; None while it is closed."""
        return self._port.descriptor

    def take(self) -> None:
        """Take the bus, and open the port where that is not; nothing is written.

        Raises:
          BusError: the port is not there.
          BusyError: another program owns the bus.
        """
        with self._told():
            if not self._port.is_open:
                self._port.open()
            self._port.claim()

    def close(self) -> None:
        """Give the bus up."""
        self._port.close()

    def register(self, name: int, span: Span) -> int | None:
        """A register of one servo; None when it does not tell, however often it is asked.

        Raises:
          BusError: the bus is gone.
        """
        data = self.read_one(name, span)
        return None if data is None else int.from_bytes(data, "little")

    def read_one(self, name: int, span: Span) -> bytes | None:
        """The same for several registers in a row, as they stand there."""
        with self._told():
            return self._ask_one(self._packets, name, span)

    def sure(self, name: int, span: Span) -> int:
        """A register as it is told twice alike: an answer may be a late one to another question.

        Raises:
          BusError: it is not told so.
        """
        told = None
        for _ in range(1 + self.settings.tries):
            before, told = told, self.register(name, span)
            if told is not None and told == before:
                return told
        raise BusError(f"{self.settings.port}: servo {name} does not tell its mode and limits")

    def put(self, name: int, span: Span, value: int) -> None:
        """Write a register of one servo; whether it took it, it has to be asked.

        Raises:
          BusError: the bus is gone.
        """
        address, length = span
        data = list(value.to_bytes(length, "little"))
        with self._told():
            self._packets.writeTxRx(self._use(), name, address, length, data)

    def send(self, span: Span, values: Mapping[int, int]) -> None:
        """One packet that writes a register of many servos, who do not answer.

        Raises:
          BusError: the bus is gone.
        """
        address, length = span
        parameters: list[int] = []
        bulk = self.settings.write == "bulk"
        for name, value in values.items():
            place = [*address.to_bytes(2, "little"), *length.to_bytes(2, "little")] if bulk else []
            parameters += [name, *place, *value.to_bytes(length, "little")]
        with self._told():
            port = self._use()
            if bulk:
                result = self._packets.bulkWriteTxOnly(port, parameters, len(parameters))
            else:
                result = self._packets.syncWriteTxOnly(
                    port, address, length, parameters, len(parameters)
                )
        self._sent(result)

    def send_all(self, span: Span, value: int) -> None:
        """The same value to all servos; see send."""
        self.send(span, dict.fromkeys(self.ids, value))

    def _ask_one(self, packets: PacketHandler, name: int, span: Span) -> bytes | None:
        refusal = REFUSAL[int(packets.getProtocolVersion())]
        for _ in range(self.settings.tries):
            data, result, error = packets.readTxRx(self._use(), name, *span)
            if result == COMM_SUCCESS and error & ABSENT:
                return None
            if result == COMM_SUCCESS and len(data) == span[1] and not error & refusal:
                return bytes(data)
            time.sleep(PAUSE)
        return None

    def _sent(self, result: int) -> None:
        if result != COMM_SUCCESS:
            raise BusError(f"{self.settings.port}: {self._packets.getTxRxResult(result)}")

    def _use(self) -> Port:
        """The port, free: with one owner and one thread, nobody else can be using it."""
        if not self._port.is_open:
            raise BusError(f"{self.settings.port}: is not open")
        self._port.is_using = False
        return self._port

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except FAILURES as error:
            raise BusError(f"{self.settings.port}: {device_error(error)}") from error
