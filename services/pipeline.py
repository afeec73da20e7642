"""`pup run`: the whole job, stage by stage, each a call a user could make alone."""

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import sha256
from pup.policy.bundle import CARD, GRAPH, WEIGHTS, read_bundle
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription
from pup.sysid.result import read_bounds
from services.presysid import Options, Progress, identify
from services.replay import replay
from services.stages import Journal, Stage, content
from workers.fits import Runner

SHIPPED = "recordings"
"""Folder of a built-in robot with recordings of our own, from virtual robot 0."""
POLICIES = "policies"
"""Folder of a built-in robot with a bundle for each direction."""
DIRECTION = "forward"
BOUNDS, POLICY = "presysid/bounds.json", "train/policy"
STEPS = 300_000
"""Of the training unless told otherwise: a minute and a half at 3,700 a second."""
TRIALS = 25
"""Walks until eta is chosen (paper)."""
FURTHER_RATE = 2e-4
"""Adam's, where a policy that walks is trained further: the usual one would undo its gait."""
EPISODES = 50


@dataclass(frozen=True)
class Mission:
    """What a job does.

    Attributes:
      presysid: budget of its fits.
      steps: of the training; 0 leaves it out; None for STEPS where the robot has a gait.
      trials: walks until eta is chosen; 0 leaves them out; None for TRIALS where the robot has a
        gait and servos.
      repeats: walks of the chosen eta and of the fitted one.
    """

    presysid: Options
    steps: int | None = None
    trials: int | None = None
    repeats: int = 5


@dataclass(frozen=True)
class Means:
    """Where a job works and whom it tells.

    Attributes:
      fits: opens where fits run.
      ray: connects to the Ray of the training, and gives the cores there are.
      progress: opens what is told how far fits are.
      trained: opens what is told how far the training is.
      told: hears how far the trials are.
      threads: cores for what runs in this process.
    """

    fits: Callable[[], AbstractContextManager[Runner]]
    ray: Callable[[], AbstractContextManager[int]]
    progress: Callable[[], AbstractContextManager[Progress]]
    trained: Callable[[], AbstractContextManager[Callable[[dict[str, Any], int], None]]]
    told: Callable[[str], None]
    threads: int


def run(
    robot: RobotDescription,
    recordings: Sequence[Recording],
    mission: Mission,
    out: Path,
    means: Means,
) -> dict[str, Any]:
    """Run the job; stages whose inputs and files have not changed since are kept.

    Args:
      robot: the robot.
      recordings: of that robot.
      mission: what is done.
      out: folder of the job; a stage that was interrupted resumes in it.
      means: where it works.

    Returns:
      The document of each stage, `left_out` with the stages that were and why, and `took` with the
      seconds of the others.

    Raises:
      InputError: a stage cannot be done so.
    """
    return _Job(robot, recordings, mission, out, means).run()


class _Job:
    def __init__(
        self,
        robot: RobotDescription,
        recordings: Sequence[Recording],
        mission: Mission,
        out: Path,
        means: Means,
    ) -> None:
        self.robot, self.recordings, self.out, self.means = robot, recordings, out, means
        self.options, self.repeats = mission.presysid, mission.repeats
        self.shipped = robot.folder / POLICIES / DIRECTION
        self.left_out: dict[str, str] = {}
        self.steps = self._wanted("train", mission.steps, STEPS, self._no_training())
        self.trials = self._wanted("transfer", mission.trials, TRIALS, self._no_trials())
        self.journal = Journal(out)

    def run(self) -> dict[str, Any]:
        documents: dict[str, Any] = {}
        for make in (self._presysid, self._replay, self._train, self._walk, self._transfer):
            stage = make()
            if stage is not None:
                self.journal.once(stage)
                documents[stage.name] = content(self.out, stage.files[0])
        took = {name: self.journal.done(name).seconds for name in documents}
        self.journal.once(self._report(documents))
        return documents | {"left_out": self.left_out, "took": took}

    def _presysid(self) -> Stage:
        def work() -> None:
            means = self.means
            with means.fits() as fits, means.progress() as progress:
                folder = self.out / "presysid"
                recordings, threads = self.recordings, means.threads
                identify(self.robot, recordings, self.options, folder, fits, progress, threads)

        files = (BOUNDS, "presysid/report.html")
        return Stage("presysid", self._measured() | _told(self.options.told()), files, work)

    def _replay(self) -> Stage:
        def work() -> None:
            bounds, threads = self.out / BOUNDS, self.means.threads
            replay(self.robot, self.recordings, bounds, self.out / "replay", threads)

        inputs = self._measured() | self._hash(BOUNDS)
        return Stage("replay", inputs, ("replay/replay.json",), work)

    def _train(self) -> Stage | None:
        if not self.steps:
            return None
        from services.training import Options as Training
        from services.training import train
        from workers.learner import Learning

        start = self._start()
        options = Training(steps=self.steps, seed=self.options.seed, start=start)
        if start is not None:
            options = replace(options, learning=Learning(rate=FURTHER_RATE))

        def work() -> None:
            with self.means.trained() as told:
                bounds, out = self.out / BOUNDS, self.out / "train"
                train(self.robot, bounds, options, out, self.means.ray, told)

        begun = {} if start is None else {"policy that it starts from": sha256(start / CARD)}
        inputs = self._described() | self._hash(BOUNDS) | begun
        inputs |= _told(asdict(replace(options, start=None)))
        bundle = [f"{POLICY}/{name}" for name in (CARD, WEIGHTS, GRAPH)]
        files = ("train/training.json", *bundle, "train/curve.png")
        return Stage("train", inputs, files, work, folder="train", remade=True)

    def _walk(self) -> Stage | None:
        if not self.steps:
            return None
        from services.walk import Shown, walk

        shown = Shown(
            self.out / POLICY, self.out / BOUNDS, episodes=EPISODES, seed=self.options.seed
        )

        def work() -> None:
            walk(self.robot, shown, self.out / "walk", self.means.threads)

        inputs = self._described() | self._hash(BOUNDS, f"{POLICY}/{CARD}")
        inputs |= {"seed": str(shown.seed)}
        files = ("walk/replay.json", "walk/gait.png", "walk/walk.mp4", "walk/walk.gif")
        return Stage("walk", inputs, files, work, folder="walk")

    def _transfer(self) -> Stage | None:
        if not self.trials:
            return None
        from services.trials import Budget, try_out

        budget = Budget(self.trials, self.repeats, self.options.seed)
        policy = self.out / POLICY if self.steps else self.shipped

        def work() -> None:
            bounds, out = self.out / BOUNDS, self.out / "transfer"
            try_out(self.robot, policy, bounds, budget, out, self.means.told)

        used = {"policy": sha256(policy / CARD)} | self._described() | self._hash(BOUNDS)
        files = ("transfer/transfer.json", "transfer/study.json")
        return Stage("transfer", used | _told(asdict(budget)), files, work, folder="transfer")

    def _report(self, documents: Mapping[str, Any]) -> Stage:
        from services.job_report import Job, write_report

        done = {name: self.journal.done(name) for name in documents}
        job = Job(self.robot.name, self.out, documents, done, self.left_out)
        inputs = {name: digest for stage in done.values() for name, digest in stage.files.items()}
        return Stage("report", inputs, ("report.html",), lambda: write_report(job))

    def _wanted(self, stage: str, given: int | None, usual: int, why_not: str) -> int:
        """How much of a stage is done; refused where it cannot be and was asked for."""
        if given and why_not:
            option = {"train": "--train-steps", "transfer": "--trials"}[stage]
            raise InputError(f"{option}: {why_not}; leave the stage out with {option} 0")
        if given == 0 or why_not:
            self.left_out[stage] = why_not or "as told"
            return 0
        return given or usual

    def _no_training(self) -> str:
        """Why this robot cannot be trained; empty where it can."""
        if self.robot.gait is None:
            return f"robot {self.robot.name!r} has no gait to train"
        if find_spec("torch") is None or find_spec("gymnasium") is None:
            return "PyTorch and RLlib are not installed (the extra `learn`)"
        return ""

    def _no_trials(self) -> str:
        """Why there can be no trials; empty where there can."""
        if self.robot.gait is None or not (self.steps or (self.shipped / CARD).is_file()):
            return "there is no policy to walk with"
        if any(joint.servo_id is None for joint in self.robot.joints):
            return f"robot {self.robot.name!r} has joints without servos"
        if any(find_spec(name) is None for name in ("fastapi", "botorch", "httpx")):
            return "the service is not installed (the extra `service`)"
        return ""

    def _start(self) -> Path | None:
        """The shipped policy, if there is one of the parameters that were found."""
        if not (self.shipped / CARD).is_file():
            return None
        card, _ = read_bundle(self.shipped, self.robot)
        same = card.parameters == read_bounds(self.out / BOUNDS, self.robot).names
        return self.shipped if same and card.method == "pup" else None

    def _described(self) -> dict[str, str]:
        return {f"robot {self.robot.name}": self.robot.digest}

    def _measured(self) -> dict[str, str]:
        return self._described() | {f"recording {r.id}": r.digest for r in self.recordings}

    def _hash(self, *names: str) -> dict[str, str]:
        return {name: sha256(self.out / name) for name in names}


def _told(options: Mapping[str, Any]) -> dict[str, str]:
    """Options as the journal has them."""
    return {"options": json.dumps(options, sort_keys=True, default=str)}


def default_recordings(robot: RobotDescription) -> tuple[Recording, ...]:
    """The recordings that come with a robot.

    Raises:
      InputError: none come with it.
    """
    folder = robot.folder / SHIPPED
    if not folder.is_dir():
        raise InputError(
            f"robot {robot.name!r} comes without recordings; give some with --recordings DIR"
        )
    return load_recordings([folder], robot)
