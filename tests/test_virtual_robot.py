"""A virtual robot on its bus, as the real Dynamixel SDK finds it."""

import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from dynamixel_sdk import (
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
)
from virtual_robots import BOARD, DARWIN, IDS, Bench, virtual_robot

from hardware_agent.virtual.packets import Framer, checksum, crc, status

TICK = 2 * math.pi / 4096
START = np.round(2048 + np.array(DARWIN.gait.start) / TICK).astype(int)
RANGE, LIMIT, CHECKSUM, INSTRUCTION = 1 << 3, 1 << 1, 1 << 4, 1 << 6
RESULT_2, INSTRUCTION_2, CRC_2, RANGE_2, LENGTH_2, LIMIT_2, ACCESS_2 = range(1, 8)


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with virtual_robot(tmp_path_factory.mktemp("one"), protocol=1) as bench:
        bench.power()
        yield bench


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with virtual_robot(tmp_path_factory.mktemp("two"), protocol=2) as bench:
        bench.power()
        yield bench


def raw_1(bench: Bench, id: int, instruction: int, *parameters: int) -> bytes:
    """Send a packet of 1.0 by hand; what comes back within a moment."""
    body = bytes([id, len(parameters) + 2, instruction, *parameters])
    return exchange(bench, b"\xff\xff" + body + bytes([checksum(body)]))


def exchange(bench: Bench, data: bytes) -> bytes:
    bench.port.ser.reset_input_buffer()
    bench.port.writePort(data)
    time.sleep(0.2)
    return bytes(bench.port.readPort(1024))


def test_servos_have_no_current_before_the_board_gives_it(tmp_path: Path) -> None:
    with virtual_robot(tmp_path) as bench:
        assert bench.packets.ping(bench.port, BOARD) == (29696, COMM_SUCCESS, 0)
        assert bench.packets.ping(bench.port, 1)[1] == COMM_RX_TIMEOUT
        bench.power()
        assert bench.packets.ping(bench.port, 1) == (29, COMM_SUCCESS, 0)
        bench.set(1, 25, 1, 1)
        bench.set(BOARD, 24, 1, 0)
        assert bench.packets.ping(bench.port, 1)[1] == COMM_RX_TIMEOUT
        bench.power()
        assert bench.read(1, 25, 1) == 0  # RAM is lost without current


def test_every_servo_answers_to_its_id(one: Bench, two: Bench) -> None:
    for bench, model in ((one, 29), (two, 30)):
        for id in IDS:
            assert bench.packets.ping(bench.port, id) == (model, COMM_SUCCESS, 0)
        assert bench.packets.ping(bench.port, 99)[1] == COMM_RX_TIMEOUT


def test_broadcast_ping_of_2_lists_all(two: Bench) -> None:
    found, result = two.packets.broadcastPing(two.port)
    assert result == COMM_SUCCESS
    assert sorted(found) == sorted(IDS)
    assert set(map(tuple, found.values())) == {(30, 42)}


def test_registers_of_1_start_as_the_factory_sets_them(one: Bench) -> None:
    known = {5: (1, 250), 8: (2, 4095), 11: (1, 80), 14: (2, 1023), 17: (1, 36), 28: (1, 32)}
    for address, (length, value) in known.items():
        assert one.read(IDS[3], address, length) == value
    assert 10.0 < one.read(IDS[3], 42, 1) / 10 < 13.0
    assert one.read(IDS[3], 43, 1) == 25
    assert one.read(IDS[3], 30, 2) == one.read(IDS[3], 36, 2)  # the goal is where it stands


def test_reg_write_waits_for_action(one: Bench) -> None:
    id = 19
    before = one.read(id, 34, 2)
    data = [0x00, 0x02]
    assert one.packets.regWriteTxRx(one.port, id, 34, 2, data) == (COMM_SUCCESS, 0)
    assert (one.read(id, 34, 2), one.read(id, 44, 1)) == (before, 1)
    assert one.packets.action(one.port, 0xFE) == COMM_SUCCESS
    assert (one.read(id, 34, 2), one.read(id, 44, 1)) == (512, 0)
    one.set(id, 34, 2, before)
    assert raw_1(one, id, 5)[4] == INSTRUCTION  # an action without anything to do


def test_bulk_read_and_sync_write_of_1(one: Bench) -> None:
    one.sync_write(25, 1, dict.fromkeys(IDS, 1))
    assert one.bulk_read([(id, 25, 1) for id in IDS]) == [1] * 20
    sync = GroupSyncWrite(one.port, one.packets, 25, 1)
    for id in IDS:
        assert sync.addParam(id, [0])
    assert sync.txPacket() == COMM_SUCCESS
    both = [(BOARD, 24, 30), *((id, 36, 2) for id in IDS)]
    board, *positions = one.bulk_read(both)
    assert board & 1 == 1
    assert np.abs(np.array(positions) - START).max() < 30  # bias of the encoders, in ticks


def test_what_1_refuses(one: Bench) -> None:
    id = 20
    assert one.write(id, 34, 2, 1024) == (COMM_SUCCESS, RANGE)
    assert one.write(id, 36, 2, 100) == (COMM_SUCCESS, RANGE)  # read only
    assert one.write(id, 200, 1, 1) == (COMM_SUCCESS, RANGE)  # there is nothing
    assert one.write(id, 30, 2, 4096) == (COMM_SUCCESS, RANGE)
    one.set(id, 6, 2, 1000)
    assert one.write(id, 30, 2, 999) == (COMM_SUCCESS, LIMIT)
    one.set(id, 6, 2, 0)
    assert raw_1(one, id, 0x77)[4] == INSTRUCTION
    assert exchange(one, bytes([255, 255, id, 2, 1, 0]))[4] == CHECKSUM
    assert raw_1(one, id, 0x82, 36, 2) == b""  # sync read is one of 2.0


def test_eeprom_is_locked_under_torque(one: Bench, two: Bench) -> None:
    for bench, torque, delay, refused in ((one, 24, 5, RANGE), (two, 64, 9, ACCESS_2)):
        id = IDS[7]
        bench.set(id, delay, 1, 7)
        bench.set(id, torque, 1, 1)
        assert bench.write(id, delay, 1, 8) == (COMM_SUCCESS, refused)
        bench.set(id, torque, 1, 0)
        bench.set(id, delay, 1, 8)
        assert bench.read(id, delay, 1) == 8


def test_lock_of_1_lasts_until_the_current_is_off(tmp_path: Path) -> None:
    with virtual_robot(tmp_path) as bench:
        bench.power()
        bench.set(3, 5, 1, 0)
        bench.set(3, 47, 1, 1)
        assert bench.write(3, 5, 1, 9) == (COMM_SUCCESS, RANGE)
        bench.set(BOARD, 24, 1, 0)
        bench.power()
        assert bench.read(3, 5, 1) == 0
        bench.set(3, 5, 1, 9)


def test_ids_bauds_and_silence_can_be_set(tmp_path: Path) -> None:
    with virtual_robot(tmp_path) as bench:
        bench.power()
        bench.set(5, 3, 1, 55)
        assert bench.packets.ping(bench.port, 5)[1] == COMM_RX_TIMEOUT
        assert bench.packets.ping(bench.port, 55)[1] == COMM_SUCCESS
        bench.set(55, 16, 1, 1)  # answers pings and reads only
        assert bench.write(55, 25, 1, 1)[0] == COMM_RX_TIMEOUT
        assert bench.read(55, 25, 1) == 1
        bench.write(55, 4, 1, 34)
        assert bench.packets.ping(bench.port, 55)[1] == COMM_RX_TIMEOUT
        bench.port.setBaudRate(57600)
        assert bench.packets.ping(bench.port, 55)[1] == COMM_SUCCESS
        assert bench.packets.ping(bench.port, 1)[1] == COMM_RX_TIMEOUT
        bench.port.setBaudRate(1_000_000)
        assert bench.packets.ping(bench.port, 1)[1] == COMM_SUCCESS
        assert raw_1(bench, 1, 6)[4] == 0  # factory reset: the id is 1, and it was
        assert bench.packets.ping(bench.port, 1)[1] == COMM_SUCCESS


def test_together_reads_and_writes_of_2(two: Bench) -> None:
    read = GroupSyncRead(two.port, two.packets, 132, 4)
    write = GroupSyncWrite(two.port, two.packets, 80, 6)
    for id in IDS:
        read.addParam(id)
        write.addParam(id, [0, 2, 0, 0, 0x20, 3])
    assert read.txRxPacket() == COMM_SUCCESS
    positions = [read.getData(id, 132, 4) for id in IDS]
    assert np.abs(np.array(positions) - START).max() < 30
    assert write.txPacket() == COMM_SUCCESS
    assert two.read(IDS[5], 80, 2) == 512
    assert two.read(IDS[5], 84, 2) == 800

    bulk = GroupBulkWrite(two.port, two.packets)
    bulk.addParam(IDS[0], 65, 1, [1])
    bulk.addParam(IDS[1], 84, 2, [0x52, 3])
    assert bulk.txPacket() == COMM_SUCCESS
    asked = GroupBulkRead(two.port, two.packets)
    asked.addParam(IDS[0], 65, 1)
    asked.addParam(IDS[1], 84, 2)
    assert asked.txRxPacket() == COMM_SUCCESS
    assert asked.getData(IDS[0], 65, 1) == 1
    assert asked.getData(IDS[1], 84, 2) == 850


def test_what_2_refuses(two: Bench) -> None:
    id = 20
    assert two.write(id, 84, 2, 16384) == (COMM_SUCCESS, RANGE_2)
    assert two.write(id, 132, 4, 0) == (COMM_SUCCESS, ACCESS_2)
    assert two.write(id, 116, 4, 4096) == (COMM_SUCCESS, LIMIT_2)
    body = b"\xff\xff\xfd\x00" + bytes([id, 3, 0, 0x01])
    answer = exchange(two, body + (crc(body) ^ 1).to_bytes(2, "little"))
    assert answer[8] == CRC_2
    body = b"\xff\xff\xfd\x00" + bytes([id, 3, 0, 0x77])
    assert exchange(two, body + crc(body).to_bytes(2, "little"))[8] == INSTRUCTION_2
    body = b"\xff\xff\xfd\x00" + bytes([id, 5, 0, 0x02, 132, 0])
    assert exchange(two, body + crc(body).to_bytes(2, "little"))[8] == LENGTH_2


def test_indirect_addresses_of_2(two: Bench) -> None:
    id = IDS[9]
    for i, address in enumerate((144, 145, 146, 65)):
        two.set(id, 168 + 2 * i, 2, address)
    direct = two.read(id, 144, 2), two.read(id, 146, 1)
    data, result, error = two.packets.readTxRx(two.port, id, 224, 4)
    assert (result, error) == (COMM_SUCCESS, 0)
    assert (data[0] | data[1] << 8, data[2]) == direct
    two.set(id, 227, 1, 1)
    assert two.read(id, 65, 1) == 1


def test_stuffing_survives_a_round_trip(two: Bench) -> None:
    """FF FF FD in a parameter is stuffed on the wire, both ways."""
    id = IDS[2]
    payload = [0xFF, 0xFF, 0xFD, 0x00]
    assert two.packets.writeTxRx(two.port, id, 20, 4, payload)[1] == RANGE_2
    for i, address in enumerate((230, 231, 232, 233)):
        two.set(id, 168 + 2 * i, 2, address)
    assert two.packets.writeTxRx(two.port, id, 230, 4, payload) == (COMM_SUCCESS, 0)
    data, result, error = two.packets.readTxRx(two.port, id, 224, 4)
    assert (list(data), result, error) == (payload, COMM_SUCCESS, 0)


def test_reboot_of_2(two: Bench) -> None:
    two.set(IDS[4], 65, 1, 1)
    assert two.packets.reboot(two.port, IDS[4]) == (COMM_SUCCESS, 0)
    assert two.read(IDS[4], 65, 1) == 0


def test_bus_watchdog_of_2_stops_the_servo(two: Bench) -> None:
    id = 19
    two.set(id, 64, 1, 1)
    two.set(id, 98, 1, 5)  # 0.1 s
    two.set(id, 116, 4, 2048)
    assert two.side("wait", time=0.5)["ok"]
    assert two.read(id, 98, 1) == 255
    assert two.write(id, 116, 4, 2048) == (COMM_SUCCESS, ACCESS_2)
    two.set(id, 98, 1, 0)
    two.set(id, 116, 4, 2048)
    two.set(id, 64, 1, 0)


def test_crc_is_the_sdks(two: Bench) -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        data = rng.bytes(int(rng.integers(1, 40)))
        assert crc(data) == two.packets.updateCRC(0, data, len(data))


def test_a_packet_may_come_in_pieces() -> None:
    framer = Framer()
    packet = status(1, 7, 0, b"\x01\x02")
    for byte in b"\xff\x00\xff" + packet[:-1]:
        assert framer.feed(bytes([byte])) == []
    (found,) = framer.feed(packet[-1:])
    assert (found.id, found.parameters, found.sound) == (7, b"\x01\x02", True)


def test_boards_sensors(one: Bench) -> None:
    one.side("reset")
    one.side("wait", time=0.1)
    x, y, z = (one.read(BOARD, address, 2) for address in (44, 46, 48))
    force = (np.array([x, y, z]) - 512) / 512 * 4 * 9.81
    assert np.linalg.norm(force) == pytest.approx(9.81, abs=0.5)
    assert force[2] > 9.0
    lean = math.sin(one.side("pose")["tilt"][1])
    assert lean > 0.1 and force[1] == pytest.approx(-9.81 * lean, abs=1.0), "forward: below 512"
    for address in (38, 40, 42):
        assert abs(one.read(BOARD, address, 2) - 512) < 10
    assert one.read(BOARD, 30, 1) == 0
    one.side("button", pressed=3)
    assert one.read(BOARD, 30, 1) == 3
    one.side("button", pressed=0)


def test_bno055(one: Bench) -> None:
    one.side("reset")
    with one.imu() as imu:

        def ask(*data: int, answer: int) -> bytes:
            imu.write(bytes([0xAA, *data]))
            return imu.read(answer)

        assert ask(1, 0x00, 1, answer=3) == b"\xbb\x01\xa0"
        assert ask(0, 0x3D, 1, 0x00, answer=2) == b"\xee\x01"
        assert ask(1, 0x1A, 6, answer=8)[2:] == bytes(6)  # no fusion in the configuration mode
        assert ask(0, 0x3B, 1, 0x80, answer=2) == b"\xee\x01"
        assert ask(0, 0x3D, 1, 0x0C, answer=2) == b"\xee\x01"
        one.side("wait", time=0.1)
        heading, roll, pitch = np.frombuffer(ask(1, 0x1A, 6, answer=8)[2:], "<i2") / 16
        true = one.side("pose")["tilt"]
        assert pitch == pytest.approx(math.degrees(true[1]), abs=6)
        assert -roll == pytest.approx(math.degrees(true[0]), abs=6)
        assert 0 <= heading <= 360
        quaternion = np.frombuffer(ask(1, 0x20, 8, answer=10)[2:], "<i2") / 2**14
        assert np.linalg.norm(quaternion) == pytest.approx(1.0, abs=1e-3)
        gravity = np.frombuffer(ask(1, 0x2E, 6, answer=8)[2:], "<i2") / 100
        assert np.linalg.norm(gravity) == pytest.approx(9.81, abs=0.05)
        assert ask(0, 0x00, 1, 0x12, answer=2) == b"\xee\x05"  # the chip's id
        assert ask(1, 0xF0, 1, answer=2) == b"\xee\x04"
        assert ask(7, 0x00, 1, answer=2) == b"\xee\x06"


def test_lock_step_moves_time_by_a_period_per_write_of_goals(one: Bench) -> None:
    before = one.side("time")["time"]
    one.sync_write(30, 2, dict(zip(IDS, map(int, START), strict=True)))
    one.bulk_read([(id, 36, 2) for id in IDS])
    assert one.side("time")["time"] == pytest.approx(before + 0.03, abs=1e-6)
    assert one.side("period", time=0.04)["ok"]
    one.set(1, 30, 2, int(START[IDS.index(1)]))
    assert one.side("time")["time"] == pytest.approx(before + 0.07, abs=1e-6)
    one.side("period", time=0.03)


def test_side_door_refuses_nonsense(one: Bench) -> None:
    for told in (
        {"cmd": "jump"},
        {"cmd": "wait", "time": -1},
        {"cmd": "wait"},
        {"cmd": "reset", "hold": "tail"},
        {"cmd": "fault", "kind": "bad luck"},
        {"cmd": "fault", "kind": "dead_servo", "id": 77},
        {"cmd": "button", "pressed": 9},
    ):
        answer = one.side(**told)
        assert not answer["ok"]
        assert "\n" not in answer["error"]


def test_side_door_tells_when_servos_let_go(one: Bench) -> None:
    one.sync_write(24, 1, dict.fromkeys(IDS, 1))
    assert one.bulk_read([(1, 24, 1)]) == [1]
    held = one.side("bus")
    assert (held["holding"], held["power"]) == (20, 1.0)
    before = time.monotonic()
    one.sync_write(34, 2, dict.fromkeys(IDS, 102))
    one.bulk_read([(1, 24, 1)])
    soft = one.side("bus")
    assert (soft["holding"], soft["power"]) == (20, pytest.approx(0.1, abs=0.001))
    assert before < soft["holding_since"] < soft["clock"] <= time.monotonic()
    one.sync_write(24, 1, dict.fromkeys(IDS, 0))
    one.sync_write(34, 2, dict.fromkeys(IDS, 1023))
    one.bulk_read([(1, 24, 1)])
    limp = one.side("bus")
    assert (limp["holding"], limp["power"]) == (0, 0.0)
    assert limp["holding_since"] > soft["holding_since"]
