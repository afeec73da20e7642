"""The walking task: a batch of robots that a policy moves one control step at a time.

The paper's section VI: a reference of stepping in place, to whose joint angles the policy adds
`reach` times its action; two consecutive readings of the joints and of the torso's roll and pitch
to act on; a reward for speed. What the paper leaves out is the authors' (see `TaskSettings`).
"""

import json
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.locomotion.engines import make_simulations
from pup.locomotion.falls import Falls
from pup.locomotion.reference import Reference, gait_of
from pup.locomotion.sampling import MARGIN, ParameterSampler
from pup.locomotion.settings import TaskSettings
from pup.locomotion.simulations import Motion, Pose
from pup.locomotion.start import Starts
from pup.physics.engine import Engine
from pup.physics.outfit import mount
from pup.physics.rotations import heading, multiply, roll_pitch
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.int64]
Action = NDArray[np.integer] | NDArray[np.floating]
"""Bins, or between them, 0 to bins - 1."""

COURSE = ("aside", "heading", "roll", "pitch", "speed/ahead", "speed/aside", "phase/x", "phase/y")
"""What no sensor of the robot reads of the course it is on.

Where it is aside and how it is tilted, of what ends an episode; where it heads, rad; how fast, in
units of PACE; where the gait is. A value function that sees none of it takes every walk that ends
aside for chance: it told 2 % of the returns' variance.
"""
PACE = 0.2
"""m/s, about what a torso sways with."""


@dataclass(frozen=True)
class Observation:
    """What a policy is given, a row per simulation.

    Attributes:
      proprioception: readings, noise included, shape (n, n_observed), rad; see
        `WalkingTask.observation_names`.
      parameters: mu as told to the policy, on the unit scale of its bounds and off by the noise of
        the episode, shape (n, n_parameters).
      true_parameters: mu as it is, same scale and shape, for evaluation.
      privileged: what a value function may know besides, shape (n, n_privileged): the course that
        the robot is on and mu as it is, about 0; see `WalkingTask.privileged_names`.
    """

    proprioception: NDArray[np.float32]
    parameters: NDArray[np.float32]
    true_parameters: NDArray[np.float32]
    privileged: NDArray[np.float32]


@dataclass(frozen=True)
class Step:
    """What one control step gave, a row per simulation.

    Attributes:
      observation: of the state after the step; at the end of an episode, its last.
      reward: shape (n,); 0 where the robot fell.
      terminated: whether it fell, drifted off, touched what it should not, or broke down.
      truncated: whether the time was over instead.
      live: False where the step was the reset that follows an end: the action was ignored, the
        reward is 0, and the observation is the first of the new episode.
      distance: way in the direction since the start of the episode, m.
      aside: way across it, m.
      time: since the start of the episode, s.
    """

    observation: Observation
    reward: NDArray[np.float32]
    terminated: Flags
    truncated: Flags
    live: Flags
    distance: Array
    aside: Array
    time: Array


@dataclass
class _Episodes:
    """The running episodes, a row each.

    Attributes:
      mu: true parameters on the unit scale, shape (n, n_parameters).
      told: those told to the policy.
      period: of control, s.
      steps: control steps done.
      time: since the start, s.
      bias: error of the IMU's roll and pitch, shape (n, 2), rad.
      actions: the latest ones in a ring, shape (n, smoothing, n_joints), in [-1, 1]; 0 before.
      start: place of the torso at the start, shape (n, 3), m.
      place: the same now.
      position: readings of the joints, the last before the latest, shape (n, 2, n_joints), rad.
      tilt: readings of roll and pitch, likewise, shape (n, 2, 2), rad.
      course: see `WalkingTask.privileged_names`, shape (n, len(COURSE)).
      over: whether the episode has ended and the next step resets.
    """

    mu: Array
    told: Array
    period: Array
    steps: Rows
    time: Array
    bias: Array
    actions: Array
    start: Array
    place: Array
    position: Array
    tilt: Array
    course: Array
    over: Flags


class WalkingTask:
    """n walking robots, one control step at a time, with NEXT_STEP autoreset.

    An episode that ends keeps its last observation; the step after ignores the action and returns
    the first observation of the next episode. A simulation that breaks down ends its episode.
    The same seed gives the same episodes, whatever the number of threads.

    Args:
      robot: a robot with a free torso, feet, a floor and a gait.
      sampler: gives each episode's model parameters.
      settings: the rest of the task.
      n: simulations.
      rng: draws everything that is random.
      threads: None for as many as there are cores.
      engine: what simulates.

    Raises:
      InputError: the robot cannot walk, a term of it cannot act, or the engine does not do.

    Attributes:
      motion: what the last control step left.
      falls: by what robots fell in it.
    """

    motion: Motion
    falls: Falls

    def __init__(
        self,
        robot: RobotDescription,
        sampler: ParameterSampler,
        settings: TaskSettings,
        n: int,
        rng: np.random.Generator,
        threads: int | None = None,
        engine: Engine = Engine.MUJOCO,
    ) -> None:
        self.robot = robot
        self.gait = gait_of(robot)
        self.sampler = sampler
        self.settings = settings
        self.n = n
        self.rng = rng
        self.bins = settings.bins
        self.joints = robot.joint_names
        self.parameter_names = sampler.names
        self.reference = Reference(self.gait)
        self.lower, self.upper = robot.limits
        self._axis = np.array(settings.direction.axis)
        self._across = np.array([-self._axis[1], self._axis[0]])
        self._starts = Starts(robot, self.reference.start, settings, n)
        bounds = sampler.bounds
        self._simulations = make_simulations(
            engine,
            robot,
            sampler.largest(),
            bounds.actuator,
            n,
            settings.substeps,
            1 / settings.control_rate[1],
            threads,
        )
        self._mount = mount(robot, self._starts.model)
        self._episodes = self._blank()

    @property
    def observation_names(self) -> tuple[str, ...]:
        """Names of the columns of `Observation.proprioception`."""
        return (
            *(f"position_before/{joint}" for joint in self.joints),
            *(f"position/{joint}" for joint in self.joints),
            *("imu/roll", "imu/pitch", "imu_before/roll", "imu_before/pitch"),
        )

    @property
    def privileged_names(self) -> tuple[str, ...]:
        """Names of the columns of `Observation.privileged`."""
        return (*(f"course/{name}" for name in COURSE), *self.parameter_names)

    def reset(self) -> Observation:
        """Start a new episode in every simulation."""
        self._restart(np.arange(self.n))
        return self._observation()

    def step(self, action: Action) -> Step:
        """Move every robot by one control step.

        Args:
          action: shape (n, n_joints), each 0 to bins - 1.
        """
        episodes, live = self._episodes, ~self._episodes.over
        reference = self.reference.angles(episodes.time)
        self.motion = motion = self._simulations.step(self._target(reference, action), live)
        before = episodes.place
        episodes.place = np.where(motion.lost[:, None], before, motion.root[:, :3])
        episodes.time = episodes.time + episodes.period
        self._read(motion)
        self.falls = self._fallen(motion)
        terminated = live & self.falls.any()
        truncated = live & ~terminated & (episodes.time >= self.settings.horizon)
        velocity = (episodes.place - before) / episodes.period[:, None]
        speed = velocity[:, :2] @ self._axis
        reward = np.where(live & ~terminated, self._reward(motion, reference, speed), 0.0)
        episodes.course = self._course(motion.root, velocity, np.arange(self.n))
        episodes.over = terminated | truncated
        if not live.all():
            self._restart(np.flatnonzero(~live))
        walked = (episodes.place - episodes.start)[:, :2]
        return Step(
            observation=self._observation(),
            reward=reward.astype(np.float32),
            terminated=terminated,
            truncated=truncated,
            live=live,
            distance=walked @ self._axis,
            aside=walked @ self._across,
            time=episodes.time.copy(),
        )

    def phase(self) -> Array:
        """Cosine and sine of where the gait of each simulation is, shape (n, 2)."""
        return self.reference.phase(self._episodes.time)

    def state(self) -> dict[str, NDArray[np.generic]]:
        """Everything the coming steps depend on, to go on from bit by bit."""
        told = json.dumps(self.rng.bit_generator.state).encode()
        return {
            "rng": np.frombuffer(told, dtype=np.uint8),
            **{f"episodes/{f.name}": getattr(self._episodes, f.name).copy() for f in _FIELDS},
            **{f"simulations/{name}": a for name, a in self._simulations.state().items()},
        }

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Take up a state of the same task; see `state`."""
        self.rng.bit_generator.state = json.loads(state["rng"].tobytes())
        self._episodes = _Episodes(**{f.name: state[f"episodes/{f.name}"].copy() for f in _FIELDS})
        rows = np.arange(self.n)
        model = self._starts.model.compiled
        empty = np.tile(self._starts.qpos, (self.n, 1)), np.zeros((self.n, model.nv))
        self._put(rows, *empty)
        prefix = "simulations/"
        physics = {k.removeprefix(prefix): v for k, v in state.items() if k.startswith(prefix)}
        self._simulations.restore(physics)

    def _blank(self) -> _Episodes:
        n, joints, parameters = self.n, len(self.joints), len(self.parameter_names)
        return _Episodes(
            mu=np.zeros((n, parameters)),
            told=np.zeros((n, parameters)),
            period=np.ones(n),
            steps=np.zeros(n, dtype=np.int64),
            time=np.zeros(n),
            bias=np.zeros((n, 2)),
            actions=np.zeros((n, self.settings.smoothing, joints)),
            start=np.zeros((n, 3)),
            place=np.zeros((n, 3)),
            position=np.zeros((n, 2, joints)),
            tilt=np.zeros((n, 2, 2)),
            course=np.zeros((n, len(COURSE))),
            over=np.ones(n, dtype=bool),
        )

    def _restart(self, rows: Rows) -> None:
        """Begin new episodes in some simulations."""
        episodes, settings, rng, k = self._episodes, self.settings, self.rng, len(rows)
        mu = self.sampler.draw(rng, rows)
        off = rng.uniform(-settings.parameter_noise, settings.parameter_noise, mu.shape)
        episodes.mu[rows] = mu
        episodes.told[rows] = np.clip(mu + off, -MARGIN, 1 + MARGIN)
        episodes.period[rows] = 1 / rng.uniform(*settings.control_rate, k)
        episodes.bias[rows] = rng.uniform(-settings.tilt_bias, settings.tilt_bias, (k, 2))
        episodes.steps[rows], episodes.time[rows], episodes.actions[rows] = 0, 0.0, 0.0
        episodes.over[rows] = False
        qpos, qvel = self._starts.draw(rng, k)
        pose = self._put(rows, qpos, qvel)
        episodes.start[rows] = episodes.place[rows] = pose.root[:, :3]
        episodes.position[rows] = self._noisy(pose.encoders, rng)[:, None]
        episodes.tilt[rows] = self._tilted(pose.imu, episodes.bias[rows], rng)[:, None]
        episodes.course[rows] = self._course(pose.root, np.zeros((k, 3)), rows)

    def _put(self, rows: Rows, qpos: Array, qvel: Array) -> Pose:
        """Give simulations the parameters of their episodes, and a state."""
        timestep = self._episodes.period[rows] / self.settings.substeps
        parameters = self.sampler.candidates(self._episodes.mu[rows])
        return self._simulations.start(rows, parameters, timestep, qpos, qvel)

    def _target(self, reference: Array, action: Action) -> Array:
        """Reference + reach times the mean of the latest actions, within the joint limits."""
        episodes, settings = self._episodes, self.settings
        latest = 2.0 / (self.bins - 1) * action - 1.0
        episodes.actions[np.arange(self.n), episodes.steps % settings.smoothing] = latest
        episodes.steps = episodes.steps + 1
        count = np.minimum(episodes.steps, settings.smoothing)[:, None]
        mean = episodes.actions.sum(axis=1) / count
        target = reference + settings.direction.reach * mean
        return np.asarray(np.clip(target, self.lower, self.upper))

    def _fallen(self, motion: Motion) -> Falls:
        """By what episodes end otherwise than by time."""
        moved = self._episodes.place - self._episodes.start
        aside = self.settings.on_course * np.abs(moved[:, :2] @ self._across)
        return Falls.of(motion, moved[:, 2], aside, self.gait)

    def _course(self, root: Array, velocity: Array, rows: Rows) -> Array:
        """See COURSE; of some simulations, shape (n_rows, len(COURSE))."""
        moved = (self._episodes.place - self._episodes.start)[rows, :2]
        ahead = np.stack([self._axis, self._across], axis=1)
        parts = (
            moved @ self._across[:, None] / self.gait.drift_limit,
            heading(root[:, 3:])[:, None],
            roll_pitch(root[:, 3:]) / self.gait.tilt_limit,
            velocity[:, :2] @ ahead / PACE,
            self.phase()[rows],
        )
        return np.concatenate(parts, axis=1)

    def _reward(self, motion: Motion, reference: Array, speed: Array) -> Array:
        """The paper's reward (section VI-A) less the authors' cost of swaying."""
        s = self.settings
        return np.asarray(
            s.alive
            + s.speed_weight * speed
            - s.torque_weight * _dot(motion.torque, motion.torque)
            - s.work_weight * _dot(motion.torque, motion.velocity)
            - s.tracking_weight * _dot(reference - motion.position, reference - motion.position)
            - s.lateral_weight * np.abs(motion.drift[:, :2] @ self._across)
        )

    def _read(self, motion: Motion) -> None:
        """Take new readings; a simulation that broke down keeps its last."""
        episodes, lost = self._episodes, motion.lost[:, None]
        position = self._noisy(motion.encoders, self.rng)
        tilt = self._tilted(motion.imu, episodes.bias, self.rng)
        for kept, new in ((episodes.position, position), (episodes.tilt, tilt)):
            kept[:, 0] = kept[:, 1]
            kept[:, 1] = np.where(lost, kept[:, 1], new)

    def _noisy(self, position: Array, rng: np.random.Generator) -> Array:
        noise = self.settings.position_noise * rng.standard_normal(position.shape)
        return np.asarray(position + noise)

    def _tilted(self, torso: Array, bias: Array, rng: np.random.Generator) -> Array:
        """The IMU's roll and pitch, shape (n, 2), rad, for orientations of the torso as read."""
        tilt = roll_pitch(multiply(torso, self._mount)) + bias
        tilt[:, 1] -= self.gait.imu_pitch_offset
        noise = self.settings.tilt_noise
        return np.asarray(tilt + rng.uniform(-noise, noise, tilt.shape))

    def _observation(self) -> Observation:
        episodes = self._episodes
        position, tilt = episodes.position, episodes.tilt
        parts = position[:, 0], position[:, 1], tilt[:, 1], tilt[:, 0]
        return Observation(
            np.concatenate(parts, axis=1, dtype=np.float32, casting="same_kind"),
            episodes.told.astype(np.float32),
            episodes.mu.astype(np.float32),
            np.concatenate(
                [episodes.course, 2 * episodes.mu - 1],
                axis=1,
                dtype=np.float32,
                casting="same_kind",
            ),
        )


_FIELDS = fields(_Episodes)


def _dot(a: Array, b: Array) -> Array:
    """Row by row."""
    return np.asarray(np.einsum("ij,ij->i", a, b))
