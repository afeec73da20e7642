"""The parts of a robot description.

Angles are in radians, everything else in SI units; for a slide joint read m, N and N s/m where a
joint's rad, N m and N m s/rad are meant.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Actuator = Literal["nn_pd", "pd"]
PlaceKind = Literal["joint", "group", "body", "foot", "ground", "sensor", "bus", "robot"]
SINGLE_KINDS: tuple[PlaceKind, ...] = ("ground", "sensor", "bus", "robot")
"""Kinds of places of which a robot has one, without a name."""
NETWORK_WEIGHTS = 27  # W1 2x5, b1 5, W2 5x2, b2 2; matrices row by row


@dataclass(frozen=True)
class Joint:
    """One driven joint.

    Attributes:
      name: its name in the MJCF.
      servo_id: address on the servo bus; None where there is no bus.
      group: joints of a group share their actuator parameters.
      lower: smallest target the robot accepts, rad. The MJCF's range is the mechanical stop.
      upper: largest target the robot accepts, rad.
      mirror: the joint on the other side (itself on the mid-plane); None without a mirror map.
      mirror_sign: +1 or -1; the mirrored angle is this times the angle of `mirror`.
    """

    name: str
    servo_id: int | None
    group: str
    lower: float
    upper: float
    mirror: str | None
    mirror_sign: float


@dataclass(frozen=True)
class Edit:
    """How a knob acts on the model: `field[element][index] = scale * knob + offset`.

    Attributes:
      field: a field of MuJoCo's model, such as `body_mass`.
      element: the body, geom, site or joint by name.
      index: component of a vector field; None for a scalar field.
      scale: field unit per knob unit.
      offset: field unit.
    """

    field: str
    element: str
    index: int | None
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Scaling:
    """How a knob acts on actuator parameters: the parameter times `knob / reference`.

    Attributes:
      parameter: a parameter, or all of a kind (`kp/*`).
      reference: the knob's value at which the parameter means what it says.
    """

    parameter: str
    reference: float


@dataclass(frozen=True)
class Knob:
    """Something a user changes knowingly between recordings, such as a payload."""

    name: str
    unit: str
    default: float
    lower: float
    upper: float
    edits: tuple[Edit, ...]
    scalings: tuple[Scaling, ...]


@dataclass(frozen=True)
class ParameterSpec:
    """One model parameter that identification may move.

    Attributes:
      name: such as `kp/hip`; `pup/robot_space.py` lists the kinds.
      unit: of all the numbers here; `1` for a plain number.
      nominal: before any identification.
      search: lowest and highest value to try.
      actuators: the actuator models that use it.
    """

    name: str
    unit: str
    nominal: float
    search: tuple[float, float]
    actuators: tuple[Actuator, ...]


@dataclass(frozen=True)
class TermSpec:
    """An effect beside the nominal model, at one place of the robot.

    Attributes:
      effect: such as `backlash`; the physics knows which there are, and their quantities.
      kind: of the place.
      name: of the joint, group, body or foot; empty for a kind of which there is one.
      values: by quantity, in the physics' units; a size left out is zero.
    """

    effect: str
    kind: PlaceKind
    name: str
    values: dict[str, float]


class Harmonics(NamedTuple):
    """c0 + sum over h = 1, 2, ... of a[h-1] cos(2 pi h phase) + b[h-1] sin(2 pi h phase), rad."""

    c0: float
    a: tuple[float, ...]
    b: tuple[float, ...]


@dataclass(frozen=True)
class Gait:
    """A periodic reference motion, and how a robot starts it and where it ends as fallen.

    The defaults are those of the paper's authors (dart-env, DartDarwinSquat-v1).

    Attributes:
      period: s.
      joints: a series per joint of the robot, in joint order. It may pass the joint limits.
      start: joint angles that the motion is taken up from, shape (n_joints,), rad; None for those
        of phase 0.
      start_pitch: of the torso at the start, rad; None for the one that lays the feet flat.
      blend: time in which the angles of the start turn into those of phase 0, s.
      tilt_limit: largest roll and pitch of a torso that has not fallen, rad.
      drift_limit: largest way of the torso across the walking direction, or up or down, m.
      ground_bodies: the bodies that may touch the floor.
      imu_pitch_offset: taken off the pitch that the IMU reports before a policy sees it, rad.
    """

    period: float
    joints: dict[str, Harmonics]
    start: tuple[float, ...] | None = None
    start_pitch: float | None = None
    blend: float = 0.2
    tilt_limit: float = 1.0
    drift_limit: float = 0.3
    ground_bodies: tuple[str, ...] = ()
    imu_pitch_offset: float = 0.0

    def angles(self, phase: ArrayLike) -> NDArray[np.float64]:
        """Joint angles, shape phase.shape + (n_joints,), rad, at phase = time / period."""
        phase = np.asarray(phase, dtype=np.float64)
        columns = []
        for c0, a, b in self.joints.values():
            turn = 2 * np.pi * phase[..., None] * np.arange(1, len(a) + 1)
            columns.append(c0 + np.cos(turn) @ np.array(a) + np.sin(turn) @ np.array(b))
        return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class Walk:
    """What of the walking task goes by a robot's size; the defaults are for the paper's OP2.

    Attributes:
      control_rate: slowest and fastest rate of control, Hz (paper, VI-B).
      substeps: physics steps per control step.
      effort: cost per (N m)² of the servos' torques (paper, VI-A: w_a).
      work: cost per W of the servos' power (w_w).
    """

    control_rate: tuple[float, float] = (25.0, 33.0)
    substeps: int = 8
    effort: float = 0.01
    work: float = 0.005


@dataclass(frozen=True)
class NetworkOptions:
    """The fixed part of the NN-PD actuator; the defaults are those of the paper's authors.

    Attributes:
      error_scale: the network sees error_scale * |target - q| and |qdot|.
      kp_scale: N m/rad at a network output of 1.
      kd_scale: N m s/rad at a network output of 1.
      passive_damping: viscous damping of every joint beside the actuator, N m s/rad.
      armature: rotor inertia of every joint seen at the joint, kg m2.
      weights: the 27 nominal weights phi.
    """

    error_scale: float = 5.0
    kp_scale: float = 200.0
    kd_scale: float = 1.0
    passive_damping: float = 0.515
    armature: float = 0.0
    weights: tuple[float, ...] = (0.0,) * NETWORK_WEIGHTS
