"""Agents and virtual robots in processes of their own, and a bundle for them, for tests."""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from hardware_agent.control import say
from pup.policy.bundle import PolicyCard, read_bundle, write_bundle
from pup.policy.shape import Method, PolicyShape
from pup.robot import Gait, Harmonics, RobotDescription

DARWIN = RobotDescription.load("darwin_op2")
OBSERVATION = (
    *(f"position_before/{name}" for name in DARWIN.joint_names),
    *(f"position/{name}" for name in DARWIN.joint_names),
    *("imu/roll", "imu/pitch", "imu_before/roll", "imu_before/pitch"),
)
CENTRE = 5  # the bin of no action

CONFIG = """
schema = 1
name = "tested"
robot = "darwin_op2"
state = "state"
policies = "policies"
socket = "agent.sock"

[bus]
port = "{folder}/bus"
protocol = {protocol}
board = 200
timeout = 0.05

[imu]
kind = "bno055-uart"
port = "{folder}/imu"
timeout = 0.05

[control]
gate = "auto"
clock = "{clock}"
source = "simulation"
ramp = 0.5
settle = 1.0

[safety]
late = 1.0
stale = 0.3

[watchdog]
timeout = 5.0

[distance]
kind = "virtual"
side = "{folder}/side"
"""
"""For a busy machine: patient where a real robot's agent must not be."""


def bundle(
    folder: Path,
    gait: Gait | None = None,
    parameters: Sequence[str] = ("a", "b", "c", "d"),
    lively: bool = False,
    method: Method = Method.PUP,
) -> Path:
    """Write a policy that follows its reference.

    Args:
      folder: for the bundle.
      gait: the reference; None for the robot's own, which steps in place and falls soon.
      parameters: names of mu.
      lively: whether it departs from the reference by what it sees and by eta.
      method: PUP or one without eta.
    """
    gait = gait or DARWIN.gait
    assert gait is not None
    shape = PolicyShape.of(method, len(OBSERVATION), *2 * [len(parameters)], len(DARWIN.joints))
    rng = np.random.default_rng(0)
    weights: dict[str, np.ndarray] = {
        "observations.count": np.array(1.0),
        "observations.mean": np.zeros(len(OBSERVATION)),
        "observations.variance": np.ones(len(OBSERVATION)),
        "returns.count": np.array(1.0),
        "returns.mean": np.zeros(1),
        "returns.variance": np.ones(1),
    }
    networks = {
        "actor": (shape.proprioception + shape.eta, *shape.hidden, shape.bins * shape.joints),
        "projection": (shape.parameters, *shape.projection, shape.latent),
        "critic": (shape.proprioception + shape.privileged, *shape.hidden, 1),
    }
    if not shape.latent:
        del networks["projection"]
    for name, sizes in networks.items():
        for i, (inputs, outputs) in enumerate(pairwise(sizes)):
            spread = 0.2 if lively else 0.01
            weights[f"{name}.{2 * i}.weight"] = spread * rng.standard_normal((outputs, inputs))
            weights[f"{name}.{2 * i}.bias"] = np.zeros(outputs)
    last = weights[f"actor.{2 * len(shape.hidden)}.bias"].reshape(shape.bins, shape.joints)
    last[CENTRE] = 3.0 if lively else 10.0
    card = PolicyCard(
        robot=DARWIN.name,
        joints=DARWIN.joint_names,
        lower=tuple(j.lower for j in DARWIN.joints),
        upper=tuple(j.upper for j in DARWIN.joints),
        method=method,
        direction="forward",
        shape=shape,
        observation=OBSERVATION,
        parameters=tuple(parameters),
        parameter_lower=(0.5,) * len(parameters),
        parameter_upper=(1.5,) * len(parameters),
        eta_lower=(-1.0,) * shape.eta,
        eta_upper=(1.0,) * shape.eta,
        rates=(25.0, 33.0),
        reach=0.3,
        smoothing=5,
        gait=gait,
        bounds_sha256="0" * 64,
        robot_digest=DARWIN.digest,
        provenance={"made": "for tests"},
    )
    write_bundle(folder, card, weights)
    return folder


def standing(**others: Harmonics) -> Gait:
    """A reference that stands in the start pose.

    Args:
      others: what single joints do instead.
    """
    gait = DARWIN.gait
    assert gait is not None and gait.start is not None
    still = zip(DARWIN.joint_names, gait.start, strict=True)
    joints = {name: others.get(name, Harmonics(angle, (), ())) for name, angle in still}
    return replace(gait, joints=joints)


def described(folder: Path, gait: Gait) -> Path:
    """A Darwin OP2 with another reference, for policies that were trained on that one."""
    left = shutil.ignore_patterns("recordings", "policies")
    shutil.copytree(DARWIN.folder, folder, ignore=left, dirs_exist_ok=True)
    document: Any = tomlkit.parse((folder / "robot.toml").read_text())
    document["gait"]["joints"] = {
        name: {"c0": c0, "a": list(a), "b": list(b)} for name, (c0, a, b) in gait.joints.items()
    }
    (folder / "robot.toml").write_text(tomlkit.dumps(document))
    return folder


@dataclass
class Lab:
    """A virtual robot and where the agent's files are.

    Attributes:
      folder: of everything.
      robot: the process of the virtual robot.
      agent: that of the agent.
    """

    folder: Path
    robot: subprocess.Popen[bytes]
    agent: subprocess.Popen[bytes] | None = None

    @property
    def config(self) -> Path:
        return self.folder / "agent.toml"

    def side(self, **command: Any) -> dict[str, Any]:
        """What is done by hand in a laboratory."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as door:
            door.connect(str(self.folder / "side"))
            door.sendall(json.dumps(command).encode() + b"\n")
            with door.makefile("rb") as lines:
                told: dict[str, Any] = json.loads(lines.readline())
        assert told.pop("ok"), told
        return told

    def say(self, do: str, **more: Any) -> dict[str, Any]:
        return say(self.folder / "agent.sock", {"do": do, **more})

    def health(self) -> dict[str, Any]:
        return self.say("health")

    def start(self) -> None:
        """Start the agent and wait until it listens and has the robot."""
        self.start_silent()
        wait(lambda: self.ready(), 30, self.log)

    def start_silent(self) -> None:
        """Start the agent of a robot that does not answer yet."""
        log = (self.folder / "agent.log").open("ab")
        command = [sys.executable, "-m", "hardware_agent.cli", "run", "--config", str(self.config)]
        self.agent = subprocess.Popen(command, stderr=log, stdout=log)

    def ready(self) -> bool:
        assert self.agent is not None and self.agent.poll() is None, self.log()
        try:
            return "supply" in self.health()
        except Exception:
            return False

    def kill(self) -> None:
        """End the agent as `kill -9` does."""
        assert self.agent is not None
        self.agent.kill()
        self.agent.wait()

    def end(self) -> None:
        """End it as systemd does."""
        if self.agent is not None and self.agent.poll() is None:
            self.agent.send_signal(signal.SIGTERM)
            self.agent.wait(timeout=30)

    def log(self) -> str:
        files = [self.folder / name for name in ("robot.log", "agent.log")]
        return "\n".join(file.read_text()[-3000:] for file in files if file.exists())

    def until(self, state: str, seconds: float = 20.0) -> dict[str, Any]:
        """Wait for a state of the robot."""
        wait(lambda: self.health()["state"] == state, seconds, lambda: str(self.health()))
        return self.health()


def wait(
    happened: Callable[[], bool], seconds: float, told: Callable[[], str] = lambda: ""
) -> None:
    """Wait until something has happened; fail after a time."""
    deadline = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < deadline, told()
        time.sleep(0.02)


@contextmanager
def lab(
    folder: Path, speed: float = 1.0, protocol: int = 1, seed: int = 1, more: str = ""
) -> Iterator[Lab]:
    """A virtual robot with a configuration for its agent.

    The agent knows it by the gait of the policies that are there already.

    Args:
      folder: for everything.
      speed: of its time; 0 for lock-step.
      protocol: of its servos.
      seed: of its physics.
      more: lines that replace or add to the configuration, as `[table]` blocks with keys.
    """
    clock = "wall" if speed else "lockstep"
    text = CONFIG.format(folder=folder, protocol=protocol, clock=clock)
    for policy in folder.glob("policies/*"):
        robot_folder = described(folder / "robot", read_bundle(policy)[0].gait)
        text = text.replace('robot = "darwin_op2"', f'robot = "{robot_folder}"')
    (folder / "agent.toml").write_text(changed(text, more))
    command = [sys.executable, "-m", "services.cli", "virtual-robot", "--seed", str(seed)]
    command += ["--link", str(folder / "bus"), "--imu", str(folder / "imu")]
    command += ["--side", str(folder / "side"), "--speed", str(speed)]
    command += ["--protocol", str(protocol), "--period", str(1 / 33)]
    with (folder / "robot.log").open("wb") as log:
        robot = subprocess.Popen(command, stderr=log, stdout=log)
    made = Lab(folder, robot)
    try:
        doors = [folder / name for name in ("side", "bus", "imu")]
        wait(lambda: all(d.exists() for d in doors) or robot.poll() is not None, 60)
        assert robot.poll() is None, (folder / "robot.log").read_text()
        yield made
    finally:
        made.end()
        robot.kill()  # it has nothing to lose, and the folder is the test's
        robot.wait(timeout=20)


def changed(text: str, more: str) -> str:
    """A configuration with some keys replaced or added."""
    for block in filter(None, re.split(r"^\[", more, flags=re.MULTILINE)):
        table, _, lines = block.partition("]")
        head = f"[{table}]\n"
        if head not in text:
            text += f"\n{head}"
        for line in filter(None, (x.strip() for x in lines.splitlines())):
            key = line.split("=")[0].strip()
            before, _, after = text.partition(head)
            body, bracket, rest = after.partition("\n[")
            kept = [x for x in body.splitlines() if x.split("=")[0].strip() != key]
            text = before + head + "\n".join([line, *kept]) + bracket + rest
    return text


def memory(pid: int) -> float:
    """Resident memory of a process, MB."""
    status = Path(f"/proc/{pid}/status").read_text()
    (line,) = [x for x in status.splitlines() if x.startswith("VmRSS")]
    return int(line.split()[1]) / 1024


def children(pid: int) -> list[int]:
    """Processes that a process started."""
    return [int(x) for x in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
