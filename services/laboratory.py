"""A laboratory on this computer: a gateway, a virtual robot and its agent, each a process.

They talk as they would anywhere: REST, ZeroMQ with CURVE, Dynamixel packets on a pseudo-terminal;
all of it on loopback or in the file system. The robot lives in lock-step, as fast as the computer
can. Everything ends with the laboratory, and with its owner where that is killed.
"""

import json
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import httpx

from hardware_agent.control import say
from pup.errors import InputError
from pup.files import write_atomic
from pup.robot import RobotDescription
from services.gateway.keys import KeyRing, Role, Tokens
from workers import reaper

AGENT, OPERATOR = "virtual", "run"
PATIENCE = 120.0
"""For a process to be ready, s; the machine may be busy."""
GRACE = 15.0
"""For a process to end by itself, s."""

CONFIG = """schema = 1
name = {agent}
robot = {robot}
state = {state}
policies = {policies}
socket = {passing}/agent.sock"

[bus]
port = {passing}/bus"
board = 200
timeout = 1.0

[imu]
kind = "bno055-uart"
port = {passing}/imu"
timeout = 1.0

[control]
rate = {rate}
clock = "lockstep"
realtime = false
gate = "auto"
source = "simulation"
settle = 2.01

[safety]
late = 1.0
stale = 0.3

[watchdog]
timeout = 10.0

[distance]
kind = "virtual"
renew = true
side = {passing}/side"

[link]
gateway = {link}
key = {key}
gateway_key = {gateway_key}
upload = false
"""
"""Of the agent: patient, since nothing can fall while it waits and time stands still."""


def period_of(robot: RobotDescription) -> float:
    """Of the control loop, s: the shortest that the robot's rates allow, in whole milliseconds.

    The virtual robot's time passes in these.
    """
    return math.ceil(1000 / robot.walk.control_rate[1]) / 1000


class Laboratory(AbstractContextManager["Laboratory"]):
    """The processes, and what is done by hand in a laboratory.

    Args:
      folder: for what outlives it: the gateway's store, the agent's journal and recordings, logs.
        While it is open, keys and a token are in it too.
      robot: which the virtual one is built after.
      policy: bundle that the agent has.
      seed: of the virtual robot's physics.

    Attributes:
      url: of the gateway.
      token: of an operator.
    """

    restarts = 3
    """Of each process, before the laboratory is given up."""
    standstill = 240.0
    """Without any change of a study, after which its processes are started anew, s."""

    def __init__(self, folder: Path, robot: RobotDescription, policy: Path, seed: int) -> None:
        self.folder, self.robot, self.seed = folder.absolute(), robot, seed
        self.policy = policy.absolute()
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._starts: dict[str, int] = {}

    def __enter__(self) -> "Laboratory":
        self._passing = Path(mkdtemp(prefix="pup-lab-"))  # short: sockets have short names
        self._watch = reaper.watch(str(self._passing))
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End all, the agent first, which leaves the robot limp; keys and the token go too."""
        try:
            self.interrupt()
        finally:
            reaper.close(self._watch, str(self._passing))  # what is left now is killed
            shutil.rmtree(self.keys, ignore_errors=True)

    @property
    def keys(self) -> Path:
        """Folder of keys and token, its owner's alone."""
        return self.folder / "keys"

    def tend(self) -> None:
        """Start again what has ended, and the robot where a rule of safety has stopped it.

        Raises:
          ChildProcessError: a process ends again and again.
        """
        for name, process in list(self._processes.items()):
            if process.poll() is not None:
                self._start(name)
        with suppress(InputError):  # an agent or a robot that does not listen yet
            self._attend()

    def interrupt(self) -> None:
        """End all processes, whatever holds them up; who tends starts them again."""
        for name in ("agent", "robot", "gateway"):
            self._end(name)

    def _attend(self) -> None:
        state = self._agent("health")["state"]
        if state == "fault":
            self._mend()
        if state in ("disabled", "stopped", "fault"):
            try:
                self._agent("enable")
            except InputError:  # an agent that was started anew has seen no fault
                self._mend()

    def _mend(self) -> None:
        """By hand: it may lie on an arm, and a servo that has shut down stays so."""
        for do in ("supply", "reset"):
            say(self._passing / "side", {"cmd": do})

    def _open(self) -> None:
        shutil.rmtree(self.keys, ignore_errors=True)
        self.keys.mkdir(parents=True, mode=0o700)
        tokens = self.keys / "tokens.json"
        self.token = Tokens(tokens).create(OPERATOR, Role.OPERATOR)
        files = KeyRing(self.keys / "curve").create_agent(AGENT, self.keys / "agent")
        port, link = _free_ports(2)
        self.url, gateway = f"http://127.0.0.1:{port}", f"tcp://127.0.0.1:{link}"
        config = self.keys / "agent.toml"
        write_atomic(config, self._config(gateway, files))
        pup = [sys.executable, "-m", "services.cli"]
        told = {"DATA": self.folder / "gateway", "HOST": "127.0.0.1", "PORT": port, "LINK": gateway}
        told |= {"TOKENS": tokens, "CURVE": self.keys / "curve", "LOG": "warning"}
        doors = {name: self._passing / name for name in ("bus", "imu", "side")}
        self._commands = {
            "gateway": ([*pup, "serve"], told),
            "robot": ([*pup, "virtual-robot", *self._robot(doors)], {}),
            "agent": (
                [sys.executable, "-m", "hardware_agent.cli", "run", "--config", str(config)],
                {},
            ),
        }
        self._start("gateway")
        self._start("robot")
        self._wait_for("robot", lambda: all(door.exists() for door in doors.values()))
        self._start("agent")
        self._wait_for("agent", self._has_robot)
        self._wait_for("gateway", self._answers)
        self._agent("enable")

    def _config(self, gateway: str, keys: tuple[Path, Path]) -> str:
        state = self.folder / "agent"
        told = {"agent": AGENT, "robot": self.robot.folder.absolute(), "state": state}
        told |= {"policies": self.policy, "link": gateway, "key": keys[0], "gateway_key": keys[1]}
        quoted = {name: json.dumps(str(value), ensure_ascii=False) for name, value in told.items()}
        return CONFIG.format(**quoted, passing=f'"{self._passing}', rate=1 / period_of(self.robot))

    def _robot(self, doors: Mapping[str, Path]) -> list[str]:
        told = ["--robot", str(self.robot.folder.absolute()), "--seed", str(self.seed)]
        told += ["--link", str(doors["bus"]), "--imu", str(doors["imu"])]
        told += ["--side", str(doors["side"]), "--period", str(period_of(self.robot))]
        return [*told, "--speed", "0"]

    def _start(self, name: str) -> None:
        self._starts[name] = self._starts.get(name, 0) + 1
        if self._starts[name] > 1 + self.restarts:
            raise ChildProcessError(f"the {name} ends again and again: {self._last_words(name)}")
        command, told = self._commands[name]
        # Settings of a gateway or an agent that the user has besides are not for these.
        environment = {k: v for k, v in os.environ.items() if not k.startswith("PUP_")}
        environment |= {f"PUP_{key}": str(value) for key, value in told.items()}
        environment[reaper.SESSION] = str(self._passing)
        with self._log(name).open("ab") as log:
            self._processes[name] = subprocess.Popen(
                command,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,  # Ctrl-C in the terminal is not for it
            )

    def _wait_for(self, name: str, ready: Callable[[], bool]) -> None:
        deadline = time.monotonic() + PATIENCE
        while not ready():
            if self._processes[name].poll() is not None or time.monotonic() > deadline:
                raise ChildProcessError(f"the {name} did not start: {self._last_words(name)}")
            time.sleep(0.05)

    def _has_robot(self) -> bool:
        try:
            return "supply" in self._agent("health")
        except (InputError, AttributeError):
            return False

    def _answers(self) -> bool:
        try:
            return httpx.get(f"{self.url}/readyz", timeout=5.0).status_code == httpx.codes.OK
        except httpx.HTTPError:
            return False

    def _agent(self, do: str) -> dict[str, Any]:
        return say(self._passing / "agent.sock", {"do": do})

    def _end(self, name: str) -> None:
        process = self._processes.get(name)
        if process is None or process.poll() is not None:
            return
        process.send_signal(signal.SIGTERM)
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
            return
        process.kill()
        process.wait()

    def _log(self, name: str) -> Path:
        return self.folder / f"{name}.log"

    def _last_words(self, name: str) -> str:
        lines = self._log(name).read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f"{lines[-1][:300] if lines else 'it said nothing'} ({self._log(name)})"


def _free_ports(count: int) -> list[int]:
    """Ports on loopback that nobody listens at."""
    probes = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [probe.getsockname()[1] for probe in probes]
    for probe in probes:
        probe.close()
    return ports
