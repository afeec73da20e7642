"""The left-right symmetry of a robot, for observations and actions (paper, section VI).

Valid where the task has it too: walking straight, not sideways.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.policy.shape import BINS
from pup.robot import RobotDescription

IMU = {"roll": -1.0, "pitch": 1.0}
"""Signs of the torso's angles."""


@dataclass(frozen=True)
class MirrorMap:
    """What the mirrored robot sees and does: an involution.

    Attributes:
      entries: of an observation: `mirrored = signs * observation[..., entries]`.
      signs: of the entries, shape (n_entries,).
      parameters: of mu: `mirrored = mu[..., parameters]`.
      logits: of flat logits, bins-major: `mirrored = flat[..., logits]`. A joint whose angle
        changes its sign has its bins reversed.
      joints: of the robot.
    """

    entries: NDArray[np.int64]
    signs: NDArray[np.float32]
    parameters: NDArray[np.int64]
    logits: NDArray[np.int64]
    joints: int

    @classmethod
    def of(
        cls,
        robot: RobotDescription,
        observation: Sequence[str],
        parameters: Sequence[str],
        bins: int = BINS,
    ) -> "MirrorMap":
        """The symmetry of a robot.

        Args:
          robot: with a mirror map in its `robot.toml`.
          observation: names of the entries; a joint's name, `roll` or `pitch` stands after the
            last `/`, as in `position/l_knee`.
          parameters: names of mu; those of a group are exchanged with the mirrored joints' group.
          bins: values an action may take at a joint.

        Raises:
          InputError: the robot has no mirror map.
        """
        permutation, sign = robot.mirror()
        joints = robot.joint_names
        partner = {n: joints[permutation[i]] for i, n in enumerate(joints)}
        turned = dict(zip(joints, sign, strict=True))
        place = {name: i for i, name in enumerate(observation)}
        entries, signs = [], []
        for name in observation:
            where, _, what = name.rpartition("/")
            other = f"{where}/{partner.get(what, what)}"
            if other not in place or (what not in partner and what not in IMU):
                raise InputError(f"robot {robot.name!r}: observation {name!r} has no mirror image")
            entries.append(place[other])
            signs.append(turned[what] if what in turned else IMU[what])
        flat = np.arange(bins * len(joints)).reshape(bins, len(joints))
        mirrored = np.where(sign < 0, flat[::-1, permutation], flat[:, permutation])
        return cls(
            np.array(entries, dtype=np.int64),
            np.array(signs, dtype=np.float32),
            _exchanged(robot, partner, parameters),
            mirrored.ravel(),
            len(joints),
        )

    def bins(self, bins: NDArray[np.int64]) -> NDArray[np.int64]:
        """Mirrored bins of actions, shape (..., joints)."""
        count = len(self.logits) // self.joints
        middle = self.logits.reshape(count, self.joints)[0]
        taken = bins[..., middle % self.joints]
        return np.where(middle >= self.joints, count - 1 - taken, taken)


def _exchanged(
    robot: RobotDescription, partner: dict[str, str], parameters: Sequence[str]
) -> NDArray[np.int64]:
    group = {joint.name: joint.group for joint in robot.joints}
    other = {group[joint]: group[partner[joint]] for joint in partner}
    index = {name: i for i, name in enumerate(parameters)}
    exchanged = []
    for name in parameters:
        what, _, where = name.rpartition("/")
        exchanged.append(index.get(f"{what}/{other.get(where, where)}", index[name]))
    return np.array(exchanged, dtype=np.int64)
