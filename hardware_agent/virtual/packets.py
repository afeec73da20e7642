"""Dynamixel packets of Protocol 1.0 and 2.0 as the devices see them: instructions in, status out.

ROBOTIS e-manual, "Protocol 1.0" and "Protocol 2.0". Both may come on one wire: a header FF FF with
what would be id FD (which 1.0 does not have) and length 00 is one of 2.0.
"""

from dataclasses import dataclass

HEADER = b"\xff\xff"
HEADER_2 = b"\xff\xff\xfd\x00"
STUFFED, PLAIN = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"
BROADCAST = 0xFE
LONGEST = 1024  # bytes of a packet of 2.0 that is waited for; more is noise
STATUS = 0x55  # instruction byte of a status packet of 2.0
BITS = 10  # on the wire for a byte, 8N1


@dataclass(frozen=True)
class Packet:
    """An instruction as it arrived.

    Attributes:
      protocol: 1 or 2.
      id: whom it is for.
      instruction: what to do.
      parameters: with what, stuffing removed.
      sound: whether the checksum was right.
      size: bytes on the wire.
    """

    protocol: int
    id: int
    instruction: int
    parameters: bytes
    sound: bool
    size: int


class Framer:
    """Finds packets in a stream of bytes; what is no packet is passed over."""

    def __init__(self) -> None:
        self._left = bytearray()

    def clear(self) -> None:
        """Forget an unfinished packet, as devices do when the line falls silent."""
        self._left.clear()

    def feed(self, data: bytes) -> list[Packet]:
        """Packets that these bytes complete."""
        self._left += data
        found: list[Packet] = []
        while True:
            start = self._left.find(HEADER)
            if start < 0:
                del self._left[: max(0, len(self._left) - 1)]
                return found
            del self._left[:start]
            taken, packet = _first(self._left)
            if taken == 0:
                return found
            del self._left[:taken]
            if packet is not None:
                found.append(packet)


def _first(data: bytearray) -> tuple[int, Packet | None]:
    """Bytes to take off, 0 to wait for more, and the packet that they are, if any."""
    if len(data) < 4:
        return 0, None
    if data[2] == 0xFF:
        return 1, None  # the header begins one byte later
    if data[2] == 0xFD:
        return _second_protocol(data) if data[3] == 0 else (3, None)
    length = data[3]
    if length < 2:
        return 3, None
    size = length + 4
    if len(data) < size:
        return 0, None
    raw = bytes(data[:size])
    packet = Packet(1, raw[2], raw[4], raw[5:-1], checksum(raw[2:-1]) == raw[-1], size)
    return size, packet


def _second_protocol(data: bytearray) -> tuple[int, Packet | None]:
    if len(data) < 7:
        return 0, None
    length = data[5] | data[6] << 8
    size = length + 7
    if length < 3 or size > LONGEST:
        return 4, None
    if len(data) < size:
        return 0, None
    raw = bytes(data[:size])
    body = raw[7:-2].replace(STUFFED, PLAIN)
    sound = crc(raw[:-2]) == raw[-2] | raw[-1] << 8
    return size, Packet(2, raw[4], body[0], body[1:], sound, size)


def status(protocol: int, device: int, error: int, parameters: bytes = b"") -> bytes:
    """A status packet.

    Args:
      protocol: 1 or 2.
      device: its id.
      error: error bits of 1.0, or alert bit and error number of 2.0.
      parameters: what was read.
    """
    if protocol == 1:
        body = bytes([device, len(parameters) + 2, error]) + parameters
        return HEADER + body + bytes([checksum(body)])
    stuffed = (bytes([STATUS, error]) + parameters).replace(PLAIN, STUFFED)
    raw = HEADER_2 + bytes([device]) + (len(stuffed) + 2).to_bytes(2, "little") + stuffed
    return raw + crc(raw).to_bytes(2, "little")


def checksum(body: bytes) -> int:
    """The checksum of 1.0 over everything behind the header."""
    return ~sum(body) & 0xFF


def crc(data: bytes) -> int:
    """CRC-16 of 2.0: polynomial 0x8005, from 0, not reflected."""
    value = 0
    for byte in data:
        value = (value << 8 & 0xFF00) ^ _CRC[value >> 8 ^ byte]
    return value


def _crc_of(byte: int) -> int:
    value = byte << 8
    for _ in range(8):
        value = value << 1 ^ (0x8005 if value & 0x8000 else 0)
    return value & 0xFFFF


_CRC = tuple(_crc_of(byte) for byte in range(256))
