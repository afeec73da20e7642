"""MX-28 servos: what their registers say about the motion, and what the motion says in them."""

from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from hardware_agent.virtual.device import Device
from hardware_agent.virtual.drives import TICK
from hardware_agent.virtual.memory import Fault, RefusedError
from hardware_agent.virtual.plant import Plant
from hardware_agent.virtual.tables import MX28_1, MX28_2, ControlTable, Register

RPM = 2 * np.pi / 60  # rad/s
NEAR = 10  # ticks from the goal within which a servo does not count as moving
PER_KP = 8  # counts of P of 1.0 for a Kp of 1
VOLTAGE, OVERHEATING, OVERLOAD = 1 << 0, 1 << 2, 1 << 5
"""Error bits of 1.0 and bits of the hardware error status of 2.0."""


class Servo(Device):
    """A servo that moves a joint of a plant.

    Args:
      table: its registers.
      id: its id.
      plant: where the joint moves.
      joint: which one.
      lane: of which robot.
    """

    def __init__(self, table: ControlTable, id: int, plant: Plant, joint: int, lane: int) -> None:
        super().__init__(table)
        self.memory.put("id", id)
        self.plant, self.at = plant, (lane, joint)
        self.latched = 0
        self.supplied = False
        self.restart()

    @property
    def powered(self) -> bool:
        """Whether the board feeds it."""
        return self.supplied

    @property
    def volts(self) -> float:
        """Of its supply."""
        return float(self.plant.drives.volts[self.at[0], 0])

    @property
    def temperature(self) -> float:
        """That its sensor, at the case, shows; degrees C."""
        return float(self.plant.drives.case[self.at])

    @property
    def position(self) -> int:
        """That the encoder shows, ticks."""
        return int(self.plant.encoders()[self.at])

    @property
    def speed(self) -> float:
        """Of the joint, rad/s."""
        return float(self.plant.speeds[self.at])

    @property
    def duty(self) -> float:
        """Of the motor, -1 to 1."""
        return float(self.plant.drives.moving.duty[self.at])

    @property
    def locked(self) -> bool:
        """The EEPROM is locked while torque is on, and where it was locked until power is off."""
        memory = self.memory
        lock = "lock" in memory.table.names and memory.get("lock") == 1
        return bool(memory.get("torque_enable")) or lock

    def alarms(self) -> int:
        """What is wrong with the servo."""
        found, decivolts = self.latched, 10 * self.volts
        if not self.memory.get("min_voltage") <= decivolts <= self.memory.get("max_voltage"):
            found |= VOLTAGE
        if self.temperature > self.memory.get("temperature_limit"):
            found |= OVERHEATING
        return found

    def protect(self, overloaded: bool) -> None:
        """Look whether anything is wrong, and let go where the shutdown register says so.

        Args:
          overloaded: whether it has pushed with all it has for too long.
        """
        if overloaded:
            self.latched |= OVERLOAD
        wrong = self.alarms() & self.memory.get("shutdown")
        if wrong and self.memory.get("torque_enable"):
            self.latched |= wrong
            self._shut_down()

    def restart(self) -> None:
        """Power has come back: the goal is where the servo stands, torque is off."""
        self.latched = 0
        super().restart()
        self._stay()

    def supply(self, on: bool) -> None:
        """Switch the supply."""
        if on and not self.supplied:
            self.restart()
        elif not on:
            self._order("power", 0.0)
        self.supplied = on

    def plug(self, on: bool) -> None:
        """Pull its plug, upon which it goes limp and silent, or put it back."""
        if on != self.alive:
            self.alive = on
            self.restart()

    def watch(self, now: float) -> None:
        """Stop where the bus has been silent for too long; only firmware for 2.0 can.

        Args:
          now: simulated time, s.
        """

    def _shut_down(self) -> None:
        self.memory.put("torque_enable", 0)
        self._order("power", 0.0)

    def _enable(self, on: bool) -> None:
        if on and not self.plant.drives.orders.power[self.at]:
            self.plant.drives.engage(self.at, self.position)
        self._order("power", float(on))

    def _stay(self) -> None:
        """The goal becomes the present position."""
        here = self.position
        self.memory.put("goal_position", here)
        self._goal(here)

    def _goal(self, ticks: float) -> None:
        self.plant.order(*self.at, ticks)

    def _order(self, what: str, value: float) -> None:
        self.plant.drives.order(what, self.at, value)


class Servo1(Servo):
    """An MX-28 with firmware for Protocol 1.0."""

    SPEED = 0.114 * RPM  # rad/s per count
    ACCELERATION = 8.583 * np.pi / 180  # rad/s2 per count

    def __init__(self, id: int, plant: Plant, joint: int, lane: int = 0) -> None:
        super().__init__(MX28_1, id, plant, joint, lane)

    def restart(self) -> None:
        """As any servo; the torque limit starts as the EEPROM says."""
        super().restart()
        most = self.memory.get("max_torque")
        self.memory.put("torque_limit", most)
        self._order("limit", most / 1023)

    def permit(self, register: Register, value: int) -> None:
        """Goals are within the angle limits."""
        low, high = self.memory.get("cw_angle_limit"), self.memory.get("ccw_angle_limit")
        if register.name == "goal_position" and not low <= value <= high:
            raise RefusedError(Fault.LIMIT)

    def written(self, register: Register, value: int) -> None:
        """Tell the motion."""
        match register.name:
            case "goal_position":
                self._goal(value)
            case "torque_enable":
                self._enable(bool(value))
            case "torque_limit":
                self._order("limit", value / 1023)
            case "p_gain":
                self._order("kp", value)
            case "i_gain":
                self._order("ki", value * PER_KP * 1000 / 2048)
            case "d_gain":
                self._order("kd", damping(value))
            case "moving_speed":
                self._order("speed", value * self.SPEED / TICK if value else np.inf)
            case "goal_acceleration":
                self._order("acceleration", value * self.ACCELERATION / TICK if value else np.inf)

    def refresh(self, registers: list[Register]) -> None:
        """Read the sensors."""
        for register in registers:
            tell = self.TELL.get(register.name)
            if tell is not None:
                self.memory.put(register.name, tell(self))

    def _shut_down(self) -> None:
        super()._shut_down()
        self.memory.put("torque_limit", 0)
        self._order("limit", 0.0)

    TELL: ClassVar[dict[str, Callable[[Any], int]]] = {
        "present_position": lambda self: min(max(self.position, 0), 4095),
        "present_speed": lambda self: _signed(self.speed / self.SPEED, 1 << 10),
        "present_load": lambda self: _signed(self.duty * 1023, 1 << 10),
        "present_voltage": lambda self: round(self.volts * 10),
        "present_temperature": lambda self: round(self.temperature),
        "moving": lambda self: int(abs(self.memory.get("goal_position") - self.position) > NEAR),
        "realtime_tick": lambda self: round(self.plant.time * 1000) % 32768,
    }


def damping(count: int) -> float:
    """Of the D gain of 1.0, P s: Kd = 4 D / 1000."""
    return PER_KP * 4 * count / 1000


def _signed(value: float, sign: int) -> int:
    """Magnitude with a bit for clockwise, which is negative."""
    return min(round(abs(value)), sign - 1) | (sign if value < 0 else 0)


class Servo2(Servo):
    """An MX-28 with firmware for Protocol 2.0."""

    SPEED = 0.229 * RPM  # rad/s per count
    ACCELERATION = 214.577 * RPM / 60  # rad/s2 per count
    FULL = 885  # counts of full duty
    PROPORTIONAL = 4096 / (2 * np.pi) / 128 / FULL / 0.158
    """Duty per rad of one count of P, in counts of P of 1.0 (0.158 duty/rad, Rhoban's BAM)."""
    BAUDS = (9600, 57600, 115200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
    WATCH = 0.02  # s per count of the bus watchdog
    INDIRECT, DATA, COUNT = 168, 224, 28

    def __init__(self, id: int, plant: Plant, joint: int, lane: int = 0) -> None:
        self.heard = 0.0
        self.cut_off = False
        super().__init__(MX28_2, id, plant, joint, lane)

    @property
    def baud(self) -> int:
        """Bits per second that it listens at."""
        return self.BAUDS[self.memory.get("baud_rate")]

    @property
    def locked(self) -> bool:
        """The EEPROM is locked while torque is on."""
        return bool(self.memory.get("torque_enable"))

    def restart(self) -> None:
        """As any servo; the duty that may be used starts as the EEPROM says."""
        super().restart()
        most = self.memory.get("pwm_limit")
        self.memory.put("goal_pwm", most)
        self._order("limit", most / self.FULL)

    def hears(self, protocol: int, baud: int | None) -> bool:
        """As any device; the watchdog counts from here."""
        heard = super().hears(protocol, baud)
        if heard:
            self.heard = self.plant.time
        return heard

    def watch(self, now: float) -> None:
        """Stop where the bus has been silent for longer than the watchdog allows.

        Args:
          now: simulated time, s.
        """
        count = self.memory.get("bus_watchdog")
        if count > 0 and not self.cut_off and now - self.heard > count * self.WATCH:
            self.cut_off = True
            self.memory.put("bus_watchdog", -1)
            self._stay()

    def permit(self, register: Register, value: int) -> None:
        """Goals are within the limits, and refused from a watchdog's stop until it is set to 0."""
        get = self.memory.get
        if self.cut_off and (
            register.name.startswith("goal_") or (register.name == "bus_watchdog" and value)
        ):
            raise RefusedError(Fault.ACCESS)
        limits = {
            "goal_position": (get("min_position"), get("max_position")),
            "goal_pwm": (-get("pwm_limit"), get("pwm_limit")),
            "profile_velocity": (0, 32767),
        }
        low, high = limits.get(register.name, (value, value))
        if not low <= value <= high:
            raise RefusedError(Fault.LIMIT)
        if register.name == "torque_enable" and value and self.latched:
            raise RefusedError(Fault.RESULT)  # after a shutdown only a reboot helps

    def written(self, register: Register, value: int) -> None:
        """Tell the motion."""
        one, kp = self.PROPORTIONAL, self.PROPORTIONAL * 128
        match register.name:
            case "goal_position":
                self._goal(value - self.memory.get("homing_offset"))
            case "torque_enable":
                self._enable(bool(value))
            case "goal_pwm":
                self._order("limit", abs(value) / self.FULL)
            case "position_p_gain":
                self._order("kp", value * one)
            case "position_i_gain":
                self._order("ki", value * kp / 65536 * 1000)
            case "position_d_gain":
                self._order("kd", value * kp / 16 / 1000)
            case "profile_velocity":
                self._order("speed", value * self.SPEED / TICK if value else np.inf)
            case "profile_acceleration":
                self._order("acceleration", value * self.ACCELERATION / TICK if value else np.inf)
            case "bus_watchdog":
                self.cut_off = False
                self.heard = self.plant.time

    def read(self, address: int, length: int) -> bytes:
        """As any device; indirect data stand elsewhere."""
        end = address + length
        if end <= self.DATA or address >= self.DATA + self.COUNT:
            return super().read(address, length)
        self.memory.within(address, length)
        return b"".join(super(Servo2, self).read(self._real(a), 1) for a in range(address, end))

    def write(self, address: int, data: bytes) -> None:
        """As any device; indirect data go elsewhere, as far as they lie together there."""
        end = address + len(data)
        if end <= self.DATA or address >= self.DATA + self.COUNT or not data:
            super().write(address, data)
            return
        places = [self._real(a) for a in range(address, end)]
        first = 0
        for i in range(1, len(places) + 1):
            if i == len(places) or places[i] != places[i - 1] + 1:
                super().write(places[first], data[first:i])
                first = i

    def _real(self, address: int) -> int:
        """Where an address of the indirect data points."""
        if not self.DATA <= address < self.DATA + self.COUNT:
            return address
        return self.memory.get(f"indirect_address_{address - self.DATA + 1}")

    def refresh(self, registers: list[Register]) -> None:
        """Read the sensors."""
        for register in registers:
            tell = self.TELL.get(register.name)
            if tell is not None:
                self.memory.put(register.name, tell(self))

    def _shown(self) -> int:
        return self.position + self.memory.get("homing_offset")

    def _moving(self) -> int:
        return int(abs(self.speed) / self.SPEED > self.memory.get("moving_threshold"))

    def _arrived(self) -> int:
        return int(abs(self.memory.get("goal_position") - self._shown()) <= NEAR)

    TELL: ClassVar[dict[str, Callable[[Any], int]]] = {
        "hardware_error": lambda self: self.alarms(),
        "present_position": lambda self: self._shown(),
        "present_velocity": lambda self: round(self.speed / self.SPEED),
        "present_load": lambda self: round(self.duty * 1000),
        "present_pwm": lambda self: round(self.duty * self.FULL),
        "present_voltage": lambda self: round(self.volts * 10),
        "present_temperature": lambda self: round(self.temperature),
        "position_trajectory": lambda self: round(self.plant.drives.moving.goal[self.at]),
        "velocity_trajectory": lambda self: round(
            self.plant.drives.moving.pace[self.at] * TICK / self.SPEED
        ),
        "moving": _moving,
        "moving_status": _arrived,
        "realtime_tick": lambda self: round(self.plant.time * 1000) % 32768,
    }
