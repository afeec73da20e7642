"""The agent's configuration, `agent.toml`: read strictly, every mistake told in one line.

What is left out has the default of its attribute below, which may get better with a new version;
write down only what your robot needs otherwise.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints

from hardware_agent.mounting import Mounting
from hardware_agent.ranges import VOLTAGE, check
from pup.errors import InputError
from pup.robot_toml import Table, read_text

LIMIT = 2**18  # bytes
ADDRESS = re.compile(r"tcp://[^\s*/]+:0*(\d{1,5})")
AXIS = re.compile(r"[+-]?[xyz]")


@dataclass(frozen=True)
class BusSettings:
    """The servo bus.

    Attributes:
      port: serial device.
      baud: rate, 1/s.
      protocol: of the servos, 1 or 2.
      read: "bulk", or with Protocol 2.0 "sync".
      write: "sync", or with Protocol 2.0 "bulk".
      detail: "all": every tick reads velocity, load, voltage and temperature of all servos;
        "rotating": of one servo after the other, positions of all.
      board: id of a CM-730 or CM-740, which switches the servos' current; 0 for none.
      timeout: largest delay of an answer beside its time on the wire, s.
      tries: how often a tick asks those that did not answer.
      gains: P, I, D of the servos' firmware; None for the paper's 32, 0, 16 (section VI-A), which
        with Protocol 2.0 are 512, 0, 1.
      joints: by name, how the servos of some joints are mounted; others as from the factory.
    """

    port: str
    baud: int = 1_000_000
    protocol: int = 1
    read: str = "bulk"
    write: str = "sync"
    detail: str = "all"
    board: int | None = None
    timeout: float = 0.004
    tries: int = 3
    gains: tuple[int, ...] | None = None
    joints: Mapping[str, Mounting] = field(default_factory=dict)


@dataclass(frozen=True)
class ImuSettings:
    """The IMU, and how it sits in the torso.

    Attributes:
      kind: "bno055-uart", "bno055-i2c", "cm740" (the board's own, on the servo bus) or "none".
      port: serial device, or number of the I2C bus.
      axes: the BNO055's axes that point along the torso's x (forward), y (left) and z (up); the
        default is the authors' mounting. Roll, pitch, rates and accelerations follow from it.
      timeout: largest delay of an answer beside its time on the wire, s.
    """

    kind: str = "none"
    port: str = ""
    axes: tuple[str, ...] = ("y", "-x", "z")
    timeout: float = 0.004


@dataclass(frozen=True)
class ControlSettings:
    """The control loop and how a trial is started.

    Attributes:
      rate: Hz (paper: 33).
      clock: "wall", or "lockstep" for a virtual robot whose time moves with its commands.
      realtime: whether to ask for the real-time scheduler; without the right to, it goes on.
      ramp: time from the measured pose to another, s.
      settle: time that the robot must stand upright before it walks, s (authors: 4).
      patience: time after which a robot that is not upright gives up the trial, s.
      upright: largest error of roll and pitch at the start, rad (authors: 0.1).
      gate: who lets a trial start: "operator" or "auto".
      source: of recordings, "hardware" or "simulation".
    """

    rate: float = 33.0
    clock: str = "wall"
    realtime: bool = True
    ramp: float = 2.0
    settle: float = 2.0
    patience: float = 30.0
    upright: float = 0.3
    gate: str = "operator"
    source: str = "hardware"


@dataclass(frozen=True)
class SafetySettings:
    """Limits; see `hardware_agent.safety` for what is held against them.

    Attributes:
      stale: largest age of a servo's or the IMU's reading in a tick, s.
      late: largest time without a command while torque is on, s.
      speed: largest speed of a target, rad/s.
      voltage: least and largest supply, V (MX-28: 10 to 14.8).
      temperature: of a servo's case, °C (the MX-28 shuts down at 80).
      cool: below which a trial starts, °C.
      heating: °C/s over `heating_time`: the sensor is far from the winding.
      heating_time: s.
      current: largest root mean square of a motor's current, as a share of the stall current: a
        stalled motor is given up after 11 s, a knee that walks at 0.8 after 21 s.
      current_time: over which it is taken, s.
      rested: share of that heat (I²t) below which a trial starts.
      duty_per_radian: of the servo's P gain, to tell the current; None for 6.28 (fitted, MX-28 at
        the paper's P), scaled by that of `[bus] gains`.
      free_speed: without load, rad/s, likewise.
      lag: time constant with which a joint follows its target, s, likewise.
      stuck_time: after which an encoder that does not move is stuck, s.
      stuck_angle: way that the joint should have gone meanwhile, rad.
      frozen: time for which a walking robot's IMU may tell the same, s.
      fall_tilt: largest roll or pitch, rad; None for the gait's.
      fall_lead: time by which a fall is foreseen from the gyroscope, s.
      fallen_power: share of the servos' power that is left to a fallen robot.
    """

    stale: float = 0.02
    late: float = 0.15
    speed: float = 8.0
    voltage: tuple[float, ...] = (9.5, 15.0)
    temperature: float = 70.0
    cool: float = 60.0
    heating: float = 0.5
    heating_time: float = 10.0
    current: float = 0.65
    current_time: float = 20.0
    rested: float = 0.4
    duty_per_radian: float | None = None
    free_speed: float = 3.9
    lag: float = 0.05
    stuck_time: float = 0.18
    stuck_angle: float = 0.15
    frozen: float = 0.5
    fall_tilt: float | None = None
    fall_lead: float = 0.1
    fallen_power: float = 0.2


@dataclass(frozen=True)
class WatchdogSettings:
    """The process that makes the robot safe when the agent cannot.

    Attributes:
      timeout: without a tick while torque is on, after which the agent is killed, s.
    """

    timeout: float = 0.3


@dataclass(frozen=True)
class StopSettings:
    """The emergency stop at the robot.

    Attributes:
      command: runs as long as the robot may move, such as one that waits for a pin; when it ends,
        for whatever reason, the robot is stopped.
    """

    command: tuple[str, ...] = ()


@dataclass(frozen=True)
class DistanceSettings:
    """Who tells how far the robot came.

    Attributes:
      kind: "operator" (asked after a rollout), "hook" (a command) or "virtual" (the virtual robot).
      command: of the hook, called with `start` and with `end`; see `hardware_agent.distance`.
      side: socket of the virtual robot.
      renew: whether each walk of the virtual robot is the same whatever it has done before: fresh
        battery, cold motors, noise by the trial's name.
      timeout: of the hook, s.
    """

    kind: str = "operator"
    command: tuple[str, ...] = ()
    side: str = ""
    renew: bool = False
    timeout: float = 30.0


@dataclass(frozen=True)
class LinkSettings:
    """The gateway.

    Attributes:
      gateway: its address; empty for none.
      key: file with this agent's secret CURVE key.
      gateway_key: file with the gateway's public key.
      heartbeat: s between two.
      liveness: heartbeats of the gateway that may be missed before the connection is made anew.
      upload: whether recordings are sent too.
    """

    gateway: str = ""
    key: str = ""
    gateway_key: str = ""
    heartbeat: float = 1.0
    liveness: float = 3.0
    upload: bool = True


@dataclass(frozen=True)
class Settings:
    """All of `agent.toml`.

    Attributes:
      name: of the agent.
      robot: built-in name or folder of the robot description.
      state: folder for journal and recordings.
      policies: folder of bundles.
      socket: for commands on this computer.
    """

    name: str
    robot: str
    state: Path
    policies: Path
    socket: Path
    bus: BusSettings
    imu: ImuSettings
    control: ControlSettings
    safety: SafetySettings
    watchdog: WatchdogSettings
    stop: StopSettings
    distance: DistanceSettings
    link: LinkSettings

    @classmethod
    def read(cls, file: Path) -> "Settings":
        """Read a configuration.

        Raises:
          InputError: a key is unknown, missing or has a value that cannot be.
        """
        table = Table.read(read_text(file, LIMIT), file)
        if table.integer("schema") != 1:
            raise table.mistake("schema", "not 1; this version reads schema = 1 only")
        parts = {f.name: f.type for f in fields(cls) if f.name in PARTS}
        own: dict[str, Any] = {
            "name": table.name("name"),
            "robot": table.text("robot"),
            "state": _path(table, "state", file),
            "policies": _path(table, "policies", file),
            "socket": _path(table, "socket", file),
        }
        own |= {name: _part(table.table(name), PARTS[name]) for name in parts}
        table.close()
        return cls(**own)


PARTS: dict[str, type[Any]] = {
    "bus": BusSettings,
    "imu": ImuSettings,
    "control": ControlSettings,
    "safety": SafetySettings,
    "watchdog": WatchdogSettings,
    "stop": StopSettings,
    "distance": DistanceSettings,
    "link": LinkSettings,
}


def _path(table: Table, key: str, file: Path) -> Path:
    """A path; one that is relative counts from the configuration."""
    told = table.text(key)
    try:
        return located(told, file)
    except ValueError as error:
        raise table.mistake(key, f"{told!r}: {error}; write the path in full") from error


def located(told: str, file: Path) -> Path:
    """Where a path of a configuration leads.

    Raises:
      ValueError: it cannot lead anywhere.
    """
    if "\0" in told:
        raise ValueError("no path has a zero in it")
    try:
        return (file.parent / Path(told).expanduser()).absolute()
    except RuntimeError as error:  # ~ of somebody who is not there
        raise ValueError("there is no such user here") from error


def _part(table: Table, kind: type[Any]) -> Any:
    for key in ("roll", "pitch", "yaw") if kind is ImuSettings else ():
        if table.has(key):
            raise table.mistake(key, "no longer a setting; imu.axes tells the whole mounting")
    hints, read = get_type_hints(kind), {}
    for f in fields(kind):
        if table.has(f.name) or (f.name == "port" and kind is BusSettings):
            value = _value(table, f.name, hints[f.name])
            check(table, kind.__name__, f.name, value)
            read[f.name] = value
    table.close()
    part = kind(**read)
    for key, problem in _mistakes(part):
        raise table.mistake(key, problem)
    return part


def _value(table: Table, key: str, hint: Any) -> Any:
    if isinstance(hint, UnionType):
        hint = get_args(hint)[0]
    if hint is str:
        return table.text(key)
    if hint is bool:
        return table.flag(key)
    if hint is int:
        return table.integer(key)
    if hint is float:
        return table.number(key)
    if get_origin(hint) is Mapping:
        named = table.table(key)
        return {name: _part(named.table(name), Mounting) for name in named.left()}
    assert get_origin(hint) is tuple
    if get_args(hint)[0] is str:
        return table.texts(key)
    values = table.numbers(key)
    if get_args(hint)[0] is not int:
        return values
    if not all(value.is_integer() for value in values):
        raise table.mistake(key, "expected whole numbers")
    return tuple(map(int, values))


def _mistakes(part: Any) -> Any:
    """What does not go together."""
    if isinstance(part, BusSettings):
        if part.protocol == 1 and (part.read, part.write) != ("bulk", "sync"):
            yield "protocol", 'Protocol 1.0 has read = "bulk" and write = "sync" only'
        if part.read == "sync" and part.detail != "all":
            yield "detail", 'a sync read asks all servos for the same; use detail = "all"'
        if part.gains is not None:
            most = 254 if part.protocol == 1 else 16383
            if len(part.gains) != 3 or not all(0 <= gain <= most for gain in part.gains):
                yield (
                    "gains",
                    f"write P, I and D of the firmware, such as [32, 0, 16], up to {most}",
                )
    if isinstance(part, ImuSettings):
        if part.kind.startswith("bno055") and not part.port:
            yield "port", f"missing; where is the {part.kind}?"
        if len(part.axes) != 3 or not all(AXIS.fullmatch(axis) for axis in part.axes):
            yield "axes", 'write three of x, y, z, perhaps with a -, such as ["y", "-x", "z"]'
        elif len({axis[-1] for axis in part.axes}) < 3:
            yield "axes", "names an axis twice"
        # An even order of the axes goes with an even number of minuses.
        elif ("".join(a[-1] for a in part.axes) in "xyzxy") == "".join(part.axes).count("-") % 2:
            yield "axes", "is a mirror image, which no mounting gives; check the signs"
    if isinstance(part, ControlSettings) and (part.clock, part.source) == ("lockstep", "hardware"):
        yield (
            "clock",
            'a real robot\'s time does not stand still; "lockstep" needs source = "simulation"',
        )
    if isinstance(part, SafetySettings) and (
        len(part.voltage) != 2 or not VOLTAGE[0] <= part.voltage[0] < part.voltage[1] <= VOLTAGE[1]
    ):
        yield "voltage", f"write [least, largest], from {VOLTAGE[0]:g} to {VOLTAGE[1]:g} V"
    if isinstance(part, DistanceSettings):
        if part.kind == "hook" and not part.command:
            yield "command", "missing; which command measures the distance?"
        if part.kind == "virtual" and not part.side:
            yield "side", "missing; write the --side of `pup virtual-robot`"
    if isinstance(part, LinkSettings) and part.gateway:
        told = ADDRESS.fullmatch(part.gateway)
        if told is None or not 1 <= int(told[1]) <= 65535:
            yield "gateway", f"{part.gateway!r}; write tcp://HOST:PORT"
        for key in ("key", "gateway_key"):
            if not getattr(part, key):
                yield key, "missing; the link is always encrypted, see docs/agent.md"


def check_together(settings: Settings, file: Path) -> None:
    """Refuse parts that need each other.

    Raises:
      InputError: see the message.
    """
    if settings.imu.kind.startswith("bno055") and settings.imu.port == settings.bus.port:
        raise InputError(f"{file}: imu.port: is that of the servo bus; the IMU has one of its own")
    if settings.imu.kind == "cm740" and not settings.bus.board:
        raise InputError(f'{file}: imu.kind: "cm740" is the board\'s; write its id as bus.board')
    rate, late, timeout = settings.control.rate, settings.safety.late, settings.watchdog.timeout
    for key, limit in (("safety.late", late), ("watchdog.timeout", timeout)):
        if limit * rate <= 1:
            raise InputError(
                f"{file}: {key}: at {rate:g} Hz (control.rate) a command comes every "
                f"{1 / rate:.3f} s only; {limit:g} s stops every robot that is enabled"
            )
