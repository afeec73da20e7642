"""A rollout: the policy moves the robot, on board, and every tick is kept for the recording.

What the policy sees is what it saw in training (paper, section VI-A): the joints and the torso's
roll and pitch, now and a tick ago.
"""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hardware_agent.limits import Applied
from hardware_agent.senses import Senses
from pup.errors import InputError
from pup.policy.bundle import NumpyPolicy
from pup.recording import Recording
from pup.wire import Assign

Array = NDArray[np.float64]

IMU_COLUMNS = (
    *("imu/roll", "imu/pitch", "imu/yaw"),
    *(f"imu/{kind}_{axis}" for kind in ("gyro", "accel") for axis in "xyz"),
)
LONGEST = 120
"""Characters of a recording's id."""
KINDS = ("target", "position", "velocity", "load", "temperature")
"""Of a row, for every joint."""


@dataclass(frozen=True, eq=False)
class Row:
    """A tick of a rollout.

    Attributes:
      time: since its start, s.
      senses: what was read.
      applied: what was sent then.
      torque: whether the servos held.
    """

    time: float
    senses: Senses
    applied: Applied
    torque: bool = True

    @property
    def values(self) -> Array:
        """Its numbers; see `row_names`."""
        own = self.senses
        per_joint = [self.applied.goal, _fresh(own), own.velocity, own.load, own.temperature]
        rest = [[own.supply], _inertial(own), [float(self.torque)]]
        return np.concatenate([[self.time], *per_joint, *rest])


class Rollout:
    """A policy at work.

    Args:
      policy: of the bundle.
      eta: what it is conditioned on.
      rate: of the control loop, Hz.

    Raises:
      InputError: the policy is not for this; the message says why.
    """

    def __init__(self, policy: NumpyPolicy, eta: Sequence[float], rate: float) -> None:
        card = policy.card
        if len(eta) != card.shape.eta:
            raise InputError(f"eta has {len(eta)} numbers; the policy takes {card.shape.eta}")
        if not card.projected(eta):
            raise InputError(f"eta {list(eta)} is outside -1 to 1, where all projections lie")
        card.check_rate(rate)
        self._policy, self._eta = policy, np.array(eta, dtype=np.float64)
        self._columns = columns(card.joints, card.observation)
        self._offset = card.gait.imu_pitch_offset
        self._start: float | None = None
        self._before: Array | None = None
        self._actions: list[Array] = []
        self.rows: list[Row] = []

    @property
    def pose(self) -> Array:
        """That it starts in, rad."""
        shape = self._policy.card.shape
        return self._policy.targets(0.0, np.full((1, shape.joints), (shape.bins - 1) / 2))

    def time(self, now: float) -> float:
        """Since the start of the walk, s.

        To the nanosecond: what rounding leaves of a difference tells when the walk began, and
        targets would differ by it.
        """
        return 0.0 if self._start is None else round(now - self._start, 9)

    def target(self, senses: Senses) -> Array:
        """What the policy wants of a tick, rad, shape (n_joints,)."""
        if self._start is None:
            self._start = senses.time
        now = self._reading(senses)
        seen = np.concatenate([now if self._before is None else self._before, now])
        self._before = now
        self._actions.append(self._policy.act(seen[self._columns], self._eta))
        del self._actions[: -self._policy.card.smoothing]
        return self._policy.targets(self.time(senses.time), np.array(self._actions))

    def keep(self, senses: Senses, applied: Applied, torque: bool = True) -> None:
        """Add a tick to the recording."""
        self.rows.append(Row(self.time(senses.time), senses, applied, torque))

    def _reading(self, senses: Senses) -> Array:
        roll, pitch = (senses.imu.roll, senses.imu.pitch) if senses.imu else (np.nan, np.nan)
        return np.concatenate([senses.position, [roll, pitch - self._offset]])


def columns(joints: Sequence[str], names: Sequence[str]) -> NDArray[np.intp]:
    """Where a policy's entries stand in two readings in a row."""
    both = [
        *(f"position_before/{joint}" for joint in joints),
        *("imu_before/roll", "imu_before/pitch"),
        *(f"position/{joint}" for joint in joints),
        *("imu/roll", "imu/pitch"),
    ]
    unknown = [name for name in names if name not in both]
    if unknown:
        raise InputError(
            f"the policy wants to see {unknown[0]!r}, which no sensor of this robot is"
        )
    return np.array([both.index(name) for name in names], dtype=np.intp)


def recording_id(assign: Assign) -> str:
    """The id of a trial's recording; the same whenever it is asked for."""
    told = f"{assign.study}_{assign.trial}_{assign.attempt}"
    plain = re.sub(r"[^A-Za-z0-9_.-]", "-", told).lstrip(".")
    if plain == told and len(told) <= LONGEST:
        return told
    return f"{plain[: LONGEST - 17]}-{hashlib.sha256(told.encode()).hexdigest()[:16]}"


def row_names(joints: Sequence[str]) -> tuple[str, ...]:
    """What the numbers of a row are, as docs/recordings.md names columns."""
    per_joint = [f"{kind}/{joint}" for kind in KINDS for joint in joints]
    return ("time", *per_joint, "voltage", *IMU_COLUMNS, "torque_enabled")


def recording_of(
    assign: Assign, rows: Array, joints: Sequence[str], robot: str, source: str, notes: str
) -> Recording:
    """What a rollout did, by docs/recordings.md.

    Args:
      assign: the trial.
      rows: of its ticks, two at least, shape (n_ticks, n_columns); see `row_names`.
      joints: their names.
      robot: its name.
      source: `hardware` or `simulation`.
      notes: free text.
    """
    return Recording(
        id=recording_id(assign),
        robot=robot,
        motion="walk",
        support="ground",
        source=source,
        **columns_of(rows, joints),
        repeat_of=assign.repeat_of,
        notes=notes,
    )


def columns_of(rows: Array, joints: Sequence[str]) -> dict[str, Any]:
    """What rows say of joints, time, targets, positions and the rest, as a Recording takes it.

    Args:
      rows: shape (n_ticks, n_columns); see `row_names`.
      joints: their names.
    """
    n = len(joints)
    table = dict(zip(row_names(joints), rows.T, strict=True))
    main = {"time", *(f"{kind}/{joint}" for kind in KINDS[:2] for joint in joints)}
    return {
        "joints": tuple(joints),
        "time": rows[:, 0],
        "target": rows[:, 1 : 1 + n],
        "position": rows[:, 1 + n : 1 + 2 * n],
        "extras": {k: v for k, v in table.items() if k not in main and not np.isnan(v).all()},
    }


def _fresh(senses: Senses) -> Array:
    """Positions of the tick itself; a reading of an earlier one is missing in this one."""
    return np.where(senses.seen == senses.time, senses.position, np.nan)


def _inertial(senses: Senses) -> Array:
    imu = senses.imu
    if imu is None or senses.imu_seen != senses.time:
        return np.full(len(IMU_COLUMNS), np.nan)
    return np.concatenate([[imu.roll, imu.pitch, imu.yaw], imu.gyro, imu.accel])
