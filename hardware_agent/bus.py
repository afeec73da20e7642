"""The servo bus: all servos in one question and one command, by ROBOTIS' dynamixel-sdk.

Protocol 1.0 has bulk read and sync write; 2.0 has sync and bulk of both. Answers are collected here
and not by the SDK's groups: those give up at the first servo that is silent (and with Protocol 1.0
cannot bulk read at all in release 4.1), while a tick wants what there is and who is missing.
"""

import math
import time
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from dynamixel_sdk import COMM_SUCCESS, PacketHandler
from numpy.typing import NDArray

from hardware_agent.config import BusSettings
from hardware_agent.keeping import kept, put_right
from hardware_agent.line import Line
from hardware_agent.mounting import Mounting
from hardware_agent.plausible import Plausible
from hardware_agent.port import BusError
from hardware_agent.registers import BOARD_POWER, BOARD_SENSES, Span, Status, hardware_alarm

Array = NDArray[np.float64]

ON = b"\1"
POWER_UP = 0.3  # s until servos answer after the board gave them current (e-manual)
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


class Bus(Line):
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
        super().__init__(settings, ids)
        told = [Mounting()] * len(self.ids) if mountings is None else mountings
        self._mountings = dict(zip(self.ids, told, strict=True))
        self._reach = {name: mounting.reach for name, mounting in self._mountings.items()}
        self._senses = senses
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
        if self.settings.board:
            self._power(self.settings.board)
        self.torque(False)
        missing = [name for name in self.ids if self.register(name, (0, 2)) is None]
        if missing:
            told = ", ".join(map(str, missing))
            raise BusError(f"{self.settings.port}: no answer from servo {told}")
        changed = [told for name in self.ids for told in put_right(self, name)]
        for name in self.ids:
            self._reach[name] = self._mountings[name].span(*kept(self, name).limits)
        return changed

    @property
    def reach(self) -> Array:
        """Least and largest angle that each servo takes as a goal, rad, shape (n_servos, 2).

        Once opened, within the limits that it holds itself.
        """
        return np.array([self._reach[name] for name in self.ids])

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
        self.send(self.registers.goal, self._ticks(goals))

    def torque(self, on: bool) -> None:
        """Make all servos hold, or limp."""
        for _ in range(WRITES):
            self.send_all(self.registers.torque_enable, int(on))

    def prepare(self, goals: Sequence[float] | Array, deadline: float) -> dict[int, str]:
        """Set limp servos up such that they stay where they are when torque comes.

        Args:
          goals: where they are, rad.
          deadline: s without an instruction after which servos that can stop by themselves.

        Returns:
          What they tell that they did not take, in words, by id: nobody answers what is told to
          all, and a servo may refuse it.
        """
        own, ticks = self.registers, self._ticks(goals)
        if own.bus_watchdog:  # one that has bitten refuses goals, power too, until told so
            for _ in range(WRITES):
                self.send_all(own.bus_watchdog, 0)
            self.send_all(own.bus_watchdog, min(127, math.ceil(deadline / 0.02)))
        for span, value in zip(own.gains, self.settings.gains or own.paper, strict=True):
            self.send_all(span, value)
        self.send_all(own.speed, 0)
        self.soften(1.0)
        self.send(own.goal, ticks)
        power = dict.fromkeys(self.ids, own.full_power)
        return self._untaken({"goal": (own.goal, ticks), "power limit": (own.power_limit, power)})

    def _untaken(self, orders: Mapping[str, tuple[Span, Mapping[int, int]]]) -> dict[int, str]:
        """Of registers that were written, by name, what the first is that a servo has otherwise."""
        found: dict[int, str] = {}
        for name in self.ids:
            for what, (span, wanted) in orders.items():
                told = self.register(name, span)
                if told != wanted[name]:
                    found[name] = f"has {what} {told} instead of {wanted[name]}"
                    break
        return found

    def soften(self, share: float) -> None:
        """Limit the servos' power to a share of what they have."""
        for _ in range(WRITES):
            self.send_all(self.registers.power_limit, round(share * self.registers.full_power))

    def alarm(self, name: int) -> str:
        """Why a servo complains, in words."""
        if self.registers.hardware_error is None:
            return ""
        bits = self.register(name, self.registers.hardware_error)
        return "" if bits is None else hardware_alarm(bits)

    def torque_enabled(self, name: int) -> bool | None:
        """Whether a servo holds; None when it does not answer."""
        told = self.register(name, self.registers.torque_enable)
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
        self._sent(result)

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

    def _power(self, board: int) -> None:
        """Let the board, which speaks Protocol 1.0 whatever the servos speak, give them current."""
        packets = PacketHandler(1.0)
        with self._told():
            power = self._ask_one(packets, board, BOARD_POWER)
            if power is None:
                raise BusError(f"{self.settings.port}: no answer from the board, id {board}")
            if power != ON:
                packets.writeTxRx(self._use(), board, *BOARD_POWER, list(ON))
                time.sleep(POWER_UP)
