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
SIDEWAYS = ("y", "roll", "yaw")
"""What tells left from right, as in `torso_com/y` and `ground_slope/roll@ground`."""
DIRECTED = (
    *("gain_asymmetry", "friction_asymmetry", "cogging", "joint_spring", "joint_stop"),
    *("encoder_bias", "encoder_eccentricity", "learned_law"),
)
"""Effects that tell one direction of a joint from the other, which the mirror may exchange."""


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
          parameters: names of mu; those of a joint or group are exchanged with those of its mirror
            image, on the scale of the bounds. What is `unmirrored` stays as it is.
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
            _exchanged(robot, parameters),
            mirrored.ravel(),
            len(joints),
        )

    def bins(self, bins: NDArray[np.int64]) -> NDArray[np.int64]:
        """Mirrored bins of actions, shape (..., joints)."""
        count = len(self.logits) // self.joints
        middle = self.logits.reshape(count, self.joints)[0]
        taken = bins[..., middle % self.joints]
        return np.where(middle >= self.joints, count - 1 - taken, taken)


def unmirrored(robot: RobotDescription, parameters: Sequence[str]) -> tuple[str, ...]:
    """Those of mu whose mirror image is not known or not in mu.

    Raises:
      InputError: the robot has no mirror map.
    """
    image = _images(robot, parameters)
    return tuple(name for name in parameters if image[name] not in image)


def _exchanged(robot: RobotDescription, parameters: Sequence[str]) -> NDArray[np.int64]:
    index, image = {name: i for i, name in enumerate(parameters)}, _images(robot, parameters)
    exchanged = [index.get(image[name], index[name]) for name in parameters]
    return np.array(exchanged, dtype=np.int64)


def _images(robot: RobotDescription, parameters: Sequence[str]) -> dict[str, str]:
    """The name of each parameter's mirror image; empty where that is not known.

    They are called as `kp/knee` and `torso_com/x`, those of terms as `backlash/gap@joint:l_knee`.
    """
    permutation, _ = robot.mirror()
    joints = {one.name: robot.joints[permutation[i]] for i, one in enumerate(robot.joints)}
    groups = {one.group: joints[one.name].group for one in robot.joints}
    other = {f"joint:{name}": f"joint:{partner.name}" for name, partner in joints.items()}
    other |= {f"group:{name}": f"group:{partner}" for name, partner in groups.items()}
    lone = {"", f"body:{robot.torso}", "bus", "ground", "robot", "sensor"}
    other |= {place: place for place in lone}
    images = {}
    for name in parameters:
        what, at, place = name.partition("@")
        effect, slash, quantity = what.partition("/")
        of_group = not at and quantity in groups
        lateral = quantity in SIDEWAYS and not of_group
        body, _, axis = quantity.partition("/")  # of a mass no axis
        of_body = effect in ("mass", "com") and not at
        elsewhere = of_body and (body != robot.torso or axis in SIDEWAYS)
        if lateral or elsewhere or effect in DIRECTED or place not in other:
            images[name] = ""
        else:
            quantity = groups[quantity] if of_group else quantity
            images[name] = f"{effect}{slash}{quantity}{at}{other[place]}"
    return images
