"""The memory of a device on the bus: reads and writes by the rules of its control table."""

from enum import Enum

from hardware_agent.virtual.tables import ControlTable, Register


class Fault(Enum):
    """Why a device refuses; bits of Protocol 1.0 and numbers of 2.0."""

    RESULT = (1 << 6, 1)
    INSTRUCTION = (1 << 6, 2)
    CHECKSUM = (1 << 4, 3)
    RANGE = (1 << 3, 4)
    LENGTH = (1 << 3, 5)
    LIMIT = (1 << 1, 6)
    ACCESS = (1 << 3, 7)

    def code(self, protocol: int) -> int:
        """What the status packet says."""
        return self.value[protocol - 1]


class RefusedError(Exception):
    """A device does not do what it is told.

    Args:
      fault: why.
    """

    def __init__(self, fault: Fault) -> None:
        super().__init__(fault.name)
        self.fault = fault


class Memory:
    """Registers with their values.

    Args:
      table: which registers there are.
    """

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        self.bytes = bytearray(table.size)
        self._places = {
            r.name: (slice(r.address, r.end), (r.low or 0) < 0) for r in table.registers
        }
        self._stretches: dict[tuple[int, int], list[Register]] = {}
        for register in table.registers:
            self.put(register.name, register.initial)

    def get(self, name: str) -> int:
        """The value of a register; signed where it can be negative."""
        place, signed = self._places[name]
        return int.from_bytes(self.bytes[place], "little", signed=signed)

    def put(self, name: str, value: int) -> None:
        """Set a register without asking; negative numbers as two's complement."""
        register = self.table.names[name]
        masked = value & ((1 << 8 * register.length) - 1)
        self.bytes[register.address : register.end] = masked.to_bytes(register.length, "little")

    def restart(self) -> None:
        """Lose what the EEPROM does not keep."""
        for register in self.table.registers:
            if not register.lasting:
                self.put(register.name, register.initial)

    def within(self, address: int, length: int) -> list[Register]:
        """Registers of which a stretch of addresses has a byte.

        Raises:
          RefusedError: the table does not go that far.
        """
        stretch = address, length
        if stretch not in self._stretches:
            end = address + length
            if length == 0 or end > self.table.size:
                raise RefusedError(Fault.RANGE)
            touched = [r for r in self.table.registers if r.address < end and address < r.end]
            self._stretches[stretch] = touched
        return self._stretches[stretch]

    def writable(self, address: int, data: bytes, locked: bool) -> list[tuple[Register, int]]:
        """The registers that a write would change, with their new values.

        Args:
          address: of the first byte.
          data: what to write.
          locked: whether the EEPROM is.

        Raises:
          RefusedError: one of them cannot be written, or not this value.
        """
        registers = self.within(address, len(data))
        if not registers:
            raise RefusedError(Fault.ACCESS)
        after = self.bytes.copy()
        after[address : address + len(data)] = data
        changes = []
        for register in registers:
            if register.low is None or (register.lasting and locked):
                raise RefusedError(Fault.ACCESS)
            raw = after[register.address : register.end]
            value = int.from_bytes(raw, "little", signed=register.low < 0)
            if not register.low <= value <= register.high:
                raise RefusedError(Fault.RANGE)
            changes.append((register, value))
        return changes
