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
from hardware_agent.keeping import MODEL, check_model, kept, put_right
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


@dataclass(frozen=True)
class Order:
    """What a register of all servos shall say.

    Attributes:
      name: in words.
      span: of the register.
      values: by id.
    """

    name: str
    span: Span
    values: Mapping[int, int]


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
        self._most = dict.fromkeys(self.ids, self.registers.full_power)
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
            self._switch_on(self.settings.board)
        self.torque(False)
        models = {name: self.register(name, MODEL) for name in self.ids}
        missing = [name for name, model in models.items() if model is None]
        if missing:
            told, how = ", ".join(map(str, missing)), self.settings
            known = f"; do they have current, baud {how.baud} and protocol {how.protocol}?"
            hint = known if len(missing) == len(self.ids) else ""
            raise BusError(f"{how.port}: no answer from servo {told}{hint}")
        for name, model in models.items():
            check_model(self, name, model)
        changed = [told for name in self.ids for told in put_right(self, name)]
        for name in self.ids:
            own = kept(self, name)
            self._reach[name] = self._mountings[name].span(*own.limits)
            self._most[name] = own.power
        return changed

    @property
    def reach(self) -> Array:
        """Least and largest angle that each servo takes as a goal, rad, shape (n_servos, 2).

        Once opened, within the limits that it holds itself.
        """
        return np.array([self._reach[name] for name in self.ids])

    @property
    def strength(self) -> Array:
        """Share of full power that each servo allows itself, once opened, shape (n_servos,)."""
        return np.array([self._most[name] for name in self.ids]) / self.registers.full_power

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
        own = self.registers
        if own.bus_watchdog:  # one that has bitten refuses goals, power too, until told 0
            for count in (0, min(127, math.ceil(deadline / 0.02))):
                for _ in range(WRITES):
                    self.send_all(own.bus_watchdog, count)
        orders = self._orders(goals)
        for order in orders:
            for _ in range(1 if order.span == own.goal else WRITES):  # time waits for goals
                self.send(order.span, order.values)
        return {n: told for n in self.ids if (told := self._untaken(n, orders)) is not None}

    def _orders(self, goals: Sequence[float] | Array) -> list[Order]:
        """What servos must have in their registers before they hold, the goal last.

        Not their watchdog: firmware before 38 has none.
        """
        own = self.registers
        gains = zip("PID", own.gains, self.settings.gains or own.paper, strict=True)
        same = {f"{name} gain": (span, value) for name, span, value in gains}
        same["goal speed"] = own.speed, 0
        return [
            *(Order(n, span, dict.fromkeys(self.ids, value)) for n, (span, value) in same.items()),
            Order("power limit", own.power_limit, self._power(1.0)),
            Order("goal", own.goal, self._ticks(goals)),
        ]

    def _untaken(self, name: int, orders: Iterable[Order]) -> str | None:
        """What of its orders a servo has not taken, in words; None where it has them all."""
        first, _ = self.registers.orders
        block = self.read_one(name, self.registers.orders)
        if block is None:
            return "does not tell its goal"
        for order in orders:
            address, length = order.span
            told = int.from_bytes(block[address - first :][:length], "little")
            wanted = order.values[name]
            if told != wanted:
                return f"has {order.name} {told} instead of {wanted}"
        return None

    def soften(self, share: float) -> None:
        """Limit the servos' power to a share of what they have."""
        for _ in range(WRITES):
            self.send(self.registers.power_limit, self._power(share))

    def _power(self, share: float) -> dict[int, int]:
        """Power limits, by id."""
        return {name: round(share * most) for name, most in self._most.items()}

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

    def dark(self) -> bool:
        """Whether the board says that it gives the servos no current, as after a reset of it."""
        board = self.settings.board
        return bool(board) and self._current(board) not in (ON, None)

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

    def _switch_on(self, board: int) -> None:
        """Let the board give the servos current."""
        power = self._current(board)
        if power is None:
            raise BusError(
                f"{self.settings.port}: no answer from the board, id {board}; does it have current "
                f"and baud {self.settings.baud}?"
            )
        if power != ON:
            with self._told():
                PacketHandler(1.0).writeTxRx(self._use(), board, *BOARD_POWER, list(ON))
            time.sleep(POWER_UP)

    def _current(self, board: int) -> bytes | None:
        """What the board, which speaks Protocol 1.0 whatever the servos speak, tells of it."""
        with self._told():
            return self._ask_one(PacketHandler(1.0), board, BOARD_POWER)
