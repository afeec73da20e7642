"""Virtual robots in processes of their own, with the real Dynamixel SDK on their bus, for tests."""

import json
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import serial
from dynamixel_sdk import COMM_SUCCESS, PacketHandler, PortHandler

from pup.robot import RobotDescription

DARWIN = RobotDescription.load("darwin_op2")
IDS = [joint.servo_id for joint in DARWIN.joints]
BOARD = 200
PATIENCE = 300.0  # ms more than the SDK's: the machine may be busy


class Port(PortHandler):
    """The SDK's port, patient."""

    def setPacketTimeout(self, packet_length: int) -> None:  # noqa: N802
        super().setPacketTimeout(packet_length)
        self.packet_timeout += PATIENCE


@dataclass
class Bench:
    """A running virtual robot and the SDK on its bus."""

    folder: Path
    process: "subprocess.Popen[bytes]"
    port: Port
    packets: Any

    def side(self, cmd: str, **more: Any) -> dict[str, Any]:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as door:
            door.settimeout(30)
            door.connect(str(self.folder / "side"))
            door.sendall(json.dumps({"cmd": cmd, **more}).encode() + b"\n")
            with door.makefile("rb") as lines:
                told: dict[str, Any] = json.loads(lines.readline())
        return told

    def imu(self) -> serial.Serial:
        return serial.Serial(str(self.folder / "imu"), 115_200, timeout=2)

    def read(self, id: int, address: int, length: int) -> int:
        data, result, error = self.packets.readTxRx(self.port, id, address, length)
        assert (result, error) == (COMM_SUCCESS, 0), (id, address, result, error)
        return int.from_bytes(bytes(data), "little")

    def write(self, id: int, address: int, length: int, value: int) -> tuple[int, int]:
        data = list((value & (1 << 8 * length) - 1).to_bytes(length, "little"))
        result, error = self.packets.writeTxRx(self.port, id, address, length, data)
        return result, error

    def set(self, id: int, address: int, length: int, value: int) -> None:
        assert self.write(id, address, length, value) == (COMM_SUCCESS, 0)

    def sync_write(self, address: int, length: int, values: dict[int, int]) -> None:
        data = [b for i, v in values.items() for b in (i, *v.to_bytes(length, "little"))]
        sent = self.packets.syncWriteTxOnly(self.port, address, length, data, len(data))
        assert sent == COMM_SUCCESS

    def bulk_read(self, what: Sequence[tuple[int, int, int]]) -> list[int]:
        """Values of (id, address, length); the SDK's GroupBulkRead fails with 1.0 (4.1.0)."""
        if self.packets.getProtocolVersion() == 1.0:
            asked = [b for id, address, length in what for b in (length, id, address)]
        else:
            asked = [
                b for id, address, length in what for b in (id, address, address >> 8, length, 0)
            ]
        assert self.packets.bulkReadTx(self.port, asked, len(asked)) == COMM_SUCCESS
        found = []
        for id, _, length in what:
            data, result, error = self.packets.readRx(self.port, id, length)
            assert (result, error) == (COMM_SUCCESS, 0), (id, result, error)
            found.append(int.from_bytes(bytes(data), "little"))
        return found

    def power(self) -> None:
        """Give the servos current; a servo of 2.0 lies behind a board of 1.0."""
        result, error = PacketHandler(1.0).write1ByteTxRx(self.port, BOARD, 24, 1)
        assert (result, error) == (COMM_SUCCESS, 0)


@contextmanager
def virtual_robot(folder: Path, protocol: int = 1, **options: Any) -> Iterator[Bench]:
    """Run `pup virtual-robot` and open its bus."""
    given = {"seed": 1, "speed": 0, "protocol": protocol} | options
    ports = {name: folder / name for name in ("link", "imu", "side")}
    told = [str(part) for k, v in (given | ports).items() for part in (f"--{k}", v)]
    process = subprocess.Popen(
        [sys.executable, "-m", "services.cli", "virtual-robot", *told], stderr=subprocess.PIPE
    )
    assert process.stderr is not None
    try:
        first = process.stderr.readline().decode()
        assert first.startswith("darwin_op2: bus "), first
        port = Port(str(folder / "link"))
        port.baudrate = 1_000_000
        assert port.openPort()
        yield Bench(folder, process, port, PacketHandler(float(protocol)))
        port.closePort()
    finally:
        process.terminate()
        process.wait(30)
        process.stderr.close()
