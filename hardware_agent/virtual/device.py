"""A device on the bus: memory, an id, and what it does when it is written to."""

from hardware_agent.virtual.memory import Fault, Memory, RefusedError
from hardware_agent.virtual.tables import ControlTable, Register

RETURN_DELAY = 2e-6  # s per count of the return delay
SLACK = 0.03  # by which a UART's rate may be off


class Device:
    """What answers to an id.

    Args:
      table: its registers.
    """

    def __init__(self, table: ControlTable) -> None:
        self.memory = Memory(table)
        self.alive = True
        self._waiting: tuple[int, bytes] | None = None

    @property
    def protocol(self) -> int:
        """That it speaks."""
        return self.memory.table.protocol

    @property
    def id(self) -> int:
        """That it answers to."""
        return self.memory.get("id")

    @property
    def powered(self) -> bool:
        """Whether it has a supply."""
        return True

    @property
    def baud(self) -> int:
        """Bits per second that it listens at."""
        return 2_000_000 // (self.memory.get("baud_rate") + 1)

    @property
    def delay(self) -> float:
        """From an instruction's last byte to its status, s."""
        return RETURN_DELAY * self.memory.get("return_delay_time")

    @property
    def locked(self) -> bool:
        """Whether the EEPROM cannot be written."""
        return False

    def alarms(self) -> int:
        """Error bits that every status carries."""
        return 0

    def refresh(self, registers: list[Register]) -> None:
        """Bring registers that tell something up to date before they are read."""

    def written(self, register: Register, value: int) -> None:
        """Act on a new value of a register."""

    def hears(self, protocol: int, baud: int | None) -> bool:
        """Whether it understands an instruction that comes by, for whomever.

        Args:
          protocol: of the instruction.
          baud: at which it was sent; None suits all.
        """
        heard = self.alive and self.powered and self.protocol == protocol
        return heard and (baud is None or abs(baud - self.baud) <= SLACK * self.baud)

    def permit(self, register: Register, value: int) -> None:
        """Refuse a value for other reasons than its range.

        Raises:
          RefusedError: with the fault.
        """

    def read(self, address: int, length: int) -> bytes:
        """What stands at an address.

        Raises:
          RefusedError: the table does not go that far.
        """
        self.refresh(self.memory.within(address, length))
        return bytes(self.memory.bytes[address : address + length])

    def write(self, address: int, data: bytes) -> None:
        """Write registers; all of them or none.

        Raises:
          RefusedError: one of them does not take it.
        """
        changes = self._changes(address, data)
        self.memory.bytes[address : address + len(data)] = data
        for register, value in changes:
            self.written(register, value)

    def _changes(self, address: int, data: bytes) -> list[tuple[Register, int]]:
        changes = self.memory.writable(address, data, self.locked)
        for register, value in changes:
            self.permit(register, value)
        return changes

    def keep(self, address: int, data: bytes) -> None:
        """Check a write and keep it for the next action.

        Raises:
          RefusedError: it could not be done.
        """
        self._changes(address, data)
        self._waiting = address, data
        self._tell_waiting(1)

    def act(self) -> None:
        """Do the write that was kept.

        Raises:
          RefusedError: there is none.
        """
        if self._waiting is None:
            raise RefusedError(Fault.INSTRUCTION)
        (address, data), self._waiting = self._waiting, None
        self._tell_waiting(0)
        self.write(address, data)

    def restart(self) -> None:
        """Lose what is not in the EEPROM, as without power."""
        self._waiting = None
        self.memory.restart()
        for register in self.memory.table.registers:
            if not register.lasting and register.low is not None:
                self.written(register, self.memory.get(register.name))

    def reset(self) -> None:
        """Go back to the factory's values."""
        for register in self.memory.table.registers:
            self.memory.put(register.name, register.initial)
        self.restart()

    def _tell_waiting(self, value: int) -> None:
        if "registered" in self.memory.table.names:
            self.memory.put("registered", value)
