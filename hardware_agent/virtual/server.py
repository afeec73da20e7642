"""The loop that lets a virtual robot live: ports, side door and the passing of time.

In real time, time passes with the clock and bytes take their time on the wire. In lock-step, time
stands still until a packet brings new goals, then one control period passes at once.
"""

import math
import select
import socket
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from threading import Event
from typing import Any

from hardware_agent.virtual.faults import Faults
from hardware_agent.virtual.packets import BITS, Framer
from hardware_agent.virtual.plant import Hold
from hardware_agent.virtual.robot import VirtualRobot
from hardware_agent.virtual.side import Side
from hardware_agent.virtual.skeleton import STEP
from hardware_agent.virtual.terminal import Terminal
from pup.errors import InputError

USB = 0.001  # s, latency timer of the FTDI converter
SILENCE = 0.02  # s after which an unfinished packet is given up
IDLE = 0.005  # s, the longest that the loop sleeps in real time
REST = 0.05  # s, the same in lock-step
LAG = 0.1  # s by which time may be behind before it is let go
LONGEST_WAIT = 3600.0  # s that a command may let pass


@dataclass(frozen=True)
class Ports:
    """Where the robot is to be found.

    Attributes:
      link: link to the bus's pseudo-terminal.
      imu: link to the IMU's.
      side: Unix socket for commands by hand.
    """

    link: Path
    imu: Path
    side: Path


class Server(AbstractContextManager["Server"]):
    """A virtual robot on its ports.

    Args:
      robot: what lives.
      ports: where.
      speed: of the simulated time against the clock; 0 for lock-step.
      period: that passes in lock-step when goals were written, s.

    Raises:
      InputError: a port cannot be made.
    """

    def __init__(
        self, robot: VirtualRobot, ports: Ports, speed: float = 1.0, period: float = 0.03
    ) -> None:
        if len({path.absolute() for path in (ports.link, ports.imu, ports.side)}) < 3:
            raise InputError("--link, --imu and --side: give each a path of its own")
        self.robot, self.speed, self.period = robot, speed, period
        self.faults = Faults(robot, robot.plant.characters[0].seed)
        self._framer = Framer()
        with ExitStack() as made:
            self.side = Side(ports.side, self.command)
            made.callback(self.side.close)
            self.link = Terminal(ports.link)
            made.callback(self.link.pull)
            self.imu = Terminal(ports.imu)
            made.pop_all()
        self._heard = {self.link: 0.0, self.imu: 0.0}
        self._wire = {self.link: 0.0, self.imu: 0.0}
        self._epoch = time.monotonic()
        self._held = self._holding()
        self._held_since = self._goals_since = self._epoch
        self._lost = 0.0
        self._commands = {
            "reset": self._reset,
            "release": self._release,
            "pose": self._pose,
            "time": self._time,
            "bus": self._bus,
            "wait": self._wait,
            "period": self._set_period,
            "fault": self._fault,
            "clear": self._clear,
            "battery": self._battery,
            "supply": self._supply,
            "button": self._button,
        }

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the ports back."""
        self.link.pull()
        self.imu.pull()
        self.side.close()

    def run(self, stop: Event | None = None) -> None:
        """Live until told to stop."""
        stop = stop or Event()
        while not stop.is_set():
            self.turn()

    def turn(self) -> None:
        """Wait for something to happen, and let it happen."""
        ports = [port for port in (self.link, self.imu) if port.plugged]
        listening: list[Any] = [*ports, *self.side.sockets]
        ready, _, _ = select.select(listening, [], [], self._patience(ports))
        self._keep_time()
        for one in ready:
            if one is self.link:
                self._hear_bus(self.link.read())
            elif one is self.imu:
                self._hear_imu(self.imu.read())
            elif isinstance(one, socket.socket):
                self.side.serve(one)
        if self.faults.pulled:
            self.link.drop()
        now = time.monotonic()
        for port in ports:
            port.flush(now)
        self._plug()

    def command(self, told: Mapping[str, Any]) -> dict[str, Any]:
        """Do what was said at the side door.

        Raises:
          InputError: it makes no sense.
        """
        do = self._commands.get(str(told.get("cmd")))
        if do is None:
            known = ", ".join(self._commands)
            raise InputError(f"command {told.get('cmd')!r} is unknown; known: {known}")
        return do(told) or {}

    @property
    def lock_step(self) -> bool:
        """Whether time waits for goals."""
        return self.speed == 0

    def _patience(self, ports: list[Terminal]) -> float:
        due = [port.due for port in ports if port.due is not None]
        longest = REST if self.lock_step else IDLE
        if not due:
            return longest
        return min(max(min(due) - time.monotonic(), 0.0), longest)

    def _keep_time(self) -> None:
        """Let the simulated time follow the clock."""
        if self.lock_step:
            return
        behind = (time.monotonic() - self._epoch) * self.speed - self._lost - self.robot.time
        if behind > LAG * max(self.speed, 1.0):
            self._lost += behind - STEP
            behind = STEP
        self.robot.advance(math.floor(behind / STEP) * STEP)

    def _fresh(self, port: Terminal) -> bool:
        """Whether what comes continues what came before."""
        now = time.monotonic()
        silence, self._heard[port] = now - self._heard[port], now
        return silence < SILENCE

    def _hear_bus(self, data: bytes) -> None:
        if self.faults.pulled:
            return
        if not self._fresh(self.link):
            self._framer.clear()
        baud = self.link.baud
        for packet in self._framer.feed(self.faults.disturb(data)):
            before = self.robot.plant.ordered
            replies = self.robot.bus.handle(packet, baud)
            self._begin(self.link, packet.size, baud)
            for reply in replies:
                self._send(self.link, self.faults.disturb(reply.data), reply.wait, baud)
            if self.robot.plant.ordered != before:
                self._goals_since = time.monotonic()
                if self.lock_step:
                    self.robot.advance(self.period)
        self._note()

    def _hear_imu(self, data: bytes) -> None:
        if not self._fresh(self.imu):
            self.robot.imu.clear()
        if self.imu.baud != self.robot.imu.BAUD:
            return
        self._begin(self.imu, len(data), self.robot.imu.BAUD)
        for answer in self.robot.imu.feed(data):
            self._send(self.imu, answer, 0.0, self.robot.imu.BAUD)

    def _begin(self, port: Terminal, size: int, baud: int) -> None:
        """An instruction takes its time on the wire."""
        if not self.lock_step:
            start = max(time.monotonic(), self._wire[port])
            self._wire[port] = start + BITS * size / baud / self.speed

    def _send(self, port: Terminal, data: bytes, wait: float, baud: int) -> None:
        """So does an answer, which then waits for the converter."""
        if self.lock_step:
            port.send(data)
            return
        self._wire[port] += (wait + BITS * len(data) / baud) / self.speed
        port.send(data, math.ceil(self._wire[port] / USB) * USB)

    def _holding(self) -> tuple[int, float]:
        """How many servos hold, and with what share of their power the strongest does."""
        orders = self.robot.plant.drives.orders
        return int(orders.power[0].sum()), float((orders.limit * orders.power)[0].max())

    def _note(self) -> None:
        """Note when it was that servos began or ceased to hold."""
        holding = self._holding()
        if holding != self._held:
            self._held, self._held_since = holding, time.monotonic()

    def _plug(self) -> None:
        if self.faults.unplugged:
            self.link.pull()
        else:
            self.link.plug()

    def _reset(self, told: Mapping[str, Any]) -> dict[str, Any]:
        held = str(told.get("hold", "hand")).upper()
        if held not in Hold.__members__:
            raise InputError("reset: hold is hand, rope or not")
        draw = told.get("draw")
        if draw is not None and (type(draw) is not int or not 0 <= draw < 2**64):
            raise InputError("reset: draw is a whole number from 0 to 2^64 - 1")
        self.robot.reset(Hold[held], draw)
        return asdict(self.robot.pose())

    def _release(self, told: Mapping[str, Any]) -> None:
        self.robot.release()

    def _pose(self, told: Mapping[str, Any]) -> dict[str, Any]:
        return asdict(self.robot.pose())

    def _time(self, told: Mapping[str, Any]) -> dict[str, Any]:
        return {"time": self.robot.time, "lock_step": self.lock_step, "lag": self._lost}

    def _bus(self, told: Mapping[str, Any]) -> dict[str, Any]:
        self._note()
        return {
            "clock": time.monotonic(),
            "holding": self._held[0],
            "power": self._held[1],
            "holding_since": self._held_since,
            "goals_since": self._goals_since,
        }

    def _wait(self, told: Mapping[str, Any]) -> dict[str, Any]:
        if not self.lock_step:
            raise InputError("wait: only in lock-step; in real time, wait yourself")
        self.robot.advance(_seconds(told, "time", LONGEST_WAIT))
        return {"time": self.robot.time}

    def _set_period(self, told: Mapping[str, Any]) -> None:
        self.period = _seconds(told, "time", 1.0)

    def _fault(self, told: Mapping[str, Any]) -> None:
        self.faults.cause(told)

    def _clear(self, told: Mapping[str, Any]) -> None:
        self.faults.clear()

    def _battery(self, told: Mapping[str, Any]) -> None:
        self.robot.battery()

    def _supply(self, told: Mapping[str, Any]) -> None:
        """The main switch, off and on."""
        for servo in self.robot.servos:
            servo.supply(False)
            servo.supply(True)

    def _button(self, told: Mapping[str, Any]) -> None:
        pressed = told.get("pressed")
        if pressed not in (0, 1, 2, 3):
            raise InputError("button: pressed is 0 to 3, the sum of 1 and 2 for the two buttons")
        self.robot.board.button = int(pressed)


def _seconds(told: Mapping[str, Any], name: str, most: float) -> float:
    value = told.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= most:
        raise InputError(f"{told['cmd']}: {name} is not a number of seconds up to {most:g}")
    return float(value)
