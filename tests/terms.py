"""Replays of terms for their tests, and one joint solved by an integrator of its own."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from test_simulator import recording

from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import Candidates, ParameterSpace, robot_space
from pup.physics.simulator import Trajectories
from pup.physics.terms import TERMS, Place, column, split_column, term_space
from pup.recording import Recording
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Row = Mapping[str, float]

BENCH = RobotDescription.load("servo_bench")
LEG = RobotDescription.load("darwin_leg")
OP2 = RobotDescription.load("darwin_op2")

G = 9.81
SERVO = {"kp/servo": 6.0, "kd/servo": 0.25, "tau_max/servo": 1.2, "armature": 0.003}
"""A servo for the bench that damps its load well."""
KP, KD, LIMIT = SERVO["kp/servo"], SERVO["kd/servo"], SERVO["tau_max/servo"]
AT = "@joint:servo"
STEP = BENCH.timestep
FREE = 1.3e-6 + SERVO["armature"]  # kg m², without the load
LEVER = 0.3247 * 0.1  # kg m, of the bench's load
INERTIA = LEVER * 0.1 + 1.1e-6 + SERVO["armature"]
LIGHT = {"mass": 0.001, "length": 0.01}
"""Setup of the bench with next to no load: the armature is all there is to move."""


def with_terms(robot: RobotDescription, rows: Sequence[Row], actuator: str = "pd") -> Candidates:
    """Candidates of a robot's space and of whatever terms the rows name."""
    space = robot_space(robot, actuator)
    places: dict[tuple[str, Place], None] = {}
    for row in rows:
        for name in row:
            told = split_column(name)
            if told is not None:
                places[told[0], told[2]] = None
    for effect, place in places:
        space = space.plus(term_space(effect, place))
    return space.candidates(np.stack([_nominal(space, row) for row in rows]))


def _nominal(space: ParameterSpace, row: Row) -> Array:
    assert set(row) <= set(space.names), set(row) - set(space.names)
    return space.at(row).nominal


def play(
    robot: RobotDescription,
    runs: Recording | Sequence[Recording],
    rows: Sequence[Row],
    actuator: str = "pd",
) -> Trajectories:
    """Replay recordings under several candidates at once."""
    given = [runs] if isinstance(runs, Recording) else runs
    return MujocoSimulator(robot, given, actuator).replay(with_terms(robot, rows, actuator))


def bench(run: Recording, *rows: Row) -> Array:
    """Positions of the bench's servo under each row's terms, (n_rows, n_ticks), rad."""
    return play(BENCH, run, [SERVO | dict(row) for row in rows]).position[:, :, 0]


def held(
    angle: float, seconds: float = 3.0, start: float | None = None, **more: object
) -> Recording:
    """The bench's servo holding one target."""
    time = np.arange(0, seconds, 0.02)
    return recording(
        BENCH, time, np.full(len(time), angle), angle if start is None else start, **more
    )


def ramp(speed: float, start: float, seconds: float, **more: object) -> Recording:
    """The bench's servo following a target of constant speed, told at every sub-step."""
    time = np.arange(0, seconds, BENCH.timestep)
    return recording(BENCH, time, start + speed * time, start, **more)


def steps(robot: RobotDescription, middle: Array, seconds: float, support: str) -> Recording:
    """Steps of up to 0.3 rad on a slow sine, at ticks of 25 to 33 Hz, all joints at once."""
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(1 / 33, 1 / 25, int(seconds * 28)))
    time -= time[0]
    levels = rng.uniform(-0.3, 0.3, (len(time) // 12 + 1, len(middle)))
    target = middle + np.repeat(levels, 12, axis=0)[: len(time)]
    target += 0.1 * np.sin(9 * time)[:, None]
    return recording(robot, time, target, middle, support)


LEG_POSE = np.array([0.0, -0.4, 0.5, -1.0, -0.3, 0.1])


def sizes(effect: str, place: Place, share: float = 1.0, **shapes: float) -> dict[str, float]:
    """A term at a place, at a share of its typical sizes."""
    row = {
        column(effect, q.name, place): q.typical * (1.0 if q.shape else share)
        for q in TERMS[effect].quantities
    }
    return row | {column(effect, name, place): value for name, value in shapes.items()}


Law = Callable[[float, Array, float], tuple[float, Sequence[float]]]
"""Torque on the link (N m) and rates of further states, of time, state and target."""


def solved(run: Recording, law: Law, *further: float, inertia: float = INERTIA) -> Array:
    """One joint by a stiff integrator with small steps: positions at the ticks, rad.

    Args:
      run: its commands and its first position.
      law: all torques on the link but its inertia.
      further: states behind position and velocity, at the start.
      inertia: of the link, kg m².
    """
    state = np.array([run.position[0, 0], 0.0, *further])
    seen = [state[0]]
    for k in range(len(run.time) - 1):
        target = float(run.target[k, 0])

        def rates(t: float, x: Array, target: float = target) -> list[float]:
            torque, more = law(t, x, target)
            return [x[1], torque / inertia, *more]

        span = (run.time[k], run.time[k + 1])
        told = solve_ivp(rates, span, state, "LSODA", rtol=1e-7, atol=1e-9, max_step=0.02)
        state = told.y[:, -1]
        seen.append(state[0])
    return np.array(seen)


def servo(error: float, velocity: float, limit: float = SERVO["tau_max/servo"]) -> float:
    """The bench's PD law, N m."""
    torque = SERVO["kp/servo"] * error - SERVO["kd/servo"] * velocity
    return float(np.clip(torque, -limit, limit))


def weight(position: float) -> float:
    """Torque of gravity on the bench's load, N m."""
    return float(-LEVER * G * np.sin(position))
