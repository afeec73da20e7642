"""What a whole job is asked for, and the means it has."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

from pup.errors import InputError
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription
from services.diagnosis import Progress as Looked
from services.diagnosis import Where
from services.presysid import Progress
from services.presysid_options import Options
from workers.fits import Runner

SHIPPED = "recordings"
"""Folder of a built-in robot with recordings of our own, from virtual robot 0."""
GENERATIONS, FURTHER = 20, 8
"""Of a nominal fit unless told otherwise: from a description's values, and from fitted ones, whose
neighbourhood CMA-ES has searched by then, and the polish does the rest."""
STEPS = 150_000
"""Of the training unless told otherwise: three quarters of a minute at 3,700 a second."""
TRIALS = 25
"""Walks until eta is chosen, at most (paper)."""
LEAST_GAIN = 0.002
"""Expected of a further walk, as a share of the best's distance: 6 mm of 3 m, less than walks of
one eta differ by. What it costs on landscapes that are harder to search is told in
docs/results/transfer.md."""
EFFECTS = 2
"""Missing effects unless told otherwise: a robot of twenty joints takes minutes for each."""


@dataclass(frozen=True)
class Mission:
    """What a job does.

    Attributes:
      presysid: budget of its fits.
      steps: of each training; 0 leaves it out; None for STEPS where the robot has a gait.
      trials: walks until eta is chosen, at most; 0 leaves them out; None for TRIALS where the
        robot has a gait and servos.
      least_gain: that is expected of a further walk, as a share of the best's distance.
      repeats: walks of the chosen eta and of the fitted one.
      effects: missing ones that recordings and walks are searched for, to do all of it again with
        the robot as it was found to be; 0 leaves that out.
    """

    presysid: Options
    steps: int | None = None
    trials: int | None = None
    least_gain: float = LEAST_GAIN
    repeats: int = 5
    effects: int = EFFECTS


@dataclass(frozen=True)
class Means:
    """Where a job works and whom it tells.

    Attributes:
      fits: opens where fits run.
      replays: opens where a diagnosis replays.
      ray: connects to the Ray of the training, and gives the cores there are.
      progress: opens what is told how far fits are.
      looked: opens what is told how far the diagnosis is, and what a training begins with.
      trained: opens what is told how far the training is.
      told: hears how far the trials are.
      threads: cores for what runs in this process.
    """

    fits: Callable[[], AbstractContextManager[Runner]]
    replays: Callable[[], AbstractContextManager[Where]]
    ray: Callable[[], AbstractContextManager[int]]
    progress: Callable[[], AbstractContextManager[Progress]]
    looked: Callable[[], AbstractContextManager[Looked]]
    trained: Callable[[], AbstractContextManager[Callable[[dict[str, Any], int], None]]]
    told: Callable[[str], None]
    threads: int


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
