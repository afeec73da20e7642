"""What each kind of cell does, on one core, so that results do not hang on how many there are."""

import os
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pup.errors import InputError
from pup.files import sha256
from pup.policy.bundle import WEIGHTS, NumpyPolicy
from pup.policy.shape import Method
from pup.recording import Recording, load_recordings
from pup.recording_cuts import cut
from pup.robot import RobotDescription
from services.experiment.cells import Cell

RESULT = "result.json"
"""What a cell found, the same whenever and wherever it is done."""
CORRECTED = "corrected"
SHARED = "The median robot of a fleet, with what was missing in most of its robots."


@dataclass(frozen=True)
class Task:
    """A cell and where its files are.

    Attributes:
      cell: what is done.
      out: folder of this cell's files.
      needed: folders of the files of those that it needs, by the part that each plays.
    """

    cell: Cell
    out: Path
    needed: Mapping[str, Path]

    @property
    def told(self) -> Mapping[str, Any]:
        """What it depends on."""
        return self.cell.told

    @property
    def robot(self) -> RobotDescription:
        """The robot as the experiment knows it."""
        return RobotDescription.load(self.cell.given["robot"])

    @property
    def simulated(self) -> RobotDescription:
        """The robot that is simulated: corrected, where the cell needs a diagnosis for that."""
        if "robot" not in self.needed:
            return self.robot
        return RobotDescription.load(str(self.needed["robot"] / CORRECTED))

    def recordings(self, motions: tuple[str, ...] = ()) -> tuple[Recording, ...]:
        """All recordings that it is given; of some types of motion only where these are told."""
        folders = [f for part, f in self.needed.items() if part.startswith("recordings ")]
        folders = [folder / "recordings" for folder in folders]
        if "recordings" in self.cell.given:
            folders = [Path(self.cell.given["recordings"])]
        read = load_recordings(folders, self.robot)
        found = tuple(r for r in read if not motions or r.motion in motions)
        if not found:
            raise InputError(f"no recording of {', '.join(motions)}; was every script stopped?")
        return found


def record(task: Task) -> dict[str, Any]:
    """Scripts, played by a concealed robot; one that was recorded already is kept."""
    from pup.sysid.excitation import script
    from services.experiment.playing import Player, virtual_robot

    seed, folder = task.told["character"], task.out / "recordings"
    motions = script(
        task.robot, task.told["motions"], np.random.default_rng(task.told["seed"]), jitter=True
    )
    stopped = {}
    with virtual_robot(task.robot, seed, task.out / "robot.log") as doors:
        player = Player(task.robot, doors, seed)
        for i, motion in enumerate(motions):
            first = f"r{seed}_{motion.id}"
            for turn in range(task.told["repeats"]):
                name = f"{first}_again_{turn}" if turn else first
                file = folder / f"{name}.parquet"
                if file.exists():
                    continue
                draw = (task.told["seed"] * 1000 + i) * 100 + turn
                try:
                    made = player.play(motion, name, draw, first if turn else None)
                except InputError as error:  # as a rule of safety says; others go on
                    stopped[name] = str(error)
                else:
                    made.write(file)
        player.close()
    recorded = load_recordings([folder], task.robot)
    return {"recordings": {r.id: r.digest for r in recorded}, "stopped": stopped}


def presysid(task: Task) -> dict[str, Any]:
    """Parameters and bounds of the recordings of one robot, or of all."""
    from services.presysid import identify
    from services.presysid_options import Options
    from workers.fits import LocalRunner

    options = Options(**task.told["fits"])
    recordings = task.recordings(tuple(task.told["motions"]))
    wanted = task.simulated, recordings, options, task.out, LocalRunner()
    return _bounds(identify(*wanted, lambda stage, statuses: None, 1).document())


def pooled(task: Task) -> dict[str, Any]:
    """Bounds of the fleet, from the fits of its robots; of corrected ones, with what they share."""
    from pup.robot_writer import write_corrected
    from pup.sysid.pooled import pooled, shared_terms

    files = [f / "bounds.json" for part, f in task.needed.items() if part.startswith("fit ")]
    folders = [f / CORRECTED for part, f in task.needed.items() if part.startswith("robot ")]
    corrected, robot = [RobotDescription.load(str(folder)) for folder in folders], task.robot
    terms = shared_terms(corrected, robot)
    bounds = pooled(files, robot, corrected, terms)
    if corrected:
        values = dict(zip(bounds.space.names, map(float, bounds.nominal), strict=True))
        nominal = {p.name: values[p.name] for p in robot.parameters if p.name in values}
        all_terms, law = (*robot.terms, *terms), bounds.actuator
        write_corrected(robot, task.out / CORRECTED, nominal, all_terms, SHARED, law)
    bounds.write(task.out / "bounds.json")
    return _bounds(bounds.document())


def _bounds(told: dict[str, Any]) -> dict[str, Any]:
    """What a cell tells of a `bounds.json`."""
    kept = ("parameters", "actuator", "loss", "histories", "splits")
    return {name: told[name] for name in kept}


def policy(task: Task) -> dict[str, Any]:
    """A policy: one that was given, or a training on bounds."""
    from pup.locomotion.settings import Direction
    from services.experiment.plan import training
    from services.training import train
    from services.training_options import training_options

    told, folder = task.told, task.out / "policy"
    method, direction = Method(told["method"]), Direction(told["direction"])
    if "ready" in told:
        given = Path(task.cell.given["policy"])
        card = NumpyPolicy.load(given, task.robot).card
        if (card.method, card.direction) != (method, direction):
            raise InputError(
                f"{given}: is {card.direction}, {card.method}; it lies where {direction}, "
                f"{method} belongs"
            )
        shutil.copytree(given, folder, dirs_exist_ok=True)
        return {"weights": sha256(folder / WEIGHTS), "ready": True, "steps": None}
    start = task.needed["start"] / "policy" if "start" in task.needed else None
    given = training(told["training"])
    given.start = start
    options = replace(
        training_options(given), method=method, direction=direction, seed=told["seed"]
    )
    bounds = task.needed["bounds"] / "bounds.json"
    done = train(task.simulated, bounds, options, task.out, _one_core, lambda row, steps: None)
    last = {name: values[-1] for name, values in done["curve"].items() if "seconds" not in name}
    weights = sha256(folder / WEIGHTS)
    return {"weights": weights, "ready": False, "steps": done["steps"], "last": last}


@contextmanager
def _one_core() -> Iterator[int]:
    """A Ray for the training: the one that this process works for, or one of its own."""
    import ray

    from workers.cluster import connected

    if ray.is_initialized():
        yield 1
        return
    with connected(None, 1):
        yield 1


def landscape(task: Task) -> dict[str, Any]:
    """How far a policy walks in simulation over eta, for trials to begin with."""
    from pup.locomotion.settings import TaskSettings
    from pup.sysid.result import read_bounds
    from services.walk import write_landscape

    robot, told, file = task.robot, task.told, task.out / "simulated.json"
    walker = NumpyPolicy.load(task.needed["policy"] / "policy", robot)
    bounds = read_bounds(task.needed["bounds"] / "bounds.json", robot)
    settings = TaskSettings.of_policy(robot, walker.card).evaluation(told["rate"])
    settings = replace(settings, horizon=told["horizon"])
    write_landscape(file, robot, walker, bounds, settings, told["etas"], told["seed"], 1)
    return {"simulated": sha256(file)}


def trials(task: Task) -> dict[str, Any]:
    """Walks of a concealed robot."""
    from services.experiment.walking import walk

    needed = task.needed
    return walk(
        task.robot,
        task.told,
        needed["policy"] / "policy",
        needed["bounds"] / "bounds.json" if "bounds" in needed else None,
        task.simulated,
        needed["landscape"] / "simulated.json" if "landscape" in needed else None,
        task.out,
    )


def diagnosis(task: Task) -> dict[str, Any]:
    """What the simulator leaves out, from recordings and walks, and the corrected robot."""
    from services.diagnosis import alone, run_diagnosis
    from services.trials import recorded

    recordings = list(task.recordings(tuple(task.told["motions"])))
    if "rollouts" in task.needed:
        files = recorded(task.needed["rollouts"])[: task.told["rollouts"]]
        walks = load_recordings(files, task.robot)
        recordings += [cut(walk, 0.0, task.told["seconds"], f"walk_{walk.id}") for walk in walks]
    found = run_diagnosis(
        task.robot,
        recordings,
        task.out,
        alone(1),
        lambda stage, share: None,
        task.told["seed"],
        rivals=task.told["rivals"],
        effects=task.told["effects"],
    )
    kept = ("verdict", "converged", "noise_floor", "findings", "held_out", "next_recording")
    return {name: found[name] for name in kept} | {"rivals": found.get("rivals")}


KINDS: dict[str, Callable[[Task], dict[str, Any]]] = {
    "record": record,
    "presysid": presysid,
    "pooled": pooled,
    "policy": policy,
    "landscape": landscape,
    "trials": trials,
    "diagnosis": diagnosis,
}
LEFT = {
    "presysid": ("bounds.json",),
    "pooled": ("bounds.json", "corrected/robot.toml"),
    "policy": ("policy/policy.json",),
    "landscape": ("simulated.json",),
    "diagnosis": ("diagnosis.json", "corrected/robot.toml"),
}
"""Files besides the result without which a cell is not done."""


def quiet() -> None:
    """One thread for each process: cells run beside each other."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
