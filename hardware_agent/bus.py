"""The servo bus: all servos in one question and one command, by ROBOTIS' dynamixel-sdk.

Protocol 1.0 has bulk read and sync write; 2.0 has sync and bulk of both. Answers are collected here
and not by the SDK's groups: those give up at the first servo that is silent (and with Protocol 1.0
cannot bulk read at all in release 4.1), while a tick wants what there is and who is missing.
"""

import math
import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import numpy as np
from dynamixel_sdk import COMM_SUCCESS, PacketHandler
from numpy.typing import NDArray

from hardware_agent.config import BusSettings
from hardware_agent.mounting import Mounting
from hardware_agent.plausible import Plausible
from hardware_agent.port import FAILURES, BusError, Port, device_error
from hardware_agent.registers import (
    BOARD_POWER,
    BOARD_SENSES,
    POSITION,
    REGISTERS,
    Span,
    Status,
    hardware_alarm,
)
from pup.errors import InputError

Array = NDArray[np.float64]

POWER_UP = 0.3  # s until servos answer after the board gave them current (e-manual)
PAUSE = 0.02  # s after a silence: an answer says not to which question, and may only be late
WRITES = 2  # of a command that must arrive: a noise pulse may spoil one packet
ERROR = {1: 4, 2: 8}
"""Place of the error byte in a status packet, by protocol; parameters follow."""
TRAILER = {1: 1, 2: 2}
"""Bytes of the checksum."""


@dataclass(frozen=True)
class Answers:
    """What came back of one question.

    Attributes:
      servos: by id, those that answered.
      board: bytes of BOARD_SENSES; None where they were not asked for or did not come.
      tries: questions that it took.
    """

    servos: Mapping[int, Status]
    board: bytes | None
    tries: int


class Bus:
    """The servos of a robot; the only object that writes to them.

    Args:
      settings: of the port.
      ids: of the servos, in the order of the joints.
      senses: whether the board's inertial sensors are read with the servos.
      mountings: of the servos, in the same order; without, all are as from the factory.
    """

    def __init__(
        self,
        settings: BusSettings,
        ids: Sequence[int],
        senses: bool = False,
        mountings: Sequence[Mounting] | None = None,
    ) -> None:
        self.settings = settings
        self.ids = tuple(ids)
        told = [Mounting()] * len(self.ids) if mountings is None else mountings
        self._mountings = dict(zip(self.ids, told, strict=True))
        self._reach = {name: mounting.reach for name, mounting in self._mountings.items()}
        self.registers = REGISTERS[settings.protocol]
        self._senses = senses
        self._port = Port(settings.port, settings.baud, settings.timeout)
        self._packets = PacketHandler(float(settings.protocol))
        self._plausible = Plausible()
        self._turn = 0

    def open(self) -> list[str]:
        """Take the bus, give the servos current, make them limp and set their EEPROM right.

        Returns:
          What was put right, in words.

        Raises:
          BusError: a servo does not answer.
          InputError: one is of another model, or does not hold angles.
          BusyError: another program owns the bus.
        """
        self._port.close()
        self.take()
        with self._told():
            if self.settings.board:
                self._power(self.settings.board)
            self.torque(False)
            missing = [name for name in self.ids if self._register(name, (0, 2)) is None]
            if missing:
                told = ", ".join(map(str, missing))
                raise BusError(f"{self.settings.port}: no answer from servo {told}")
            return [told for name in self.ids for told in self._set_up(name)]

    @property
    def reach(self) -> Array:
        """Least and largest angle that each servo takes as a goal, rad, shape (n_servos, 2).

        Once opened, within the limits that it holds itself.
        """
        return np.array([self._reach[name] for name in self.ids])

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
        """Open the port and take the bus; nothing is written.

        Raises:
          BusError: the port is not there.
          BusyError: another program owns the bus.
        """
        self._port.open()
        self._port.claim()

    def take_over(self) -> None:
        """Take the bus when its owner has gone; nothing is written yet.

        Raises:
          BusError: the port is not there.
        """
        if not self._port.is_open:
            self._port.open()
        self._port.claim(wait=True)

    def close(self) -> None:
        """Give the bus up."""
        self._port.close()

    def read(self) -> Answers:
        """Ask every servo; who does not answer, or what cannot be, is asked again.

        As often as the settings say; see Plausible.
        """
        detailed = self._detailed()
        found: dict[int, Status] = {}
        board: dict[int, bytes] = {}
        tries, whole = 0, False
        while not whole and tries < self.settings.tries:
            tries += 1
            left = [name for name in self.ids if name not in found]
            if tries > 1:  # Protocol 1.0: who is silent first has silenced those behind it
                left = [*left[1:], *left[:1]]
            with self._told():
                self._ask(left, detailed, board)
                self._collect(left, detailed, found, board)
            whole = len(found) == len(self.ids) and bool(board) == self._senses
        return Answers(found, next(iter(board.values()), None), tries)

    def write(self, goals: Iterable[float]) -> None:
        """Tell every servo its goal.

        Args:
          goals: finite, rad, in the order of the ids.
        """
        self._send(self.registers.goal, self._ticks(goals))

    def torque(self, on: bool) -> None:
        """Make all servos hold, or limp."""
        for _ in range(WRITES):
            self._all(self.registers.torque_enable, int(on))

    def prepare(self, goals: Sequence[float] | Array, deadline: float) -> None:
        """Set limp servos up such that they stay where they are when torque comes.

        Args:
          goals: where they are, rad.
          deadline: s without an instruction after which servos that can stop by themselves.
        """
        own = self.registers
        for span, value in zip(own.gains, self.settings.gains or own.paper, strict=True):
            self._all(span, value)
        self._all(own.speed, 0)
        self.soften(1.0)
        if own.bus_watchdog:
            self._all(own.bus_watchdog, 0)  # one that has bitten refuses goals until told so
            self._all(own.bus_watchdog, min(127, math.ceil(deadline / 0.02)))
        self.write(goals)

    def without(self, goals: Sequence[float] | Array) -> list[int]:
        """Servos that have other goals than these, or do not say which."""
        wanted = self._ticks(goals)
        with self._told():
            return [
                name
                for name, goal in wanted.items()
                if self._register(name, self.registers.goal) != goal
            ]

    def soften(self, share: float) -> None:
        """Limit the servos' power to a share of what they have."""
        for _ in range(WRITES):
            self._all(self.registers.power_limit, round(share * self.registers.full_power))

    def alarm(self, name: int) -> str:
        """Why a servo complains, in words."""
        if self.registers.hardware_error is None:
            return ""
        with self._told():
            bits = self._register(name, self.registers.hardware_error)
        return "" if bits is None else hardware_alarm(bits)

    def torque_enabled(self, name: int) -> bool | None:
        """Whether a servo holds; None when it does not answer."""
        with self._told():
            told = self._register(name, self.registers.torque_enable)
        return None if told is None else bool(told)

    def _ticks(self, goals: Iterable[float]) -> dict[int, int]:
        """Goals of joints, rad, as the servos are told them, by id."""
        each = zip(self.ids, goals, strict=True)
        return {name: self._mountings[name].ticks(goal) for name, goal in each}

    def _detailed(self) -> Collection[int]:
        """Who tells more than its position: all, or one after the other."""
        if self.settings.detail == "all":
            return frozenset(self.ids)
        self._turn = (self._turn + 1) % len(self.ids)
        return frozenset({self.ids[self._turn]})

    def _span(self, name: int, detailed: Collection[int]) -> Span:
        if name == self.settings.board:
            return BOARD_SENSES
        return self.registers.block if name in detailed else self.registers.position

    def _ask(self, left: Sequence[int], detailed: Collection[int], board: dict[int, bytes]) -> None:
        port, own = self._use(), self.registers
        asked = list(left)
        if self._senses and not board and self.settings.board:
            asked.append(self.settings.board)
        if self.settings.read == "sync":
            address, length = own.block
            result = self._packets.syncReadTx(port, address, length, asked, len(asked), False)
        else:
            parameters: list[int] = []
            for name in asked:
                address, length = self._span(name, detailed)
                if own.protocol == 1:
                    parameters += [length, name, address]
                else:
                    parameters += [
                        name,
                        *address.to_bytes(2, "little"),
                        *length.to_bytes(2, "little"),
                    ]
            more = () if own.protocol == 1 else (False,)
            result = self._packets.bulkReadTx(port, parameters, len(parameters), *more)
        if result != COMM_SUCCESS:
            raise BusError(f"{self.settings.port}: {self._packets.getTxRxResult(result)}")

    def _collect(
        self,
        left: Sequence[int],
        detailed: Collection[int],
        found: dict[int, Status],
        board: dict[int, bytes],
    ) -> None:
        """Sort answers by who they are from, until all are there or it took too long."""
        protocol = self.registers.protocol
        at = ERROR[protocol]
        wanted = set(left)
        if self._senses and not board and self.settings.board:
            wanted.add(self.settings.board)
        more = () if protocol == 1 else (False,)
        while wanted:
            packet, result = self._packets.rxPacket(self._port, *more)
            if result != COMM_SUCCESS:
                if self._port.isPacketTimeout():
                    return
                continue  # spoilt; the next may be sound
            name = packet[2] if protocol == 1 else packet[4]
            size = packet[3] if protocol == 1 else packet[5] | packet[6] << 8
            data = bytes(packet[at + 1 : (4 if protocol == 1 else 7) + size - TRAILER[protocol]])
            if name not in wanted or len(data) != self._span(name, detailed)[1]:
                continue
            wanted.discard(name)
            if name == self.settings.board:
                board[name] = data
                continue
            mounting = self._mountings[name]
            status = self.registers.status(data, packet[at], name in detailed, mounting)
            if self._plausible.believes(name, status.position, time.monotonic()):
                found[name] = status

    def _all(self, span: Span, value: int) -> None:
        self._send(span, dict.fromkeys(self.ids, value))

    def _send(self, span: Span, values: Mapping[int, int]) -> None:
        """One packet that writes a register of many servos, who do not answer."""
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
        if result != COMM_SUCCESS:
            raise BusError(f"{self.settings.port}: {self._packets.getTxRxResult(result)}")

    def _power(self, board: int) -> None:
        """Let the board, which speaks Protocol 1.0 whatever the servos speak, give them current."""
        packets = PacketHandler(1.0)
        power = self._ask_one(packets, board, BOARD_POWER)
        if power is None:
            raise BusError(f"{self.settings.port}: no answer from the board, id {board}")
        if power != 1:
            packets.writeTxRx(self._use(), board, *BOARD_POWER, [1])
            time.sleep(POWER_UP)

    def _set_up(self, name: int) -> Iterator[str]:
        """Put a limp servo's lasting settings right."""
        own, packets = self.registers, self._packets
        model = self._register(name, (0, 2))
        if model != own.model:
            raise InputError(
                f"{self.settings.port}: servo {name} is of model {model}, not an MX-28 with "
                f"Protocol {own.protocol}.0 (model {own.model}); see [bus] protocol"
            )
        for told, span, wanted in (
            ("return delay", own.return_delay, 0),
            ("status return level", own.status_level, 2),
        ):
            known = self._register(name, span)
            if known != wanted:
                packets.writeTxRx(self._use(), name, *span, [wanted])
                if self._register(name, span) != wanted:
                    raise BusError(f"{self.settings.port}: servo {name} keeps {told} {known}")
                yield f"servo {name}: {told} {known} made {wanted}"
        self._reach[name] = self._own_limits(name)

    def _own_limits(self, name: int) -> tuple[float, float]:
        """Between which angles a servo takes goals, rad; beyond them it stays where it is."""
        own, where = self.registers, f"{self.settings.port}: servo {name}"
        mode = POSITION if own.mode is None else self._sure(name, own.mode)
        least, largest = (self._sure(name, span) for span in own.limits)
        if mode != POSITION:
            raise InputError(
                f"{where} is in operating mode {mode} and takes no angles; set mode {POSITION}, "
                "position control, with ROBOTIS' tools"
            )
        if least >= largest:  # both 0 are wheel mode, both 4095 several turns
            raise InputError(
                f"{where} takes no angles, as its angle limits are {least} and {largest}; set "
                "joint mode, such as limits 0 and 4095, with ROBOTIS' tools"
            )
        return self._mountings[name].span(least, largest)

    def _sure(self, name: int, span: Span) -> int:
        """A register as it is told twice alike: an answer may be a late one to another question."""
        told = None
        for _ in range(1 + self.settings.tries):
            before, told = told, self._register(name, span)
            if told is not None and told == before:
                return told
        raise BusError(f"{self.settings.port}: servo {name} does not tell its mode and limits")

    def _register(self, name: int, span: Span) -> int | None:
        """A register of one servo; None when it does not answer, however often it is asked."""
        return self._ask_one(self._packets, name, span)

    def _ask_one(self, packets: PacketHandler, name: int, span: Span) -> int | None:
        for _ in range(self.settings.tries):
            data, result, _ = packets.readTxRx(self._use(), name, *span)
            if result == COMM_SUCCESS:
                return int.from_bytes(bytes(data), "little")
            time.sleep(PAUSE)
        return None

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
