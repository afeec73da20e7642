"""Gait patterns: periodic actions beside the reference, with a reflex to how the torso turns.

The oldest controller that walks: a pattern in the phase of the gait that knows nothing of the
robot's state, steadied by what the IMU feels. It has so few numbers that a search without gradients
finds one that walks within minutes, where exploration joint by joint finds it within hours or never
(docs/results/training.md). A policy is shown it at the beginning (`demonstration`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pup.locomotion.settings import Direction
from pup.robot import RobotDescription

Array = NDArray[np.float64]

WAVES = 5
"""A mean, and cosine and sine of the phase and of twice the phase."""
TILTS = 2
"""The torso's roll and pitch."""
TURN = 0.3
"""Change of the torso's roll or pitch, in a control step of the paper's robot, that a gain of 1
answers with a whole reach, rad."""
HALF_TURN = np.array([1.0, -1.0, -1.0, 1.0, 1.0])
"""What half a period later makes of the waves."""
PHASES = np.arange(64) / 64
"""Of the gait, at which it is held against its mirror image."""
ROUNDING = 1e-9
"""Difference of two mean squares that says nothing, rad²."""


@dataclass(frozen=True)
class Patterns:
    """A pattern for each of n simulations, in units of the reach.

    Attributes:
      waves: shape (n, n_joints, WAVES).
      gains: of the torso's turning, shape (n, n_joints, TILTS).
    """

    waves: Array
    gains: Array

    def repeated(self, count: int) -> "Patterns":
        """Each pattern `count` times, one after the other."""
        return Patterns(np.repeat(self.waves, count, 0), np.repeat(self.gains, count, 0))

    def bins(self, phase: Array, turned: Array, bins: int) -> Array:
        """Actions between 0 and bins - 1, shape (n, n_joints).

        Args:
          phase: its cosine and sine, shape (n, 2).
          turned: change of the torso's roll and pitch in a control step of the paper's robot, shape
            (n, TILTS), rad.
          bins: values that an action has.
        """
        c, s = phase[:, 0], phase[:, 1]
        basis = np.stack([np.ones_like(c), c, s, c * c - s * s, 2 * c * s], axis=1)
        reflex = np.clip(turned / TURN, -1.0, 1.0)
        action = np.einsum("njw,nw->nj", self.waves, basis)
        action += np.einsum("njt,nt->nj", self.gains, reflex)
        return np.asarray((np.clip(action, -1.0, 1.0) + 1) / 2 * (bins - 1))


class PatternSpace:
    """The patterns of a robot, on a unit cube.

    Joints that the reference gait moves take part. Where the robot has a mirror map one leg's
    reflex is the other's mirror image, and, if the direction has this symmetry too, so is its
    pattern: half a period later, or at once where the legs of the gait go in pairs, as in a bound
    or a hop. A joint that is its own mirror image is free.

    Args:
      robot: with a gait.
      direction: of the walk.
    """

    def __init__(self, robot: RobotDescription, direction: Direction) -> None:
        assert robot.gait is not None
        self.robot, self.joints = robot, len(robot.joints)
        moved = [i for i, s in enumerate(robot.gait.joints.values()) if s.a or s.b]
        partner, self._sign = _mirror(robot)
        self._partner = partner
        half = sorted({min(i, partner[i]) for i in moved})
        self._felt = half
        self._waved = half if direction.symmetric else moved
        self._symmetric = direction.symmetric
        self._later = _between_mirror_images(robot)

    @property
    def dimension(self) -> int:
        """Numbers of a pattern."""
        return len(self._waved) * WAVES + len(self._felt) * TILTS

    def patterns(self, unit: Array) -> Patterns:
        """Patterns of points of the cube, shape (n, dimension); its middle is none at all."""
        n, cut = len(unit), len(self._waved) * WAVES
        told = 2 * unit - 1
        waves, gains = np.zeros((n, self.joints, WAVES)), np.zeros((n, self.joints, TILTS))
        waves[:, self._waved] = told[:, :cut].reshape(n, -1, WAVES)
        gains[:, self._felt] = told[:, cut:].reshape(n, -1, TILTS)
        if self._symmetric:
            waves = self._completed(waves, self._waved, self._later)
        # A mirrored robot rolls to the other side and pitches to the same.
        gains = self._completed(gains, self._felt, np.array([-1.0, 1.0]))
        return Patterns(waves, gains)

    def _completed(self, told: Array, given: list[int], signs: Array) -> Array:
        """Fill in the mirror images of the given joints."""
        other = [self._partner[i] for i in given]
        image = self._sign[given, None] * told[:, given] * signs
        told = told.copy()
        told[:, other] = np.where(np.equal(other, given)[:, None], told[:, given], image)
        return told


def _between_mirror_images(robot: RobotDescription) -> Array:
    """What the time from the gait to its mirror image makes of the waves, shape (WAVES,).

    Half a period or none, whichever the reference is nearer to.
    """
    assert robot.gait is not None
    partner, sign = _mirror(robot)
    image = sign * robot.gait.angles(PHASES)[:, partner]
    half, none = (np.mean((robot.gait.angles(PHASES + later) - image) ** 2) for later in (0.5, 0.0))
    return HALF_TURN if half <= none + ROUNDING else np.ones(WAVES)


def _mirror(robot: RobotDescription) -> tuple[list[int], Array]:
    """Each joint's partner and the sign between them; itself where there is no mirror map."""
    if not robot.mirrored:
        return list(range(len(robot.joints))), np.ones(len(robot.joints))
    permutation, sign = robot.mirror()
    return [int(i) for i in permutation], np.asarray(sign, dtype=np.float64)
