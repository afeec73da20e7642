"""What a policy begins with: the gait pattern that a search found, learnt by imitation.

Both see the robots of the task and its noise alone, nothing that a training without them would not;
but the search has an objective of its own, and the gait's phase leads the pattern.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from pup.locomotion.evaluation import Walks, evaluate
from pup.locomotion.pattern import TURN, Patterns, PatternSpace
from pup.locomotion.start import torso_height
from pup.locomotion.task import Observation, WalkingTask
from pup.policy.imitation import Imitation
from pup.policy.network import ProjectedPolicy, draw
from pup.robot import RobotDescription
from pup.sysid.fit import CmaFit, FitSettings

Array = NDArray[np.float64]
MakeTask = Callable[[int, int, float], WalkingTask]
"""Makes a task of so many simulations, from a seed, with a horizon in s."""

SEARCH = 2
"""Raised with every change of what a search's losses depend on that `identity` does not tell."""

POPULATION = 20
ROBOTS = 4
"""That each candidate walks on, drawn anew in every generation."""
HORIZON = 7.0
"""Of a candidate's walks, s: half an episode tells what a whole one would, in half the time."""
SIGMA = 0.06
"""First step of the search, on the unit cube."""
FALL, STRAY = 1.0, 0.3
"""What a walk of the paper's robot costs that ends at once, m, and a metre aside any robot's.

By the task's reward to stand for a second is worth as much as half a metre: a search for it learns
to stand first, and sideways has come half as far after as many generations.
"""
HEIGHT = 0.2787
"""Of the torso of the paper's robot, m. A fall forward comes about as far: a tall robot's would pay
more than standing, and a small one would not risk any for all the way that it can come."""
FINALISTS = 10
"""Last generations whose best candidates walk again: one lucky walk is no gait."""
JUDGES = 32
"""Robots that these walk on."""
PUPILS = 256
"""Simulations of the imitation."""
ROUNDS, STEPS, EPOCHS = 4, 240, 5
"""Of the imitation: rounds, control steps of each, and passes over what was shown so far."""


@dataclass(frozen=True)
class Generation:
    """What a generation of a search came to, means over the best candidate's walks.

    Attributes:
      index: from 1.
      distance: m, within HORIZON.
      time: before a fall, s.
    """

    index: int
    distance: float
    time: float


class PatternSearch:
    """CMA-ES over the patterns of a robot, for the way that they come.

    The search is a function of seed, task and the losses it was told: these are all that one which
    goes on needs.

    Args:
      space: of the patterns.
      make: makes the tasks that candidates walk in.
      seed: of everything random.

    Attributes:
      fall: what a walk of this robot costs that ends at once, m.
    """

    def __init__(self, space: PatternSpace, make: MakeTask, seed: int) -> None:
        self.space, self.make, self.seed = space, make, seed
        start = np.full(space.dimension, 0.5)
        self.fall = FALL * _size(space.robot)
        self._fit = CmaFit(FitSettings(start, SIGMA, POPULATION, seed=seed))
        self.losses: list[Array] = []
        self._best: list[Array] = []

    @property
    def identity(self) -> str:
        """Of what the losses depend on beside the tasks: another search's are of no use."""
        return f"{SEARCH} {self._fit.identity} {ROBOTS} {HORIZON} {self.fall} {STRAY} {TURN}"

    def resume(self, losses: Array) -> None:
        """Go on after generations whose losses are known, shape (n_generations, POPULATION)."""
        for told in losses:
            self._tell(self._fit.ask(), told)

    def generation(self) -> Generation:
        """Walk a generation."""
        asked, index = self._fit.ask(), len(self.losses) + 1
        walks = self._walk(asked, ROBOTS, index)
        losses = _losses(walks, ROBOTS, self.fall)
        self._tell(asked, losses)
        first = ROBOTS * int(losses.argmin())
        best = walks.of(slice(first, first + ROBOTS))
        return Generation(index, float(best.distance.mean()), float(best.time.mean()))

    def chosen(self) -> tuple[Patterns, Walks]:
        """Of the last generations' best patterns the one best on many robots, and its walks."""
        finalists = np.stack(self._best[-FINALISTS:])
        walks = self._walk(finalists, JUDGES, 0)
        best = int(_losses(walks, JUDGES, self.fall).argmin())
        rows = slice(best * JUDGES, (best + 1) * JUDGES)
        return self.space.patterns(finalists[best : best + 1]), walks.of(rows)

    def _tell(self, asked: Array, losses: Array) -> None:
        self._fit.tell(losses)
        self.losses.append(losses)
        self._best.append(asked[int(losses.argmin())])

    def _walk(self, asked: Array, robots: int, index: int) -> Walks:
        seed = int(np.random.SeedSequence((self.seed, index)).generate_state(1)[0])
        task = self.make(len(asked) * robots, seed, HORIZON)
        patterns = self.space.patterns(asked).repeated(robots)
        return evaluate(lambda seen, _: taught(patterns, task, seen), task)


def _size(robot: RobotDescription) -> float:
    """Height of a robot's torso over that of the paper's, to two digits: more mean nothing."""
    return float(f"{torso_height(robot) / HEIGHT:.2g}")


def _losses(walks: Walks, robots: int, fall: float) -> Array:
    """What the search minimises, a value per pattern, m: the mean over its robots."""
    lost = 1 - walks.time / HORIZON
    each = fall * lost + STRAY * np.abs(walks.aside) - walks.distance
    return np.asarray(each.reshape(-1, robots).mean(axis=1))


def taught(patterns: Patterns, task: WalkingTask, seen: NDArray[np.float32]) -> Array:
    """What patterns do where a task is, shape (n, n_joints); `seen` is its proprioception."""
    turned = (seen[:, -4:-2] - seen[:, -2:]).astype(np.float64) * task.settings.tempo
    return patterns.bins(task.phase(), turned, task.bins)


def imitate(
    policy: ProjectedPolicy,
    pattern: Patterns,
    task: WalkingTask,
    seed: int,
    told: Callable[[int], None],
) -> None:
    """Let a policy learn a pattern, in states that it comes to itself.

    In the first round the teacher acts; then the pupil does, exploring, and is told what the
    teacher would have done. The gait's phase leads the teacher; the pupil has to see it in the
    joints.

    Args:
      policy: the pupil.
      pattern: one.
      task: of several simulations.
      seed: of everything random beside the task.
      told: the rounds that are done.
    """
    teacher = pattern.repeated(task.n)
    own, exploring = np.random.SeedSequence(seed).spawn(2)  # the task may have the seed itself
    lessons, rng = Imitation(policy, own), np.random.default_rng(exploring)
    seen = task.reset()
    for turn in range(ROUNDS):
        for _ in range(STEPS):
            wanted = taught(teacher, task, seen.proprioception)
            lessons.show(seen.proprioception, seen.parameters, wanted)
            seen = task.step(wanted if turn == 0 else _explored(policy, seen, rng)).observation
        lessons.learn(EPOCHS)
        told(turn + 1)


def _explored(
    policy: ProjectedPolicy, seen: Observation, rng: np.random.Generator
) -> NDArray[np.int64]:
    with torch.no_grad():
        logits = policy(torch.from_numpy(seen.proprioception), torch.from_numpy(seen.parameters))
    uniform = rng.random((logits.shape[0], logits.shape[-1]), dtype=np.float32)
    bins, _ = draw(logits, torch.from_numpy(uniform))
    return np.asarray(bins.numpy())
