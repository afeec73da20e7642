"""What stops the robot: a small class per rule, each with its own words.

Every rule is asked once a tick, after the sensors were read and before anything is written, while
torque is on. It answers None, or why the robot must stop.
"""

import math
from collections import deque
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hardware_agent.config import SafetySettings
from hardware_agent.imu import Orientation
from hardware_agent.senses import Response, Senses, Trip

Array = NDArray[np.float64]

DUTY_PER_RADIAN = 6.28  # of an MX-28 with the paper's P gain (fitted)


class Rule(Protocol):
    """A rule of safety."""

    name: str
    response: Response

    def check(self, senses: Senses) -> str | None:
        """Why the robot must stop; None when all is well."""

    def reset(self) -> None:
        """Torque comes on: forget the past."""


class _Stateless:
    response = Response.LIMP

    def reset(self) -> None:
        """Nothing to forget."""


class StaleServo(_Stateless):
    """A servo that does not answer: dead, unplugged, or the whole bus is."""

    name = "stale servo"

    def __init__(self, limits: SafetySettings) -> None:
        self._age = limits.stale

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        late = np.flatnonzero(senses.time - senses.seen > self._age)
        if not len(late):
            return None
        age = float((senses.time - senses.seen)[late].max())
        names = ", ".join(senses.names[j] for j in late[:3])
        more = f" and {len(late) - 3} more" if len(late) > 3 else ""
        return f"{names}{more} did not answer for {age * 1000:.0f} ms"


class StaleImu(_Stateless):
    """An IMU that does not answer."""

    name = "stale IMU"

    def __init__(self, limits: SafetySettings) -> None:
        self._age = limits.stale

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        age = senses.time - senses.imu_seen
        if not senses.has_imu or age <= self._age:
            return None
        return f"no reading for {age * 1000:.0f} ms"


class FrozenImu:
    """An IMU that answers the same for ever while the robot walks."""

    name, response = "frozen IMU", Response.LIMP

    def __init__(self, limits: SafetySettings) -> None:
        self._longest = limits.frozen
        self.reset()

    def reset(self) -> None:
        """See Rule."""
        self._last: Orientation | None = None
        self._since = math.nan

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        now = senses.imu
        if now is None or not senses.walking or self._last is None or not now.same(self._last):
            self._last, self._since = now, senses.time
            return None
        still = senses.time - self._since
        return f"the same reading for {still:.2f} s of walking" if still > self._longest else None


class StaleCommand(_Stateless):
    """A loop that is late: the servos still pull towards a goal of long ago."""

    name = "stale command"

    def __init__(self, limits: SafetySettings) -> None:
        self._age = limits.late

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        age = senses.time - senses.written
        return f"no command for {age * 1000:.0f} ms" if age > self._age else None


class StuckEncoder:
    """A position that does not move while its joint should: a torn encoder, or a jammed gear.

    What the joint should do is its target, followed with the lag and the speed of a healthy servo.
    """

    name, response = "stuck encoder", Response.LIMP

    def __init__(self, limits: SafetySettings) -> None:
        self._lag, self._speed = limits.lag, limits.free_speed
        self._time, self._angle = limits.stuck_time, limits.stuck_angle
        self.reset()

    def reset(self) -> None:
        """See Rule."""
        self._past: deque[tuple[float, Array, Array]] = deque()

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        expected = senses.position.copy()
        if self._past:
            before, _, expected = self._past[-1]
            step = senses.time - before
            pull = (senses.goal - expected) * min(1.0, step / self._lag)
            expected = expected + np.clip(pull, -self._speed * step, self._speed * step)
        self._past.append((senses.time, senses.position, expected))
        while len(self._past) > 2 and senses.time - self._past[1][0] >= self._time:
            self._past.popleft()
        if senses.time - self._past[0][0] < self._time - 1e-9:
            return None
        measured = np.array([position for _, position, _ in self._past])
        wanted = np.abs(expected - self._past[0][2])
        still = np.ptp(measured, axis=0) == 0
        stuck = np.flatnonzero(still & (wanted > self._angle))
        if not len(stuck):
            return None
        j = stuck[0]
        return (
            f"{senses.names[j]} reads {measured[-1, j]:.4f} rad for {self._time:g} s "
            f"while it should have moved by {wanted[j]:.2f} rad"
        )


class OverTemperature(_Stateless):
    """A servo whose case is hot."""

    name = "over-temperature"

    def __init__(self, limits: SafetySettings) -> None:
        self._limit = limits.temperature

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        hot = np.flatnonzero(senses.temperature >= self._limit)
        if not len(hot):
            return None
        j = hot[np.argmax(senses.temperature[hot])]
        return f"{senses.names[j]} has {senses.temperature[j]:.0f} °C, limit {self._limit:g}"


class Heating:
    """A case that warms fast: the winding, which the sensor is far from, is far hotter."""

    name, response = "heating", Response.LIMP

    def __init__(self, limits: SafetySettings) -> None:
        self._rate, self._time = limits.heating, limits.heating_time
        self.reset()

    def reset(self) -> None:
        """See Rule."""
        self._past: deque[tuple[float, Array]] = deque()

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        if not self._past or senses.time - self._past[-1][0] >= self._time / 20:
            self._past.append((senses.time, senses.temperature))
        while senses.time - self._past[0][0] > self._time:
            self._past.popleft()
        rise = senses.temperature - self._past[0][1]
        fast = np.flatnonzero(rise > self._rate * self._time)
        if not len(fast):
            return None
        j = fast[np.argmax(rise[fast])]
        took = senses.time - self._past[0][0]
        return f"{senses.names[j]} warmed by {rise[j]:.0f} °C in {took:.1f} s"


class Overload:
    """Too much current for too long (I²t), told from the servo's own law.

    The duty that the firmware gives for the position error, less what back-EMF takes from it, is
    the current as a share of the stall current; its square is averaged over some time.

    Args:
      limits: of the configuration.
      gain: the servos' P gain as a share of the paper's.
    """

    name, response = "overload", Response.LIMP

    def __init__(self, limits: SafetySettings, gain: float) -> None:
        self._limits = limits
        own = limits.duty_per_radian
        self._duty_per_radian = gain * DUTY_PER_RADIAN if own is None else own
        self._heat: Array = np.zeros(1)  # of each joint, once they are known
        self._last: Senses | None = None

    def reset(self) -> None:
        """See Rule: a winding forgets nothing."""

    @property
    def heat(self) -> float:
        """The hottest winding's, as a share of what is allowed."""
        return float(self._heat.max()) / self._limits.current**2

    def warm(self, share: float) -> None:
        """What an earlier agent knew of the heat, for all joints."""
        self._heat = np.full(1, share * self._limits.current**2)

    def rest(self, senses: Senses) -> None:
        """A tick without torque: windings cool."""
        last, self._last = self._last, senses
        if last is not None:
            step = max(senses.time - last.time, 0.0)
            self._heat = self._heat * math.exp(-step / self._limits.current_time)

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        limits, last, self._last = self._limits, self._last, senses
        if last is None:
            return None
        step = senses.time - last.time
        speed = (senses.position - last.position) / max(step, 1e-3)
        duty = np.clip(self._duty_per_radian * (last.goal - senses.position), -1.0, 1.0)
        current = np.nan_to_num(duty - speed / limits.free_speed)
        share = min(1.0, step / limits.current_time)
        self._heat = self._heat + share * (np.clip(current, -1.5, 1.5) ** 2 - self._heat)
        hot = np.flatnonzero(self._heat > limits.current**2)
        if not len(hot):
            return None
        j = hot[np.argmax(self._heat[hot])]
        return (
            f"{senses.names[j]} draws {math.sqrt(self._heat[j]):.2f} of its stall current over "
            f"{limits.current_time:g} s, limit {limits.current:g}"
        )


class Voltage(_Stateless):
    """A supply that is too low or too high."""

    name = "voltage"

    def __init__(self, limits: SafetySettings) -> None:
        self._least, self._largest = limits.voltage

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        supply = senses.supply
        if math.isnan(supply) or self._least <= supply <= self._largest:
            return None
        return f"{supply:.1f} V is outside {self._least:g} to {self._largest:g} V"


class ServoAlarm(_Stateless):
    """A servo that complains itself."""

    name = "servo alarm"

    def __init__(self, limits: SafetySettings) -> None:
        pass

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        return "; ".join(f"{name} tells of {what}" for name, what in senses.alarms.items()) or None


class Fall:
    """A robot on its own feet that falls: tilted too far, or about to be by the gyroscope.

    While people handle it, it may lie as they like.
    """

    name, response = "fall", Response.SOFT

    def __init__(self, limits: SafetySettings, tilt: float) -> None:
        self._tilt, self._lead = limits.fall_tilt or tilt, limits.fall_lead

    def reset(self) -> None:
        """Nothing to forget."""

    def check(self, senses: Senses) -> str | None:
        """See Rule."""
        imu = senses.imu
        if imu is None or not senses.alone:
            return None
        for name, angle, rate in (
            ("roll", imu.roll, imu.gyro[0]),
            ("pitch", imu.pitch, imu.gyro[1]),
        ):
            # A fall is foreseen only in one that has begun: walking swings the torso too.
            begun = abs(angle) > self._tilt / 2 and angle * rate > 0
            if abs(angle) + (self._lead * abs(rate) if begun else 0.0) > self._tilt:
                return f"{name} {angle:.2f} rad at {rate:.1f} rad/s, limit {self._tilt:g} rad"
        return None


RULES = (
    StaleServo,
    StaleImu,
    FrozenImu,
    StaleCommand,
    ServoAlarm,
    Voltage,
    OverTemperature,
    Heating,
    StuckEncoder,
)


class Guard:
    """All rules, asked in turn.

    Args:
      limits: of the configuration.
      tilt: of the robot's gait, rad.
      gain: the servos' P gain as a share of the paper's.
    """

    def __init__(self, limits: SafetySettings, tilt: float, gain: float = 1.0) -> None:
        self._overload = Overload(limits, gain)
        self.rules: list[Rule] = [rule(limits) for rule in RULES]
        self.rules += [self._overload, Fall(limits, tilt)]

    def reset(self) -> None:
        """Torque comes on."""
        for rule in self.rules:
            rule.reset()

    @property
    def heat(self) -> float:
        """Of the motors' windings (I²t), as a share of what is allowed."""
        return self._overload.heat

    def warm(self, share: float) -> None:
        """Take over that heat from an earlier agent."""
        self._overload.warm(share)

    def rest(self, senses: Senses) -> None:
        """A tick without torque."""
        self._overload.rest(senses)

    def check(self, senses: Senses) -> Trip | None:
        """The first rule that is broken; every rule sees every tick."""
        told = [(rule, rule.check(senses)) for rule in self.rules]
        for rule, reason in told:
            if reason is not None:
                return Trip(rule.name, reason, rule.response)
        return None
