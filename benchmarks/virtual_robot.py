"""How fast a virtual robot lives, how regular its bus is, and how like the real one it moves.

    python -m benchmarks.virtual_robot [--recordings DIR]

DIR holds recordings of suspended step tests; they are replayed on robots of several seeds.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import serial

from hardware_agent.virtual.drives import CENTRE, TICK
from hardware_agent.virtual.fleet import Fleet
from hardware_agent.virtual.packets import checksum
from hardware_agent.virtual.plant import Hold
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription

ROBOT = RobotDescription.load("darwin_op2")
IDS = [joint.servo_id for joint in ROBOT.joints if joint.servo_id is not None]
PERIOD = 0.03  # s
SEEDS = range(1, 9)


def packet(id: int, instruction: int, *parameters: int) -> bytes:
    """An instruction of Protocol 1.0."""
    inner = bytes([id, len(parameters) + 2, instruction, *parameters])
    return b"\xff\xff" + inner + bytes([checksum(inner)])


assert ROBOT.gait is not None and ROBOT.gait.start is not None
START = np.array(ROBOT.gait.start)
GOALS = [round(CENTRE + angle / TICK) for angle in START]
WRITE = packet(
    0xFE, 0x83, 30, 2, *(b for i, g in zip(IDS, GOALS, strict=True) for b in (i, g & 255, g >> 8))
)
READ = packet(0xFE, 0x92, 0, *(b for i in IDS for b in (2, i, 36)))
ANSWER = 8 * len(IDS)
EULER = bytes((0xAA, 0x01, 0x1A, 6))


@dataclass
class Running:
    """A robot in a process of its own, standing."""

    process: "subprocess.Popen[bytes]"
    bus: serial.Serial
    imu: serial.Serial

    def period(self) -> None:
        """What an agent does in a control period."""
        self.bus.write(WRITE)
        self.bus.write(READ)
        assert len(self.bus.read(ANSWER)) == ANSWER
        self.imu.write(EULER)
        assert len(self.imu.read(8)) == 8

    def read(self) -> None:
        """A bulk read of all positions."""
        self.bus.write(READ)
        assert len(self.bus.read(ANSWER)) == ANSWER

    @property
    def cpu(self) -> float:
        """Seconds of a core that the robot has used."""
        told = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(told[11]) + int(told[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def running(speed: float) -> Iterator[Running]:
    """Start a robot and let it stand."""
    with tempfile.TemporaryDirectory() as folder:
        ports = [part for n in ("link", "imu", "side") for part in (f"--{n}", f"{folder}/{n}")]
        process = subprocess.Popen(
            [sys.executable, "-m", "services.cli", "virtual-robot", "--speed", str(speed), *ports],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        assert process.stderr is not None
        try:
            process.stderr.readline()
            bus = serial.Serial(f"{folder}/link", 1_000_000, timeout=2)
            imu = serial.Serial(f"{folder}/imu", 115_200, timeout=2)
            bus.write(packet(200, 3, 24, 1))
            bus.read(6)
            for id in IDS:
                for register, value in ((5, 0), (26, 16), (24, 1)):
                    bus.write(packet(id, 3, register, value))
                    bus.read(6)
            imu.write(bytes((0xAA, 0x00, 0x3D, 1, 0x0C)))
            imu.read(2)
            yield Running(process, bus, imu)
        finally:
            process.terminate()
            process.wait()


def best(run: Callable[[], object], rounds: int) -> float:
    """The shortest of some runs, s: what they cost when nothing disturbs."""
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def beside(robots: int) -> None:
    """Robots beside each other."""
    fleet = Fleet(ROBOT, range(robots))
    fleet.reset()
    targets = np.tile(START, (robots, 1))

    def period() -> None:
        fleet.observe()
        fleet.command(targets, PERIOD)

    taken = best(period, 30)
    step = best(fleet.plant.step, 300)
    print(
        f"{robots:3d} in a fleet: {1e6 * step / robots:5.1f} us per robot and step, "
        f"{robots * PERIOD / taken:5.1f} x real time"
    )


def lock_step() -> None:
    """One robot behind its ports, as fast as it can."""
    with running(0) as robot:
        rates, before, count = [], robot.cpu, 0
        for _ in range(10):
            start = time.perf_counter()
            for _ in range(50):
                robot.period()
            rates.append(50 * PERIOD / (time.perf_counter() - start))
            count += 50
        used = (robot.cpu - before) / count
        print(
            f"lock-step through its ports: best {max(rates):.1f}, median "
            f"{statistics.median(rates):.1f} x real time; {1000 * used:.2f} ms of a core per "
            f"period of 30 ms = {PERIOD / used:.1f} x"
        )


def real_time() -> None:
    """One robot at 1 Mbps."""
    with running(1) as robot:
        before, start = robot.cpu, time.perf_counter()
        reads = []
        while time.perf_counter() - start < 10:
            asked = time.perf_counter()
            robot.read()
            reads.append(1000 * (time.perf_counter() - asked))
            time.sleep(PERIOD)
        share = (robot.cpu - before) / (time.perf_counter() - start)
        p = np.percentile(reads, [0, 50, 99])
        print(
            f"real time: bulk read of {len(IDS)} positions {p[0]:.2f} ms at least, "
            f"{p[1]:.2f} ms median, {p[2]:.2f} ms p99; {100 * share:.0f} % of a core"
        )


def replayed(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Errors of robots that play a suspended test: rms per seed, and fastest means, rad/s."""
    fleet = Fleet(ROBOT, SEEDS)
    plant, orders = fleet.plant, fleet.plant.drives.orders
    target, measured = np.asarray(recording.target), np.asarray(recording.position)
    plant.place(range(len(fleet)), Hold.ROPE)
    plant.qpos[:, plant.at] = measured[0]
    orders.goal[:] = CENTRE + target[0] / TICK
    plant.drives.rest(np.arange(len(fleet)), plant.angles)
    plant.step(300)
    start, seen = plant.time, []
    for moment, goals in zip(recording.time - recording.time[0], target, strict=True):
        plant.step(max(0, round((moment - (plant.time - start)) * 1000)))
        seen.append((plant.encoders() - CENTRE) * TICK)
        orders.goal[:] = CENTRE + goals / TICK
    told = np.array(seen)
    speeds = np.abs(np.diff(told, axis=0)) / np.diff(recording.time)[:, None, None]
    error = told - measured[:, None]
    return np.sqrt((error**2).mean(axis=(0, 2))), np.quantile(speeds, 0.99, axis=(0, 2))


def like_the_real_one(folder: Path) -> None:
    """Suspended step tests, by the size of the step."""
    recordings = [r for r in load_recordings([folder], ROBOT) if r.motion == "step"]
    for size in ("0.1", "0.3", "0.6"):
        chosen = [r for r in recordings if f"_{size}_" in r.id]
        if not chosen:
            continue
        errors, speeds = (
            np.mean(part, axis=0) for part in zip(*map(replayed, chosen), strict=True)
        )
        real = np.mean(
            [
                np.quantile(np.abs(np.diff(r.position, axis=0)) / np.diff(r.time)[:, None], 0.99)
                for r in chosen
            ]
        )
        print(
            f"steps of {size} rad: rms {errors.min():.4f} to {errors.max():.4f} rad over "
            f"{len(SEEDS)} seeds; p99 of speeds {speeds.min():.2f} to {speeds.max():.2f}, "
            f"measured {real:.2f} rad/s"
        )


def main() -> None:
    """Print all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recordings", type=Path)
    folder = parser.parse_args().recordings
    for robots in (1, 8, 32):
        beside(robots)
    lock_step()
    real_time()
    if folder:
        like_the_real_one(folder)


if __name__ == "__main__":
    main()
