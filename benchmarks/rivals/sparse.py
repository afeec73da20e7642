"""The rival that regresses: SINDy's thresholded least squares on the missing torque.

A dictionary has for each effect what it would add to a joint's torque, as far as that is a function
of what a tick tells; play and give of a gear are not. What a change of the nominal parameters would
add is taken out first. The threshold is the one that predicts types of motion left out best.
"""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.rivals.case import Case, Named, Verdict
from benchmarks.rivals.torques import Seen, seen
from pup.diagnosis.folds import folds
from pup.physics.model import compile_model
from pup.physics.terms import TERMS, Place
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Column = Callable[[Seen, int], Array]

BEND, STRIBECK = 0.01, 0.5
"""Way in which friction turns, rad: at rest it holds as it last did. Speed at which grip at rest
has faded, rad/s."""
SMALL = 0.003
"""Error at which its sign fades, rad."""
LATE, SKEW = 0.01, 0.003
"""Delay, s, and skew of clocks that columns are made for."""
RATES = (1.5, 3.0, 6.0)
"""Speeds of limited goals, rad/s."""
TEETH = (8, 12, 16, 24, 32, 48)
THRESHOLDS = (0.02, 0.03, 0.05, 0.08, 0.12, 0.2, 0.3, 0.5)
"""Of coefficients, for columns and a torque of length 1."""
RIDGE = 1e-3
CERTAIN = 2.0
"""Standard errors by which a law must predict recordings left out better than none."""


def _grip(s: Seen, j: int) -> Array:
    """Direction that dry friction holds against, -1 to 1."""
    moved = np.diff(s.position[:, j])
    kept = np.exp(-np.abs(moved) / BEND)
    grip = np.zeros(len(s.time))
    for row, (share, way) in enumerate(zip(kept, np.sign(moved), strict=True), start=1):
        grip[row] = share * grip[row - 1] + (1 - share) * way
    return grip


def _behind(s: Seen, j: int, time: Array) -> Array:
    """What a command held at other times would add to the proportional part, if all of it acts."""
    rows = np.clip(np.searchsorted(s.time, time, "right") - 1, 0, len(s.time) - 1)
    return np.asarray(s.kp[j] * (s.plan.held[rows, j] - s.plan.held[:, j]) * s.free[:, j])


def _limited(s: Seen, j: int, rate: float) -> Array:
    """The same for a goal that follows the command at a limited speed."""
    goal = s.plan.held[:, j].copy()
    for row in range(1, len(goal)):
        reach = rate * (s.time[row] - s.time[row - 1])
        goal[row] = goal[row - 1] + np.clip(s.plan.held[row - 1, j] - goal[row - 1], -reach, reach)
    return np.asarray(s.kp[j] * (goal - s.plan.held[:, j]) * s.free[:, j])


def _summed(s: Seen, j: int) -> Array:
    return np.cumsum(s.error[:, j] * np.gradient(s.time))


def _beyond(s: Seen, j: int, side: float) -> Array:
    """How far a joint is beyond the last few hundredths of where it has been."""
    end = np.quantile(side * s.position[:, j], 0.97)
    return -side * np.maximum(side * s.position[:, j] - end, 0.0)


DICTIONARY: tuple[tuple[str, Column], ...] = (
    ("coulomb_friction", _grip),
    ("stribeck_friction", lambda s, j: _grip(s, j) * np.exp(-np.abs(s.velocity[:, j]) / STRIBECK)),
    ("load_dependent_friction", lambda s, j: _grip(s, j) * np.abs(s.torque[:, j])),
    ("quadratic_damping", lambda s, j: s.velocity[:, j] * np.abs(s.velocity[:, j])),
    (
        "torque_speed_limit",
        lambda s, j: (1 - s.free[:, j]) * np.sign(s.torque[:, j]) * np.abs(s.velocity[:, j]),
    ),
    ("friction_asymmetry", lambda s, j: np.abs(s.velocity[:, j])),
    ("voltage_sag", lambda s, j: s.torque[:, j] * np.abs(s.torque).sum(axis=1)),
    ("thermal_drift", lambda s, j: s.torque[:, j] * s.time),
    ("actuator_lag", lambda s, j: np.gradient(s.torque[:, j], s.time)),
    ("command_delay", lambda s, j: _behind(s, j, s.time - LATE)),
    ("clock_skew", lambda s, j: _behind(s, j, s.time * (1 + SKEW))),
    *(("target_rate_limit", lambda s, j, r=r: _limited(s, j, r)) for r in RATES),
    ("dead_band", lambda s, j: s.free[:, j] * np.tanh(s.error[:, j] / SMALL)),
    ("gain_asymmetry", lambda s, j: s.free[:, j] * np.abs(s.error[:, j])),
    ("integral_action", _summed),
    ("encoder_bias", lambda s, j: s.free[:, j]),
    ("com_offset", lambda s, j: s.turning[:, j]),
    ("payload", lambda s, j: s.gravity[:, j]),
    ("joint_spring", lambda s, j: s.position[:, j]),
    *(("joint_stop", lambda s, j, side=side: _beyond(s, j, side)) for side in (-1.0, 1.0)),
    *(
        ("cogging", lambda s, j, n=n, f=f: f(n * s.position[:, j]))
        for n in TEETH
        for f in (np.sin, np.cos)
    ),
)
NUISANCES: tuple[Column, ...] = (
    lambda s, j: s.free[:, j] * s.error[:, j],
    lambda s, j: s.free[:, j] * s.velocity[:, j],
    lambda s, j: (1 - s.free[:, j]) * np.sign(s.torque[:, j]),
    lambda s, j: s.acceleration[:, j],
)
"""What other gains, another limit and another armature would add."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A joint's regression.

    Attributes:
      columns: of the dictionary, shape (n, n_columns).
      known: of the nominal parameters, shape (n, n_nuisances).
      target: the missing torque, shape (n,), N m.
      recording: which recording a row is of, shape (n,).
    """

    columns: Array
    known: Array
    target: Array
    recording: NDArray[np.int64]

    @classmethod
    def of(cls, every: Sequence[Seen], joint: int) -> "Problem":
        """That of one joint."""

        def stacked(columns: Sequence[Column]) -> Array:
            told = [np.stack([c(s, joint) for c in columns], axis=1)[s.usable] for s in every]
            return np.concatenate(told)

        return cls(
            stacked([column for _, column in DICTIONARY]),
            stacked(NUISANCES),
            np.concatenate([s.missing[s.usable, joint] for s in every]),
            np.concatenate([np.full(int(s.usable.sum()), i) for i, s in enumerate(every)]),
        )

    def rows(self, inside: NDArray[np.bool_]) -> "Problem":
        """Some of the rows."""
        return Problem(
            self.columns[inside], self.known[inside], self.target[inside], self.recording[inside]
        )

    def weights(self, threshold: float) -> Array:
        """Contributions of the columns, in the length of what the nuisances leave."""
        from pysindy import STLSQ  # of the benchmarks' extra

        basis = np.linalg.qr(self.known)[0]
        left = self.columns - basis @ (basis.T @ self.columns)
        target = self.target - basis @ (basis.T @ self.target)
        lengths = np.linalg.norm(left, axis=0)
        shown = lengths > 1e-3 * np.maximum(np.linalg.norm(self.columns, axis=0), 1e-12)
        units = np.where(shown, left / np.maximum(lengths, 1e-300), 0.0)
        scaled = target[:, None] / max(float(np.linalg.norm(target)), 1e-300)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it tells when it has kept no column
            return np.asarray(STLSQ(threshold, RIDGE).fit(units, scaled).coef_[0])

    def squares(self, kept: NDArray[np.bool_], other: "Problem") -> Array:
        """Squared errors of another problem's rows by the kept columns fitted to this one."""
        own, others = (np.hstack([p.known, p.columns[:, kept]]) for p in (self, other))
        weights = np.linalg.lstsq(own, self.target, rcond=1e-8)[0]
        return np.asarray((other.target - others @ weights) ** 2)


def sparse(case: Case) -> Verdict:
    """Name the largest terms of the joint whose law predicts recordings left out best."""
    every = seen(case)
    parts, joints = folds(case.replays), range(len(case.robot.joints))
    laws = [_law(Problem.of(every, joint), parts) for joint in joints]
    best = int(np.argmax([surprise for surprise, _ in laws]))
    surprise, weights = laws[best]
    squares: dict[str, float] = {}
    for (effect, _), weight in zip(DICTIONARY, weights, strict=True):
        squares[effect] = squares.get(effect, 0.0) + float(weight) ** 2
    whole = sum(squares.values())
    if surprise < CERTAIN or not whole:
        return Verdict(mismatch=False)
    named = [
        Named(effect, _place(case.robot, effect, best), square / whole)
        for effect, square in sorted(squares.items(), key=lambda told: -told[1])
        if square > 0
    ]
    return Verdict(True, tuple(named))


def _law(problem: Problem, left_out: Sequence[Sequence[int]]) -> tuple[float, Array]:
    """By how many standard errors a joint's best law predicts better than none, and the law."""
    gains = {threshold: _gain(problem, left_out, threshold) for threshold in THRESHOLDS}
    best = max(gains, key=lambda threshold: float(gains[threshold].sum()))
    gain = gains[best]
    error = float(gain.std(ddof=1)) / np.sqrt(len(gain)) if len(gain) > 1 else np.inf
    surprise = float(gain.mean()) / max(error, 1e-300)
    return surprise, problem.weights(best)


def _gain(problem: Problem, left_out: Sequence[Sequence[int]], threshold: float) -> Array:
    """By how much a law lowers the squared errors of each recording, left out with its type."""
    gains = np.zeros(int(problem.recording.max()) + 1)
    for fold in left_out:
        inside = np.isin(problem.recording, fold)
        train, test = problem.rows(~inside), problem.rows(inside)
        kept = train.weights(threshold) != 0
        none = np.zeros_like(kept)
        gain = train.squares(none, test) - train.squares(kept, test)
        gains += np.bincount(test.recording, gain, minlength=len(gains))
    return gains


def _place(robot: RobotDescription, effect: str, joint: int) -> Place:
    """Where an effect at a joint acts, by the library's places."""
    kinds, name = TERMS[effect].kinds, robot.joint_names[joint]
    if "joint" in kinds:
        return Place("joint", name)
    if "body" in kinds:
        model = compile_model(robot, "suspended" if robot.floating else "bench").compiled
        return Place("body", model.body(int(model.joint(name).bodyid[0])).name)
    return Place(kinds[0])
