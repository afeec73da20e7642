"""The bus: who answers an instruction, what, and when.

Devices that are read together answer in turn, each when it has heard the one before: where that one
is dead, all behind it stay silent.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from hardware_agent.virtual.device import Device
from hardware_agent.virtual.memory import Fault, RefusedError
from hardware_agent.virtual.packets import BROADCAST, Packet, status

PING, READ, WRITE, REG_WRITE, ACTION, FACTORY_RESET = range(1, 7)
REBOOT, SYNC_READ, SYNC_WRITE, BULK_READ, BULK_WRITE = 0x08, 0x82, 0x83, 0x92, 0x93
ALERT = 0x80  # bit of a status of 2.0
ONLY_PING, ONLY_READ, ALL = range(3)  # status return levels


@dataclass(frozen=True)
class Reply:
    """A status packet on its way.

    Attributes:
      wait: from the end of the packet before to its first byte, s.
      data: the packet.
    """

    wait: float
    data: bytes


class Bus:
    """Devices on one wire.

    Args:
      devices: on it; two with one id both act, and the first one is heard.
    """

    def __init__(self, devices: Sequence[Device]) -> None:
        self.devices = tuple(devices)
        both = {
            PING: _ping,
            READ: _read,
            WRITE: _write,
            REG_WRITE: _keep,
            ACTION: _act,
            FACTORY_RESET: _reset,
        }
        self._single: dict[tuple[int, int], Callable[[Packet, Device], bytes]] = {
            (protocol, instruction): do for protocol in (1, 2) for instruction, do in both.items()
        }
        self._single[2, REBOOT] = _reboot

    def handle(self, packet: Packet, baud: int | None = None) -> list[Reply]:
        """Do what a packet says.

        Args:
          packet: from the host.
          baud: at which it was sent; None reaches every device.

        Returns:
          What comes back, in order.
        """
        hearing = [device for device in self.devices if device.hears(packet.protocol, baud)]
        if packet.instruction in (SYNC_READ, BULK_READ):
            return self._read_in_turn(packet, hearing)
        if packet.instruction in (SYNC_WRITE, BULK_WRITE):
            self._write_together(packet, hearing)
            return []
        found = [d for d in hearing if packet.id in (d.id, BROADCAST)]
        if packet.id == BROADCAST:
            found.sort(key=lambda device: device.id)
        answers = [self._answer(packet, device) for device in found]
        told = [reply for reply in answers if reply is not None]
        return told if packet.id == BROADCAST else told[:1]

    def _answer(self, packet: Packet, device: Device) -> Reply | None:
        """Let one device do a single instruction."""
        if packet.id == BROADCAST:
            if not packet.sound:
                return None
            silent = packet.instruction != PING or packet.protocol == 1
        else:
            level = device.memory.get("status_return_level")
            needed = {PING: ONLY_PING, READ: ONLY_READ}.get(packet.instruction, ALL)
            silent = level < needed
        id = device.id  # a new id or delay counts from the next packet on
        fault, data = 0, b""
        try:
            data = self._do(packet, device)
        except RefusedError as refused:
            fault = refused.fault.code(device.protocol)
        return None if silent else _reply(device, id, fault, data)

    def _do(self, packet: Packet, device: Device) -> bytes:
        if not packet.sound:
            raise RefusedError(Fault.CHECKSUM)
        do = self._single.get((packet.protocol, packet.instruction))
        if do is None:
            raise RefusedError(Fault.INSTRUCTION)
        return do(packet, device)

    def _read_in_turn(self, packet: Packet, hearing: list[Device]) -> list[Reply]:
        if not packet.sound or packet.id != BROADCAST:
            return []
        by_id = {device.id: device for device in reversed(hearing)}
        replies: list[Reply] = []
        for id, address, length in _asked(packet):
            device = by_id.get(id)
            if device is None or device.memory.get("status_return_level") < ONLY_READ:
                break
            try:
                replies.append(_reply(device, id, 0, device.read(address, length)))
            except RefusedError as refused:
                replies.append(_reply(device, id, refused.fault.code(device.protocol)))
        return replies

    def _write_together(self, packet: Packet, hearing: list[Device]) -> None:
        if not packet.sound or packet.id != BROADCAST:
            return
        by_id = {device.id: device for device in reversed(hearing)}
        for id, address, data in _told(packet):
            if id in by_id:
                try:
                    by_id[id].write(address, data)
                except RefusedError:
                    continue  # nobody is told of it


def _reply(device: Device, id: int, fault: int, data: bytes = b"") -> Reply:
    alarms = device.alarms()
    error = fault | (alarms if device.protocol == 1 else ALERT * bool(alarms))
    return Reply(device.delay, status(device.protocol, id, error, data))


def _ping(packet: Packet, device: Device) -> bytes:
    if device.protocol == 1:
        return b""
    firmware = device.memory.table.names["firmware"].address
    return device.read(0, 2) + device.read(firmware, 1)


def _read(packet: Packet, device: Device) -> bytes:
    width = packet.protocol
    if len(packet.parameters) != 2 * width:
        raise RefusedError(Fault.LENGTH)
    return device.read(_number(packet.parameters[:width]), _number(packet.parameters[width:]))


def _write(packet: Packet, device: Device) -> bytes:
    device.write(*_addressed(packet))
    return b""


def _keep(packet: Packet, device: Device) -> bytes:
    device.keep(*_addressed(packet))
    return b""


def _act(packet: Packet, device: Device) -> bytes:
    device.act()
    return b""


def _reboot(packet: Packet, device: Device) -> bytes:
    device.restart()
    return b""


def _reset(packet: Packet, device: Device) -> bytes:
    """In 2.0 the parameter says what is kept: 1 the id, 2 the id and the baud rate."""
    kept = {0x01: ("id",), 0x02: ("id", "baud_rate")}
    names = kept.get(packet.parameters[0], ()) if packet.parameters else ()
    values = {name: device.memory.get(name) for name in names}
    device.reset()
    for name, value in values.items():
        device.memory.put(name, value)
    return b""


def _addressed(packet: Packet) -> tuple[int, bytes]:
    width = packet.protocol
    if len(packet.parameters) <= width:
        raise RefusedError(Fault.LENGTH)
    return _number(packet.parameters[:width]), packet.parameters[width:]


def _asked(packet: Packet) -> Iterator[tuple[int, int, int]]:
    """Id, address and length of everything that a sync or bulk read asks for."""
    told = packet.parameters
    if packet.protocol == 1:
        if packet.instruction == BULK_READ:
            for i in range(1, len(told) - 2, 3):
                yield told[i + 1], told[i + 2], told[i]
    elif packet.instruction == SYNC_READ:
        for id in told[4:]:
            yield id, _number(told[:2]), _number(told[2:4])
    else:
        for i in range(0, len(told) - 4, 5):
            yield told[i], _number(told[i + 1 : i + 3]), _number(told[i + 3 : i + 5])


def _told(packet: Packet) -> Iterator[tuple[int, int, bytes]]:
    """Id, address and data of everything that a sync or bulk write brings."""
    told, width = packet.parameters, packet.protocol
    if packet.instruction == SYNC_WRITE:
        address, length = _number(told[:width]), _number(told[width : 2 * width])
        for i in range(2 * width, len(told) - length, length + 1):
            yield told[i], address, told[i + 1 : i + 1 + length]
    elif width == 2:
        i = 0
        while i + 5 <= len(told):
            length = _number(told[i + 3 : i + 5])
            yield told[i], _number(told[i + 1 : i + 3]), told[i + 5 : i + 5 + length]
            i += 5 + length


def _number(raw: bytes) -> int:
    return int.from_bytes(raw, "little")
