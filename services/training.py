"""The training job: bounds in, a policy that walks out (paper, sections IV and VI)."""

import hashlib
import json
import math
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.errors import InputError
from pup.files import sha256, write_json
from pup.locomotion.engines import check_size
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.standing import check_start
from pup.locomotion.task import WalkingTask
from pup.physics.engine import Engine
from pup.policy.bundle import CARD, NumpyPolicy, PolicyCard, Weights, read_bundle, write_bundle
from pup.policy.mirror import MirrorMap, unmirrored
from pup.policy.rebase import for_bounds
from pup.policy.shape import Method, PolicyShape
from pup.robot import RobotDescription
from pup.sysid.problem import MODEL
from pup.sysid.result import read_bounds
from services import stopping
from services.checkpoint import Checkpoint
from services.curve import draw_curve, point
from services.failures import FailedError
from services.first_gait import FirstGait, Said, read_gait
from services.provenance import ALSO, engine, now
from services.tracking import Trackers
from services.training_options import Options, task_settings
from workers.ppo import Iteration, Setup, Trainer, runners_before
from workers.rollouts import Sampling
from workers.walking import Walking

CHECKPOINT_SECONDS = 30.0
ROBOTS_A_THREAD = 64
"""Fewer wait longer for each other than they save: 256 robots on 16 cores take 5,000 steps a second
on 16 threads and 8,100 on 4 (docs/results/training.md)."""
GAIT_THREADS = 4
"""Of the few robots that a first gait is searched on."""
MOST_EMPTY, EMPTY_SECONDS = 12, 5.0
"""Iterations in a row for which no runner has sampled, and how long each is waited for: a runner
takes half a minute to start on a busy machine."""
SMOOTHED = 10
"""Iterations whose mean return says which weights were best so far."""
ETAS = 20_000
"""Draws of mu whose projections span eta's box."""

Told = Callable[[dict[str, Any], int], None]
"""Told each iteration's row of the curve, and the steps of the whole training."""


def train(
    robot: RobotDescription,
    bounds: Path | None,
    options: Options,
    out: Path,
    cluster: Callable[[], AbstractContextManager[int]],
    told: Told,
    said: Said = lambda words, share: None,
) -> dict[str, Any]:
    """Train a policy and write its files; a training that was interrupted goes on.

    Args:
      robot: the robot.
      bounds: what pre-sysID wrote; None for the robot's `identified.json`.
      options: what is trained.
      out: folder for `policy/`, `best/`, `training.json`, `curve.png`, `tensorboard/`,
        `checkpoint.npz`, and `pattern.npz` and `pattern.json` of what it begins with.
      cluster: connects to Ray and gives the cores there are.
      told: how far it is.
      said: how far what it begins with is.

    Returns:
      The document of `training.json`.

    Raises:
      InputError: robot, bounds or first policy do not fit, or the folder holds another training.
    """
    return _Job(robot, bounds, options, out, told, said).run(cluster)


class _Job:
    def __init__(
        self,
        robot: RobotDescription,
        bounds: Path | None,
        options: Options,
        out: Path,
        told: Told,
        said: Said,
    ) -> None:
        self.robot, self.options, self.out, self.told, self.said = robot, options, out, told, said
        self.source = bounds or robot.identified_path
        if bounds is None and not self.source.exists():
            raise InputError(
                f"robot {robot.name!r} comes without identified bounds; give some with --bounds"
            )
        self.bounds = read_bounds(self.source, robot)
        self.bounds_sha256 = sha256(self.source)
        self.settings = task_settings(robot, options)
        nominal = options.method == Method.NOMINAL
        check_size(options.engine, options.simulations)
        self.walking = Walking(robot, self.bounds, self.settings, nominal, options.engine)
        task = self.walking(1, 0, 1)
        check_start(robot, ParameterSampler.nominal(self.bounds), self.settings)
        self.shape = PolicyShape.of(
            options.method,
            len(task.observation_names),
            len(task.parameter_names),
            len(task.privileged_names),
            len(task.joints),
            task.bins,
        )
        self.card = self._card(task)
        self.origin: dict[str, Any] | None = None
        self.first = self._first()
        self.learning = replace(
            options.learning,
            iterations=math.ceil(options.steps / self._per_iteration(options.runners)),
            seed=options.seed,
            discount=options.learning.discount ** (1 / self.settings.tempo),
            mirror=self._mirror(task),
        )
        self.kept = Checkpoint(out / "checkpoint.npz", self._digest())
        self.rows, self.lost, self.seconds = self.kept.rows, self.kept.lost, self.kept.seconds
        self.runners_before = runners_before(self.kept.state, options.runners)
        iterations = int(self.kept.state.get("learner/iteration", 0))
        self.asked = iterations * self._per_iteration(self.runners_before)  # steps, lost or not

    def run(self, cluster: Callable[[], AbstractContextManager[int]]) -> dict[str, Any]:
        trackers = Trackers(self.options.track, self.out, len(self.rows), self._told_options())
        if self.asked < self.options.steps:
            with cluster() as cores, trackers:
                self._go_on(cores, trackers)
        document = self._document(done=True)
        draw_curve(self.out / "curve.png", document)
        write_json(self.out / "training.json", document)
        return document

    def _go_on(self, cores: int, trackers: Trackers) -> None:
        setup = self._setup(cores)
        if self.options.pattern and not self.kept.state:
            setup = replace(setup, start=self._gait(cores).weights(self.said))
        with closing(Trainer(setup)) as trainer:
            if self.kept.state:
                trainer.restore(self.kept.state)
                if self.runners_before != self.options.runners:
                    self._with_other_runners()
            written, best = time.monotonic(), self._best()
            found: Weights | None = None
            while self.asked < self.options.steps:
                row = self._iterate(trainer)
                trackers.tell(row, len(self.rows))
                if self._smoothed(len(self.rows)) > best:
                    best, found = self._smoothed(len(self.rows)), trainer.weights()
                due = time.monotonic() - written > CHECKPOINT_SECONDS
                # The last checkpoint tells that all is done: it comes after the policy.
                if due and self.asked < self.options.steps:
                    self._write(trainer, found)
                    written, found = time.monotonic(), None
            self._bundle("policy", trainer.weights())
            self._write(trainer, found)

    def _gait(self, cores: int) -> FirstGait:
        o, threads = self.options, min(cores, GAIT_THREADS)
        told = (MODEL, self.robot.digest, self.bounds_sha256, self.settings, self.walking.nominal)
        digest = hashlib.sha256(repr((*told, o.seed)).encode()).hexdigest()
        return FirstGait(self.walking, self.shape, o.pattern, o.seed, threads, self.out, digest)

    def _iterate(self, trainer: Trainer) -> dict[str, Any]:
        begin = time.monotonic()
        told = self._sampled(trainer)
        self.seconds += time.monotonic() - begin
        row = point(told, self.rows[-1]["steps"] if self.rows else 0, self.seconds)
        self.rows.append(row)
        self.asked += self._per_iteration(self.options.runners)
        self.told(row, self.options.steps)
        return row

    def _with_other_runners(self) -> None:
        """Go on with others than before: by whole iterations of theirs, as the learner does."""
        now, each = self.options.runners, self._per_iteration(self.options.runners)
        self.asked = math.ceil(self.asked / each) * each
        line = f"--runners {now} after {self.runners_before} before: weights will not be to the "
        line += "last bit those of a training that was not stopped"
        print(line, file=sys.stderr, flush=True)

    def _sampled(self, trainer: Trainer) -> Iteration:
        """An iteration that learnt something; runners that are all lost are waited for.

        Raises:
          ConnectionError: they do not come back.
          FailedError: nothing was learnt from what they sampled.
        """
        trouble = ""
        for turn in range(MOST_EMPTY):
            if turn:
                stopping.check()
                time.sleep(EMPTY_SECONDS)
            told = trainer.iterate()
            self.lost += told.lost
            if told.trouble and told.trouble != trouble:
                trouble = told.trouble
                print(f"{told.lost} steps lost: {trouble}", file=sys.stderr, flush=True)
            if told.stuck:
                raise FailedError(
                    f"no gradient of iteration {len(self.rows) + 1} was finite, so that nothing is "
                    "learnt any more; begin again in another --out with a lower --learning-rate or "
                    "another --seed"
                )
            if told.steps:
                return told
        raise ConnectionError(
            f"all runners were lost and none came back ({trouble}); the same command resumes, with "
            "fewer --runners too"
        )

    def _write(self, trainer: Trainer, best: Weights | None) -> None:
        """A checkpoint; after the best policy so far, which it does not hold."""
        if best is not None:
            self._bundle("best", best)
        self.kept.write(trainer.state(), self.rows, self.lost, self.seconds)
        write_json(self.out / "training.json", self._document(done=False))

    def _smoothed(self, count: int) -> float:
        told = [row["return"] for row in self.rows[max(0, count - SMOOTHED) : count]]
        known = [value for value in told if value is not None]
        return float(np.mean(known)) if len(told) == SMOOTHED and known else -math.inf

    def _best(self) -> float:
        return max((self._smoothed(i + 1) for i in range(len(self.rows))), default=-math.inf)

    def _bundle(self, name: str, weights: Weights) -> None:
        steps = self.rows[-1]["steps"]
        provenance = {
            "options": self._told_options(),
            "start": self.origin,
            "pattern": read_gait(self.out) if self.options.pattern else None,
            "steps": steps,
            "seconds": round(self.seconds, 1),
            "terms": [asdict(term) for term in self.robot.terms],
            "engine": engine(ALSO),
            "written": now(),
        }
        noise, sampler = self.settings.parameter_noise, ParameterSampler(self.bounds)
        mu = sampler.told(np.random.default_rng(0), ETAS, noise)
        eta = NumpyPolicy(self.card, weights).project(mu)
        card = replace(
            self.card,
            eta_lower=tuple(eta.min(axis=0).tolist()),
            eta_upper=tuple(eta.max(axis=0).tolist()),
            provenance=provenance,
        )
        write_bundle(self.out / name, card, weights)

    def _setup(self, cores: int) -> Setup:
        o = self.options
        if o.runners > cores:
            raise InputError(
                f"--runners {o.runners} on {cores} cores; use at most one for each core"
            )
        share = cores // max(1, o.runners)
        threads = min(share, max(1, o.simulations // ROBOTS_A_THREAD))
        sampling = Sampling(self.walking, o.simulations, o.length, o.seed, threads)
        return Setup(self.shape, sampling, self.learning, o.runners, share, o.seed, self.first)

    def _per_iteration(self, runners: int) -> int:
        return max(1, runners) * self.options.simulations * self.options.length

    def _mirror(self, task: WalkingTask) -> MirrorMap | None:
        wanted = self.options.learning.weights.mirror and self.options.direction.symmetric
        if not wanted or not self.robot.mirrored:
            return None
        if self.shape.eta and (lost := unmirrored(self.robot, task.parameter_names)):
            line = f"mirror loss left out: the bounds hold no mirror image of {', '.join(lost)}"
            print(line, file=sys.stderr, flush=True)
            return None
        names = task.observation_names, task.parameter_names
        return MirrorMap.of(self.robot, *names, bins=task.bins)

    def _first(self) -> dict[str, NDArray[Any]] | None:
        folder = self.options.start
        if folder is None:
            return None
        if folder.resolve() in {(self.out / name).resolve() for name in ("policy", "best")}:
            raise InputError(f"{folder}: would be written over; use another --out, or a copy of it")
        card, weights = read_bundle(folder, self.robot)
        seen = {name: getattr(self.shape, name) for name in ("parameters", "privileged")}
        if card.method != self.card.method or replace(card.shape, **seen) != self.shape:
            raise InputError(
                f"{folder}: a {card.method} policy of other sizes; start from a "
                f"{self.options.method} policy of this robot"
            )
        if "critic.0.weight" not in weights:
            raise InputError(f"{folder}: has no value function; start from what `pup train` wrote")
        self.origin = {
            "policy_sha256": sha256(folder / CARD),
            "bounds_sha256": card.bounds_sha256,
            "other_bounds": card.bounds_sha256 != self.bounds_sha256,
            "other_parameters": card.parameters != self.card.parameters,
            "steps": card.provenance.get("steps"),
        }
        names, lower, upper = self.card.parameters, self.bounds.lower, self.bounds.upper
        course = self.shape.privileged - len(names)
        return dict(for_bounds(card, weights, names, lower, upper, course))

    def _card(self, task: WalkingTask) -> PolicyCard:
        robot, settings = self.robot, self.settings
        assert robot.gait is not None
        nothing = (0.0,) * self.shape.eta
        return PolicyCard(
            robot=robot.name,
            joints=robot.joint_names,
            lower=tuple(joint.lower for joint in robot.joints),
            upper=tuple(joint.upper for joint in robot.joints),
            method=self.options.method,
            direction=settings.direction.value,
            shape=self.shape,
            observation=task.observation_names,
            parameters=task.parameter_names,
            parameter_lower=tuple(self.bounds.lower.tolist()),
            parameter_upper=tuple(self.bounds.upper.tolist()),
            eta_lower=nothing,
            eta_upper=nothing,
            rates=settings.control_rate,
            reach=settings.direction.reach,
            smoothing=settings.smoothing,
            gait=robot.gait,
            bounds_sha256=self.bounds_sha256,
            robot_digest=robot.digest,
            provenance={},
        )

    def _told_options(self) -> dict[str, Any]:
        """The options as JSON values, without what follows from the robot.

        A path to the first policy means nothing elsewhere: `origin` tells which one it was.
        """
        told = asdict(replace(self.options, learning=replace(self.options.learning, mirror=None)))
        del told["learning"]["mirror"], told["start"]
        return dict(json.loads(json.dumps(told, default=str)))

    def _digest(self) -> str:
        """Of all that the weights depend on, but for the runners.

        When a node is lost for good, a training shall go on with fewer.
        """
        told = self._told_options() | {"runners": 0}
        del told["track"]
        if self.options.engine is Engine.MUJOCO:
            del told["engine"]  # as before there were two
        if not self.options.pattern:
            del told["pattern"]  # as before there was one
        first = hashlib.sha256()
        for name, value in (self.first or {}).items():
            first.update(name.encode() + value.tobytes())
        parts = (
            str(MODEL),
            self.robot.digest,
            self.bounds_sha256,
            repr(self.settings),
            repr(told),
            first.hexdigest(),
        )
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()

    def _document(self, done: bool) -> dict[str, Any]:
        # The first rows may be of a pup that told less.
        columns = {name: [row.get(name) for row in self.rows] for name in self.rows[-1]}
        return {
            "schema": 1,
            "robot": self.robot.name,
            "method": self.options.method,
            "direction": self.options.direction,
            "done": done,
            "steps": self.rows[-1]["steps"],
            "lost_steps": self.lost,
            "seconds": round(self.seconds, 1),
            "curve": columns,
            "provenance": {
                "options": self._told_options(),
                "start": self.origin,
                "pattern": read_gait(self.out) if self.options.pattern else None,
                "bounds": str(self.source),
                "bounds_sha256": self.bounds_sha256,
                "robot_digest": self.robot.digest,
                "terms": [asdict(term) for term in self.robot.terms],
                "engine": engine(ALSO),
            },
        }
