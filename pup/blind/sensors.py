"""What the sensors make of what happened."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pup.blind.simulate import Run
from pup.blind.world import Array, Effect, Plan, World
from pup.recording import Recording

LEAST = 5  # ticks that a dropout may never take a recording below


@dataclass(frozen=True)
class Noise:
    """What sensors and bus add.

    Attributes:
      position: standard deviation of a joint reading before rounding, rad.
      quantum: step to which it is rounded, rad; 0 for none. The default is a 12-bit encoder's.
      imu: standard deviation of roll and pitch, rad.
      memory: correlation of the noise from one tick to the next.
      lost: share of readings that are missing.
      gaps: share of ticks, whole rows, that are missing.
    """

    position: float = 0.0015
    quantum: float = 2 * np.pi / 4096
    imu: float = 0.002
    memory: float = 0.0
    lost: float = 0.0
    gaps: float = 0.0

    @property
    def sigma(self) -> float:
        """Standard deviation of a reading with its rounding, rad."""
        return float(np.sqrt(self.position**2 + self.quantum**2 / 12))


@dataclass(frozen=True, eq=False)
class Seen:
    """Noise-free readings of one plan at its ticks.

    Attributes:
      position: shape (n_ticks, n_joints), rad.
      tilt: roll and pitch, shape (n_ticks, 2), rad; None on a fixed base.
    """

    position: Array
    tilt: Array | None

    def stacked(self) -> Array:
        """All readings in a row, shape (n_ticks * (n_joints or n_joints + 2),)."""
        if self.tilt is None:
            return self.position.ravel()
        return np.concatenate([self.position, self.tilt], axis=1).ravel()


def see(world: World, plans: Sequence[Plan], run: Run, variant: int = 0) -> list[Seen]:
    """Read the sensors at the ticks, without noise.

    Args:
      world: whose sensors.
      plans: those that ran.
      run: what happened.
      variant: which of the run's parameter sets.
    """
    found = []
    for p, plan in enumerate(plans):
        at = np.repeat(plan.time[:, None], len(world.robot.joints), axis=1)
        for effect in world.effects:
            joints = world.joints_at(effect.place)
            if effect.name == "measurement_delay":
                at[:, joints] -= _lateness(effect, len(joints), plan)
            elif effect.name == "clock_skew":
                at *= 1.0 + effect.size
        at = np.clip(at, run.time[0], run.time[-1])
        track = run.position[variant, p]
        position = np.stack(
            [np.interp(when, run.time, path) for when, path in zip(at.T, track.T, strict=True)],
            axis=1,
        )
        tilt = None
        if run.attitude is not None:
            tilt = _tilt(world, run.time, run.attitude[variant, p], plan.time)
        found.append(Seen(position, tilt))
    return found


def measure(
    world: World,
    plan: Plan,
    seen: Seen,
    noise: Noise,
    rng: np.random.Generator,
) -> Recording:
    """Add noise, round, lose samples and write down as a recording that gives nothing away."""
    position = seen.position + _coloured(seen.position.shape, noise.position, noise.memory, rng)
    if noise.quantum:
        position = np.round(position / noise.quantum) * noise.quantum
    lost = rng.uniform(size=position.shape) < noise.lost
    lost[0] = False
    position[lost] = np.nan
    extras: dict[str, Array] = {}
    if seen.tilt is not None and world.robot.imu_site is not None:
        tilt = seen.tilt + _coloured(seen.tilt.shape, noise.imu, noise.memory, rng)
        extras |= {"imu/roll": tilt[:, 0], "imu/pitch": tilt[:, 1]}
    if plan.enabled is not None:
        extras["torque_enabled"] = plan.enabled.astype(np.float64)
    kept = rng.uniform(size=len(plan.time)) >= noise.gaps
    # A row in which something is sent for the first time stays: what was sent is known.
    changed = np.any(np.diff(plan.target, axis=0, prepend=plan.target[:1]) != 0, axis=1)
    if plan.enabled is not None:
        changed |= np.diff(plan.enabled * 1.0, prepend=1.0) != 0
    kept |= changed
    kept[:LEAST] = True
    return Recording(
        id=plan.id,
        robot=world.robot.name,
        motion=plan.motion,
        support=plan.support,
        source="unknown",
        joints=world.robot.joint_names,
        time=plan.time[kept],
        target=plan.target[kept],
        position=position[kept],
        extras={name: values[kept] for name, values in extras.items()},
        setup=plan.setup,
        repeat_of=plan.repeat_of,
    )


def _lateness(effect: Effect, count: int, plan: Plan) -> Array:
    """How old each joint's reading is, s, shape (n_ticks, n_joints); a bus is read in order."""
    rng = np.random.default_rng(zlib.crc32(plan.id.encode()))
    order = np.linspace(0.5, 1.5, count) if effect.form == "one by one" else np.ones(count)
    wobble = 1.0 + effect.shape["jitter"] * rng.normal(size=(len(plan.time), 1))
    return np.asarray(effect.size * order * np.clip(wobble, 0.2, 2.0))


def _coloured(
    shape: tuple[int, ...], sigma: float, memory: float, rng: np.random.Generator
) -> Array:
    """Gaussian noise with an exponential memory, of the same size at every tick."""
    noise = rng.normal(size=shape)
    if memory:
        for k in range(1, len(noise)):
            noise[k] = memory * noise[k - 1] + np.sqrt(1 - memory**2) * noise[k]
    return np.asarray(sigma * noise)


def _tilt(world: World, time: Array, attitude: Array, ticks: Array) -> Array:
    """Roll and pitch as the IMU tells them, shape (n_ticks, 2), rad."""
    w, x, y, z = attitude.T
    mount = np.eye(3)
    late = 0.0
    for effect in world.effects:
        if effect.name == "imu_misalignment":
            mount = _turn(effect.size * np.array([effect.shape[axis] for axis in "xyz"]))
        elif effect.name == "imu_delay":
            late = effect.size
    # The IMU's axes in the world, of which roll and pitch need only the last row.
    row = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    row = row @ mount
    angles = np.stack([np.arctan2(row[:, 1], row[:, 2]), -np.arcsin(np.clip(row[:, 0], -1, 1))])
    if late:  # half of it a transport delay, half a fusion filter
        step = time[1] - time[0]
        share = step / (step + late / 2)
        for k in range(1, angles.shape[1]):
            angles[:, k] = angles[:, k - 1] + share * (angles[:, k] - angles[:, k - 1])
    at = np.clip(ticks - late / 2, time[0], time[-1])
    return np.stack([np.interp(at, time, angle) for angle in angles], axis=1)


def _turn(vector: Array) -> Array:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector / angle if angle else vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)
