"""A robot that is not there: scripts replayed under concealed parameters and noisy sensors.

It obeys the model that identification fits, on the same sub-steps: what is left under its true
parameters is the sensors' noise. A real robot, or a case of a blind test, has physics of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import read_json, write_json
from pup.physics.model import joint_units
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import NETWORK_NAMES, ParameterSpace, robot_space
from pup.physics.simulator import Trajectories
from pup.physics.terms import split_column
from pup.recording import Recording, write_recordings
from pup.recording_file import read_header
from pup.robot import RobotDescription
from pup.script import FALLEN
from pup.sysid.excitation import Motion, script
from pup.sysid.result import read_fitted

Array = NDArray[np.float64]

SETTLING = 2.0  # s in the first pose before the recording begins, to sag and to come to rest

GAIN_SPREAD = (0.7, 1.4)  # times nominal, of everything that scales a servo
GAINS = ("rho", "sigma", "kp", "kd", "tau_max")
LIMIT_SPREAD = (0.52, 1.22)  # times nominal, of the torque limit: 6 to 14 N m in the OP2
FRICTION_RANGE = (0.5, 1.2)
COM_SPREAD = 0.02  # m
SHARE = 0.15  # of the search range to both sides of the nominal value, of everything else


TRUTH = frozenset(("schema", "robot", "actuator", "seed", "parameters"))
"""Keys of a file that reveals a virtual robot's parameters."""


@dataclass(frozen=True)
class SensorNoise:
    """What a virtual robot's sensors and clock add.

    In slide joints a radian is the share of their range that it has of half a turn.

    Attributes:
      position: standard deviation of a joint reading before rounding, rad.
      quantum: step to which it is rounded, rad; 0 for none. The default is a 12-bit encoder's.
      imu: standard deviation of roll and pitch, rad.
      tick: by how much ticks are late, as the standard deviation of a normal variable whose size is
        taken, s. Recordings tell the true time.
    """

    position: float = 0.001
    quantum: float = 2 * np.pi / 4096
    imu: float = 0.002
    tick: float = 0.001


def nominal_space(robot: RobotDescription, actuator: str) -> ParameterSpace:
    """A robot's parameters around its identified values where it has some of that actuator."""
    if robot.identified_path.is_file():
        kind, space = read_fitted(robot.identified_path, robot)
        if kind == actuator:
            return space
    return robot_space(robot, actuator)


def concealed_parameters(
    robot: RobotDescription,
    actuator: str,
    rng: np.random.Generator,
    centre: Mapping[str, float] | None = None,
) -> dict[str, float]:
    """Draw what a virtual robot is like, uniformly within reason and inside the search ranges.

    Network weights stay as they are: they shape one servo type, which all draws share. So do the
    terms of the robot's description.

    Args:
      robot: the robot.
      actuator: its torque law, `nn_pd` or `pd`.
      rng: source of the draw.
      centre: values to draw around instead of the robot's own, for some of the parameters.

    Returns:
      Every parameter of the actuator by name.
    """
    space = nominal_space(robot, actuator).at(centre or {})
    ranges = [
        _reasonable(
            name, *(float(values[i]) for values in (space.nominal, space.lower, space.upper))
        )
        for i, name in enumerate(space.names)
    ]
    low, high = np.clip(np.transpose(ranges), space.lower, space.upper)
    values = rng.uniform(low, high)
    return {name: float(value) for name, value in zip(space.names, values, strict=True)}


def _reasonable(name: str, nominal: float, lower: float, upper: float) -> tuple[float, float]:
    """Range to draw a parameter from, not yet cut to its search range."""
    kind = name.partition("/")[0]
    if name in NETWORK_NAMES or split_column(name) is not None:
        return nominal, nominal
    if kind in GAINS:
        return GAIN_SPREAD[0] * nominal, GAIN_SPREAD[1] * nominal
    if kind == "torque_limit":
        return LIMIT_SPREAD[0] * nominal, LIMIT_SPREAD[1] * nominal
    if kind == "ground_friction":
        return FRICTION_RANGE
    reach = COM_SPREAD if kind == "torso_com" else SHARE * (upper - lower)
    return nominal - reach, nominal + reach


def record_virtual(
    robot: RobotDescription,
    motions: Sequence[Motion],
    actuator: str,
    parameters: Mapping[str, float],
    rng: np.random.Generator,
    noise: SensorNoise = SensorNoise(),
    repeats: int = 1,
    setup: Mapping[str, float] | None = None,
) -> tuple[Recording, ...]:
    """Record scripts on a virtual robot.

    The robot comes to rest in the first target before the recording begins. On the ground it also
    reports roll and pitch, where it has an IMU. A fall is recorded up to the tick on which the
    torso has tilted by FALLEN.

    Args:
      robot: the robot.
      motions: what it plays.
      actuator: its torque law, `nn_pd` or `pd`.
      parameters: what it is like, by parameter name; names left out keep their nominal values.
      rng: source of the noise.
      noise: its sensors and clock.
      repeats: how often each motion is recorded; `repeat_of` names the first time.
      setup: what is changed on the robot, by its knobs.

    Raises:
      InputError: a parameter the actuator does not have, or values under which the simulation
        breaks down.
    """
    space = nominal_space(robot, actuator)
    unknown = sorted(set(parameters) - set(space.names))
    if unknown:
        raise InputError(f"parameter {unknown[0]!r}: the {actuator} actuator has none of that name")
    plans = [
        replace(_plan(robot, motion, turn, noise, rng), setup=dict(setup or {}))
        for motion in motions
        for turn in range(repeats)
    ]
    simulator = MujocoSimulator(robot, plans, actuator, lead=SETTLING)
    seen = simulator.replay(space.at(parameters).candidates())
    for plan, diverged in zip(plans, seen.diverged[0], strict=True):
        if diverged:
            raise InputError(
                f"recording {plan.id!r}: the simulation breaks down; are the parameters possible?"
            )
    scale = joint_units(robot)
    return tuple(
        _measured(robot, plan, seen, ticks, noise, scale, rng)
        for plan, ticks in zip(plans, seen.ticks, strict=True)
    )


def _plan(
    robot: RobotDescription, motion: Motion, turn: int, noise: SensorNoise, rng: np.random.Generator
) -> Recording:
    """A script as a recording to replay, its first row the time to settle before it.

    Ticks are late by chance, but each by less than half of the time left to the next.
    """
    late = np.abs(rng.normal(0.0, noise.tick, size=len(motion.time)))
    late[:-1] = np.minimum(late[:-1], np.diff(motion.time) / 2)
    time = motion.time + late
    target = np.concatenate([motion.target[:1], motion.target])
    return Recording(
        id=motion.id if turn == 0 else f"{motion.id}_again_{turn}",
        robot=robot.name,
        motion=motion.motion,
        support=motion.support,
        source="simulation",
        joints=robot.joint_names,
        time=np.concatenate([[time[0] - SETTLING], time]),
        target=target,
        position=target,
        repeat_of=motion.id if turn else None,
        notes="Simulated: a virtual robot with concealed parameters.",
    )


def _measured(
    robot: RobotDescription,
    plan: Recording,
    seen: Trajectories,
    ticks: slice,
    noise: SensorNoise,
    scale: Array,
    rng: np.random.Generator,
) -> Recording:
    """What the sensors make of a simulation."""
    rows = slice(ticks.start + 1, ticks.stop)
    position, tilt = seen.position[0, rows], seen.tilt[0, rows]
    position = position + noise.position * scale * rng.normal(size=position.shape)
    if noise.quantum:
        position = np.round(position / (noise.quantum * scale)) * (noise.quantum * scale)
    felt = tilt + noise.imu * rng.normal(size=tilt.shape)
    has_imu = plan.support == "ground" and robot.imu_site is not None
    end = len(position)
    if plan.motion == "fall" and (tilted := np.abs(tilt).max(axis=1) > FALLEN).any():
        end = 1 + int(np.argmax(tilted))
    extras = {"imu/roll": felt[:end, 0], "imu/pitch": felt[:end, 1]} if has_imu else {}
    return Recording(
        id=plan.id,
        robot=plan.robot,
        motion=plan.motion,
        support=plan.support,
        source=plan.source,
        joints=plan.joints,
        time=plan.time[1 : end + 1] - plan.time[1],
        target=plan.target[1 : end + 1],
        position=position[:end],
        extras=extras,
        repeat_of=plan.repeat_of,
        setup=plan.setup,
        notes=plan.notes,
    )


def _simulated(file: Path) -> bool:
    """Whether a file is of a virtual robot, which can be recorded again, unlike a real one."""
    try:
        return bool(read_header(file).metadata["source"] == "simulation")
    except InputError:
        return False


def _reveals(file: Path) -> bool:
    """Whether a file is the truth of a virtual robot, which can be written again."""
    try:
        told = read_json(file)
    except InputError:
        return False
    return isinstance(told, dict) and told.keys() == TRUTH


def record(
    robot: RobotDescription,
    kinds: Sequence[str],
    folder: Path,
    seed: int,
    actuator: str = "nn_pd",
    parameters: Mapping[str, float] | None = None,
    noise: SensorNoise = SensorNoise(),
    jitter: bool = True,
    repeats: int = 1,
    truth: Path | None = None,
    setup: Mapping[str, float] | None = None,
) -> tuple[Recording, ...]:
    """Make scripts, record them on a virtual robot and write the recordings.

    Args:
      robot: the robot.
      kinds: what it plays, as in `script`.
      folder: where the files go; it may hold no recordings but those of a virtual robot that are
        written again.
      seed: of everything random. Parameters, scripts and noise are drawn independently: other
        motions under the same seed are those of the same robot.
      actuator: its torque law, `nn_pd` or `pd`.
      parameters: what the robot is like; drawn by `concealed_parameters` when None.
      noise: its sensors and clock.
      jitter: whether ticks come at random intervals of 25 to 33 Hz.
      repeats: how often each motion is recorded.
      truth: file to reveal the parameters in; they stay concealed when None.
      setup: what is changed on the robot, by its knobs.
    """
    if truth is not None and truth.exists() and not _reveals(truth):
        raise InputError(f"{truth}: holds something else; name another file for the truth")
    own, scripted, sensed = (
        np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(3)
    )
    if parameters is None:
        parameters = concealed_parameters(robot, actuator, own)
    motions = script(robot, kinds, scripted, jitter)
    recordings = record_virtual(robot, motions, actuator, parameters, sensed, noise, repeats, setup)
    names = {f"{recording.id}.parquet" for recording in recordings}
    found = sorted(folder.glob("*.parquet"))
    others = [file.name for file in found if file.name not in names or not _simulated(file)]
    if others:
        raise InputError(f"{folder}: holds other recordings ({others[0]}); use an empty folder")
    write_recordings(recordings, folder)
    if truth is not None:
        complete = nominal_space(robot, actuator).at(parameters)
        write_json(
            truth,
            {
                "schema": 1,
                "robot": robot.name,
                "actuator": actuator,
                "seed": seed,
                "parameters": complete.candidates().named(),
            },
        )
    return recordings
