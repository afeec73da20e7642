"""What a virtual robot is like: everything about its physics that a seed decides.

The middle of each range is what is known of the real robot: the MX-28's data sheet, fits of its
suspended step tests and measurements of its sister models (Rhoban's BAM); how far robots of one
kind lie apart is an estimate. Nobody who controls the robot reads any of this.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Motors:
    """The servos' mechanics and electronics, each of shape (n_joints,) or one for all.

    Attributes:
      gain: duty that the firmware gives for 1 rad of error at a P of 1 (Protocol 1.0).
      damping: share of the D gain that survives its filter.
      stall: torque of full duty at 12 V, N m.
      free_speed: at which back-EMF leaves nothing of full duty at 12 V, rad/s.
      current: drawn at stall, A.
      clip: the most duty that the firmware gives.
      dry: friction of the gear at rest, N m.
      kinetic: share of it that is left in motion.
      stribeck: speed over which it falls, rad/s.
      loaded: friction per torque transmitted.
      viscous: N m s/rad.
      give: way before dry friction slips, rad.
      rotor: inertia of the rotor seen at the joint, kg m2.
      play: half the backlash, rad.
      bias: error of the encoder's zero, rad.
      latency: from a command's arrival to its first effect, s.
      warmth: rise of the winding per W over the case, K.
    """

    gain: Array
    damping: float
    stall: Array
    free_speed: Array
    current: float
    clip: float
    dry: Array
    kinetic: float
    stribeck: float
    loaded: float
    viscous: float
    give: float
    rotor: Array
    play: Array
    bias: Array
    latency: float
    warmth: float


@dataclass(frozen=True)
class Supply:
    """A battery of three cells.

    Attributes:
      charge: of it at the start, 0 to 1.
      capacity: A h.
      resistance: of battery, switch and cables, ohm.
    """

    charge: float
    capacity: float
    resistance: float


@dataclass(frozen=True, eq=False)
class Body:
    """What the robot weighs and where.

    Attributes:
      masses: factor of every link's mass and inertia, shape (n_bodies,), the world's first.
      shift: of the torso's centre of mass, m, shape (3,).
      payload: at the torso's centre of mass, kg.
    """

    masses: Array
    shift: Array
    payload: float


@dataclass(frozen=True, eq=False)
class Mat:
    """What it stands on: a soft exercise mat on a board.

    Attributes:
      friction: sliding coefficient.
      time: constant of the contact, s; the description's floor, a hard one, has 0.02 s.
      damping: ratio of the contact.
      tilt: slopes of the floor along x and y, rad.
    """

    friction: float
    time: float
    damping: float
    tilt: Array


@dataclass(frozen=True, eq=False)
class Imu:
    """How the IMU sits and errs.

    Attributes:
      mount: rotation of the chip against where it should sit, rad, shape (3,), about the torso's
        axes.
      delay: of its fusion, s.
      noise: of a reading of the orientation, rad.
      rate_noise: of the gyroscope, rad/s.
      rate_bias: rad/s, shape (3,).
    """

    mount: Array
    delay: float
    noise: float
    rate_noise: float
    rate_bias: Array


@dataclass(frozen=True, eq=False)
class Character:
    """One robot among all of its kind.

    Attributes:
      seed: that it was drawn from.
      motors: its servos.
      supply: its battery.
      body: its masses.
      mat: what it stands on.
      imu: its orientation sensor.
    """

    seed: int
    motors: Motors
    supply: Supply
    body: Body
    mat: Mat
    imu: Imu


def draw(seed: int, joints: int, bodies: int) -> Character:
    """Draw a robot.

    Args:
      seed: the same one gives the same robot.
      joints: how many servos it has.
      bodies: how many bodies its model has, with the world.
    """
    rng = np.random.default_rng((seed, 0x0B07))
    return Character(
        seed=seed,
        motors=_motors(rng, joints),
        supply=Supply(
            charge=rng.uniform(0.6, 1.0),
            capacity=rng.uniform(1.5, 1.9),
            resistance=rng.uniform(0.08, 0.25),
        ),
        body=_body(rng, bodies),
        mat=Mat(
            friction=rng.uniform(0.5, 1.0),
            time=rng.uniform(0.035, 0.06),
            damping=rng.uniform(0.7, 1.2),
            tilt=rng.normal(0.0, 0.004, 2),
        ),
        imu=Imu(
            mount=rng.normal(0.0, 0.03, 3),
            delay=rng.uniform(0.01, 0.025),
            noise=rng.uniform(0.002, 0.006),
            rate_noise=rng.uniform(0.004, 0.01),
            rate_bias=rng.normal(0.0, 0.01, 3),
        ),
    )


def _motors(rng: np.random.Generator, joints: int) -> Motors:
    def spread(middle: float, common: float, each: float) -> Array:
        """Around the middle, by a factor of the robot and one of each servo."""
        of_robot = np.exp(rng.normal(0.0, common))
        of_servos = np.exp(rng.normal(0.0, each, joints))
        return np.asarray(middle * of_robot * of_servos)

    return Motors(
        gain=spread(0.185, 0.08, 0.03),
        damping=rng.uniform(0.4, 0.9),
        stall=spread(2.35, 0.06, 0.04),
        free_speed=spread(3.95, 0.05, 0.03),
        current=rng.uniform(1.3, 1.5),
        clip=rng.uniform(0.94, 0.98),
        dry=spread(0.055, 0.25, 0.25),
        kinetic=rng.uniform(0.6, 0.9),
        stribeck=rng.uniform(0.05, 0.2),
        loaded=rng.uniform(0.02, 0.10),
        viscous=rng.uniform(0.0, 0.04),
        give=rng.uniform(0.001, 0.003),
        rotor=spread(0.0018, 0.12, 0.02),
        play=spread(np.radians(0.33) / 2, 0.2, 0.2),
        bias=rng.normal(0.0, 0.008, joints),
        latency=rng.uniform(0.001, 0.008),
        warmth=rng.uniform(5.0, 9.0),
    )


def _body(rng: np.random.Generator, bodies: int) -> Body:
    return Body(
        masses=np.exp(rng.normal(0.0, 0.04, bodies)),
        shift=rng.normal(0.0, (0.008, 0.003, 0.008)),
        payload=rng.uniform(0.0, 0.15),
    )
