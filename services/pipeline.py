"""`pup run`: the whole job, stage by stage, each a call a user could make alone."""

import json
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pup.errors import InputError
from pup.files import sha256
from pup.policy.bundle import CARD, GRAPH, WEIGHTS, read_bundle
from pup.recording import Recording, load_recordings
from pup.recording_cuts import cut
from pup.robot import RobotDescription
from pup.sysid.problem import MODEL
from services.diagnosis import CORRECTED
from services.mission import STEPS, TRIALS, Means, Mission
from services.presysid import identify
from services.presysid_options import Options
from services.replay import replay
from services.stages import Journal, Stage, content

POLICIES = "policies"
"""Folder of a built-in robot with a bundle for each direction."""
DIRECTION = "forward"
ORDER = "presysid", "replay", "train", "walk", "transfer", "rehearsal"
"""Of a half's stages where they are told of."""
BOUNDS, POLICY = "presysid/bounds.json", "train/policy"
STEPS_A_GENERATION = 5000
"""Steps of a training for each generation of the search for the gait that it begins with: a short
training takes a short search."""
EPISODES = 50
DIAGNOSIS = "diagnosis"
"""Stage, and folder, between the two halves of a job."""
ROLLOUTS, ROLLOUT_SECONDS = 2, 2.0
"""Walks of the first trials that are diagnosed beside the recordings, from the start of each."""


@dataclass(frozen=True)
class Half:
    """One half of a job: what is done with a robot as described, or as it was found to be.

    Attributes:
      robot: that is simulated.
      options: of its pre-sysID.
      name: of the half, before those of its stages; empty for the first.
    """

    robot: RobotDescription
    options: Options
    name: str = ""

    def stage(self, name: str) -> str:
        """What the half calls a stage."""
        return f"{self.name}-{name}" if self.name else name

    def at(self, name: str) -> str:
        """Where the half has a file or folder, relative to the job's folder."""
        return f"{self.name}/{name}" if self.name else name


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
        self.mission, self.first = mission, Half(robot, mission.presysid)
        self.shipped = robot.folder / POLICIES / DIRECTION
        self.left_out: dict[str, str] = {}
        self.steps = self._wanted("train", mission.steps, STEPS, self._no_training())
        self.trials = self._wanted("transfer", mission.trials, TRIALS, self._no_trials())
        self.journal = Journal(out)
        self.documents: dict[str, Any] = {}

    def run(self) -> dict[str, Any]:
        self._do_half(self.first)
        if second := self._corrected():
            self._do_half(second)
        took = {name: self.journal.done(name).seconds for name in self.documents}
        self.journal.once(self._report(self.documents))
        return self.documents | {"left_out": self.left_out, "took": took}

    def _do_half(self, half: Half) -> None:
        """The stages of a half; pictures are drawn while the trials leave a core without work."""
        done: dict[str, Any] = {}
        for make in (self._presysid, self._train):
            self._do(make(half), done)
        with ThreadPoolExecutor(1, initializer=_step_back) as aside:
            shown = (self._replay, self._walk)
            drawn = [aside.submit(self._do, make(half), done) for make in shown]
            self._do(self._transfer(half), done)
            self._do(self._rehearsal(half), done)
            for picture in drawn:
                picture.result()
        self.documents |= {name: done[name] for name in map(half.stage, ORDER) if name in done}

    def _do(self, stage: Stage | None, done: dict[str, Any]) -> None:
        if stage is None:
            return
        self.journal.once(stage)
        done[stage.name] = content(self.out, stage.files[0])

    def _corrected(self) -> Half | None:
        """The second half of the job, if the diagnosis found what is to be corrected."""
        if not self.mission.effects:
            self.left_out[DIAGNOSIS] = "as told"
            return None
        self._do(self._diagnosis(), self.documents)
        told = self.documents[DIAGNOSIS]
        if not told["findings"]:
            undetermined = f"undetermined: {told['reason']}"
            nothing = told["verdict"] == "none"
            self.left_out[CORRECTED] = "nothing to correct was found" if nothing else undetermined
            return None
        robot = RobotDescription.load(str(self.out / DIAGNOSIS / CORRECTED))
        options = self.mission.presysid.corrected()
        options = replace(options, subset_generations=_half(options.subset_generations))
        return Half(robot, options, CORRECTED)

    def _presysid(self, half: Half) -> Stage:
        def work() -> None:
            means = self.means
            with means.fits() as fits, means.progress() as progress:
                folder = self.out / half.at("presysid")
                recordings, threads = self.recordings, means.threads
                identify(half.robot, recordings, half.options, folder, fits, progress, threads)

        pictures = (half.at("presysid/report.html"),)
        inputs = self._measured(half) | _told(half.options.told())
        files = (half.at(BOUNDS),)
        return Stage(half.stage("presysid"), inputs, files, work, pictures=pictures)

    def _replay(self, half: Half) -> Stage:
        def work() -> None:
            bounds, out = self.out / half.at(BOUNDS), self.out / half.at("replay")
            replay(half.robot, self.recordings, bounds, out, self.means.threads)

        inputs = self._measured(half) | self._hash(half.at(BOUNDS))
        return Stage(half.stage("replay"), inputs, (half.at("replay/replay.json"),), work)

    def _train(self, half: Half) -> Stage | None:
        if not self.steps:
            return None
        from services.curve import draw_curve
        from services.training import train
        from services.training_options import PATTERN, usual_learning
        from services.training_options import Options as Training

        start = self._start(half)
        pattern = min(PATTERN, self.steps // STEPS_A_GENERATION) if start is None else 0
        options = Training(
            steps=self.steps,
            seed=self.mission.presysid.seed,
            learning=usual_learning(start, pattern),
            start=start,
            pattern=pattern,
        )

        def work() -> None:
            with self.means.trained() as told, self.means.looked() as said:
                bounds, out = self.out / half.at(BOUNDS), self.out / half.at("train")
                train(half.robot, bounds, options, out, self.means.ray, told, said)

        curve, document = half.at("train/curve.png"), half.at("train/training.json")

        def draw() -> None:
            draw_curve(self.out / curve, content(self.out, document))

        begun = {} if start is None else {"policy that it starts from": sha256(start / CARD)}
        inputs = _described(half) | self._hash(half.at(BOUNDS)) | begun
        inputs |= _told(asdict(replace(options, start=None)))
        bundle = [half.at(f"{POLICY}/{name}") for name in (CARD, WEIGHTS, GRAPH)]
        stage = self._alone(half, "train", inputs, (document, *bundle), work)
        return replace(stage, remade=True, pictures=(curve,), draw=draw)

    def _walk(self, half: Half) -> Stage | None:
        if not self.steps:
            return None
        from services.walk import Shown, walk

        policy, bounds = self.out / half.at(POLICY), self.out / half.at(BOUNDS)
        shown = Shown(policy, bounds, episodes=EPISODES, seed=self.mission.presysid.seed)

        def work() -> None:
            walk(half.robot, shown, self.out / half.at("walk"), self.means.threads)

        inputs = _described(half) | self._hash(half.at(BOUNDS), half.at(f"{POLICY}/{CARD}"))
        inputs |= {"seed": str(shown.seed)}
        stage = self._alone(half, "walk", inputs, [half.at("walk/replay.json")], work)
        pictures = [half.at(f"walk/{name}") for name in ("gait.png", "walk.mp4", "walk.gif")]
        return replace(stage, pictures=tuple(pictures), draw=work)

    def _transfer(self, half: Half) -> Stage | None:
        if not self.trials or (half.name and not self.steps):  # the same policy would walk again
            return None
        from services.trials import Budget, try_out

        mission, seed = self.mission, self.mission.presysid.seed
        budget = Budget(self.trials, mission.least_gain, mission.repeats, seed)
        policy = self._walker(half)
        bounds, out = self.out / half.at(BOUNDS), self.out / half.at("transfer")

        def work() -> None:
            try_out(self.robot, policy, bounds, budget, out, self.means.told)

        used = {"policy": sha256(policy / CARD)} | _described(self.first)
        used |= self._hash(half.at(BOUNDS)) | _told(asdict(budget))
        names = "transfer.json", "study.json"
        files = [half.at(f"transfer/{name}") for name in names]
        return self._alone(half, "transfer", used, files, work)

    def _walker(self, half: Half) -> Path:
        """The policy that walks in a half's trials."""
        return self.out / half.at(POLICY) if self.steps else self.shipped

    def _rehearsal(self, half: Half) -> Stage | None:
        """The first walks of the robot, by the policy that made them, in this half's simulator."""
        if not self.trials:
            return None
        from services.rehearsal import FILE, PICTURE, rehearse

        seed, study = self.mission.presysid.seed, "transfer/study.json"
        policy = self._walker(self.first)
        bounds, out = self.out / half.at(BOUNDS), self.out / half.at("rehearsal")

        def work() -> None:
            threads = self.means.threads
            rehearse(half.robot, policy, bounds, self.out / study, out, seed, threads)

        inputs = _described(half) | self._hash(half.at(BOUNDS), study)
        inputs |= {"policy": sha256(policy / CARD), "seed": str(seed)}
        inputs |= {"control rate": "of the recordings"}  # it was drawn once
        stage = self._alone(half, "rehearsal", inputs, [half.at(f"rehearsal/{FILE}")], work)
        return replace(stage, pictures=(half.at(f"rehearsal/{PICTURE}"),))

    def _diagnosis(self) -> Stage:
        from services.diagnosis import DIAGNOSIS as TOLD
        from services.diagnosis import run_diagnosis

        walks, seed, effects = self._walks(), self.mission.presysid.seed, self.mission.effects

        def work() -> None:
            recordings, out = [*self.recordings, *walks], self.out / DIAGNOSIS
            with self.means.replays() as where, self.means.looked() as looked:
                run_diagnosis(self.robot, recordings, out, where, looked, seed, effects=effects)

        files = [f"{DIAGNOSIS}/{name}" for name in (TOLD, f"{CORRECTED}/robot.toml")]
        inputs = self._measured(self.first) | {f"recording {r.id}": r.digest for r in walks}
        inputs |= {"seed": str(seed), "effects": str(effects)}
        stage = Stage(DIAGNOSIS, inputs, tuple(files), work, DIAGNOSIS)
        return replace(stage, pictures=(f"{DIAGNOSIS}/report.html",))

    def _walks(self) -> list[Recording]:
        """How the first walks of the trials began, by names that outlive an interruption."""
        if not self.trials:
            return []
        from services.trials import recorded

        files = recorded(self.out / "transfer")[:ROLLOUTS]
        walked = [replace(walk, notes="") for walk in load_recordings(files, self.robot)]
        return [cut(walk, 0.0, ROLLOUT_SECONDS, f"walk_{i}") for i, walk in enumerate(walked, 1)]

    def _alone(
        self,
        half: Half,
        name: str,
        inputs: Mapping[str, str],
        files: Sequence[str],
        work: Callable[[], None],
    ) -> Stage:
        """A stage that has a folder to itself."""
        return Stage(half.stage(name), inputs, tuple(files), work, half.at(name))

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
        """Why there can be no trials; empty where there can.

        They walk a virtual robot: what it does says nothing of one of hardware.
        """
        if self.robot.gait is None or not (self.steps or (self.shipped / CARD).is_file()):
            return "there is no policy to walk with"
        if any(recording.source != "simulation" for recording in self.recordings):
            return "the robot that was recorded is not here to walk; it does by pup transfer"
        if any(joint.servo_id is None for joint in self.robot.joints):
            return f"robot {self.robot.name!r} has joints without servos"
        if any(find_spec(name) is None for name in ("fastapi", "botorch", "httpx")):
            return "the service is not installed (the extra `service`)"
        return ""

    def _start(self, half: Half) -> Path | None:
        """The policy to train further.

        It is the one that comes with the robot, and for a corrected robot that of the first half.
        """
        policy = self.out / POLICY if half.name else self.shipped
        if not (policy / CARD).is_file():
            return None
        card, _ = read_bundle(policy, self.robot)
        return policy if card.method == "pup" else None

    def _measured(self, half: Half) -> dict[str, str]:
        """What is replayed, and the number of the physics by which."""
        recordings = {f"recording {r.id}": r.digest for r in self.recordings}
        return _described(half) | recordings | {"physics": str(MODEL)}

    def _hash(self, *names: str) -> dict[str, str]:
        return {name: sha256(self.out / name) for name in names}


def _step_back() -> None:
    """Have a thread, and those that it starts, leave most of the cores to others.

    A trial is a chain of short steps of several processes, each of which would wait for a picture.
    Not the lowest priority: on a busy machine that comes to no time at all, and what this thread
    holds meanwhile (Python's lock, a module half imported) the trials wait for.
    """
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), 5)


def _half(generations: int) -> int:
    """Of a fit that begins where another one ended."""
    return max(1, generations // 2)


def _described(half: Half) -> dict[str, str]:
    return {f"robot {half.robot.name}": half.robot.digest}


def _told(options: Mapping[str, Any]) -> dict[str, str]:
    """Options as the journal has them."""
    return {"options": json.dumps(options, sort_keys=True, default=str)}
