"""Scripted motions of a concealed robot, played and read through its servo bus.

The robot is a process of its own. On its pseudo-terminals works the part of the agent that owns a
robot (`hardware_agent.body`): ROBOTIS' SDK, the BNO055's protocol, limits and rules of safety, tick
by tick as in a trial. Only the agent's daemon is left out: whoever plays steers time here, and the
hand that puts the robot down.
"""

import math
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware_agent.activities import REST, fallen
from hardware_agent.body import Body
from hardware_agent.config import (
    BusSettings,
    ControlSettings,
    DistanceSettings,
    ImuSettings,
    LinkSettings,
    SafetySettings,
    Settings,
    StopSettings,
    WatchdogSettings,
)
from hardware_agent.control import say
from hardware_agent.rollout import Row, columns_of
from hardware_agent.senses import Senses, Trip
from pup.errors import InputError
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.clearance import Clearance
from pup.sysid.excitation import Motion
from workers import reaper

Array = NDArray[np.float64]

BOARD = 200
PERIOD = 0.03
"""Between two ticks on the way to a script's first pose, s."""
WAY = 2.0
"""From one pose to the next on that way, s."""
STEADY = 0.3
"""In the pose that it was put down in, until it is let go, s."""
PATIENCE = 120.0
"""For the robot's ports to be there, s; the machine may be busy."""


@dataclass(frozen=True)
class Doors:
    """Where a virtual robot is found: its bus, its IMU's port and its side door."""

    link: Path
    imu: Path
    side: Path


@contextmanager
def virtual_robot(robot: RobotDescription, seed: int, log: Path) -> Iterator[Doors]:
    """A robot in a process of its own, in lock-step, which ends with whoever asked for it.

    Args:
      robot: which it is built after.
      seed: of its physics.
      log: file for what it says.

    Raises:
      ChildProcessError: it does not start.
    """
    folder = Path(mkdtemp(prefix="pup-rec-"))  # short: sockets have short names
    watch = reaper.start(str(folder))
    try:
        doors = Doors(folder / "link", folder / "imu", folder / "side")
        told = ["--robot", str(robot.folder.absolute()), "--seed", str(seed), "--speed", "0"]
        told += [t for name in ("link", "imu", "side") for t in (f"--{name}", str(folder / name))]
        with log.open("ab") as file:
            process = subprocess.Popen(
                [sys.executable, "-m", "services.cli", "virtual-robot", *told],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
            )
        try:
            _wait_for(process, doors, log)
            yield doors
        finally:
            process.terminate()
            process.wait()
    finally:
        reaper.close(watch, str(folder))  # what is left now is killed
        shutil.rmtree(folder, ignore_errors=True)


def _wait_for(process: "subprocess.Popen[bytes]", doors: Doors, log: Path) -> None:
    deadline = time.monotonic() + PATIENCE
    while not all(door.exists() for door in (doors.link, doors.imu, doors.side)):
        if process.poll() is not None or time.monotonic() > deadline:
            raise ChildProcessError(f"the virtual robot did not start, see {log}")
        time.sleep(0.05)


class Player:
    """Plays scripts on a robot and records them.

    Args:
      robot: the robot.
      doors: where it is found.
      seed: of its physics; it is told in the notes of recordings.

    Raises:
      BusError: it does not answer.
    """

    def __init__(self, robot: RobotDescription, doors: Doors, seed: int) -> None:
        self.robot, self.doors, self.seed = robot, doors, seed
        self.body = Body(_settings(robot, doors), robot)
        self.body.open()
        self._clearance = Clearance(robot)
        self._time, self._gap = 0.0, math.nan

    def close(self) -> None:
        """Leave the robot limp."""
        self.body.close()

    def play(self, motion: Motion, name: str, draw: int, repeat_of: str | None) -> Recording:
        """Play one script from its start to its end, or to the fall.

        The robot is put back before it, with a fresh battery, cold motors and noise of its own, and
        comes to rest in the script's first pose.

        Args:
          motion: the script; its ticks are taken to whole milliseconds, as the robot's time is.
          name: id of the recording.
          draw: decides on the noise.
          repeat_of: id of the first recording of this script, where this is another.

        Raises:
          InputError: a rule of safety stopped the robot, or it would touch itself on its way to the
            first pose.
          BusError: it does not answer.
        """
        self.body.limp()
        hold = "rope" if motion.support == "suspended" else "hand"
        self._say(cmd="reset", hold=hold, draw=draw)
        self.body.guard.warm(0.0)  # whatever was played before
        self._enable(name)
        pose = self.body.goal
        self._stay(pose, STEADY, name)
        if hold == "hand":  # which would else hold on to one that moves
            self._say(cmd="release")
        way = self._clearance.way(pose, motion.target[0])
        if way is None:  # all robots play the same scripts: this one is not drawn anew
            self.body.limp()
            raise InputError(f"recording {name}: no way to its first pose without touching itself")
        for goal in way:
            for share in np.arange(PERIOD, WAY + 1e-9, PERIOD) / WAY:
                self._tick(pose + share * (goal - pose), PERIOD, name)
            pose = goal
        self._stay(pose, REST, name)
        rows = np.array([row.values for row in self._rows(motion, name)])
        return Recording(
            id=name,
            robot=self.robot.name,
            motion=motion.motion,
            support=motion.support,
            source="simulation",
            **columns_of(rows, self.robot.joint_names),
            repeat_of=repeat_of,
            notes=f"Virtual robot of seed {self.seed}, through its bus; noise of {draw}.",
        )

    def _stay(self, pose: Array, seconds: float, name: str) -> None:
        for _ in range(round(seconds / PERIOD)):
            self._tick(pose, PERIOD, name)

    def _rows(self, motion: Motion, name: str) -> list[Row]:
        ticks = np.round(motion.time, 3)
        gaps = np.append(np.diff(ticks), PERIOD)
        begin, rows = self._time, list[Row]()
        for target, gap in zip(motion.target, gaps, strict=True):
            row = self._tick(target, float(gap), name)
            rows.append(Row(round(row.time - begin, 6), row.senses, row.applied))
            if motion.motion == "fall" and fallen(row.senses):
                break
        return rows

    def _enable(self, name: str) -> None:
        self.body.guard.reset()
        refused = self.body.enable(self._sense())
        if refused is not None:
            raise InputError(f"recording {name}: {refused}")

    def _tick(self, target: Array, gap: float, name: str) -> Row:
        """Read, ask the rules, send; then the gap passes."""
        senses = self._sense()
        if gap != self._gap:
            self._say(cmd="period", time=gap)
            self._gap = gap
        trip = self.body.guard.check(senses)
        within = self.body.limiter.within(target)  # also where it hangs beyond its ranges
        applied = self.body.command(within, self._time) if trip is None else trip
        if isinstance(applied, Trip):
            self.body.limp()
            raise InputError(f"recording {name}: stopped by {applied}")
        self._time = round(self._time + gap, 6)
        return Row(senses.time, senses, applied)

    def _sense(self) -> Senses:
        return self.body.sense(self._time, walking=False, alone=False)

    def _say(self, **command: Any) -> None:
        say(self.doors.side, command)


def _settings(robot: RobotDescription, doors: Doors) -> Settings:
    """The agent's own, patient as nothing can fall while time stands still.

    Targets may jump: a step is one.
    """
    nowhere = doors.side.parent
    return Settings(
        name="recorder",
        robot=str(robot.folder),
        state=nowhere,
        policies=nowhere,
        socket=nowhere / "agent.sock",
        bus=BusSettings(str(doors.link), board=BOARD, timeout=1.0),
        imu=ImuSettings("bno055-uart", str(doors.imu), timeout=1.0),
        control=ControlSettings(1 / PERIOD, "lockstep", realtime=False, source="simulation"),
        safety=SafetySettings(stale=0.3, late=1.0, speed=math.inf),
        watchdog=WatchdogSettings(),
        stop=StopSettings(),
        distance=DistanceSettings(),
        link=LinkSettings(),
    )
