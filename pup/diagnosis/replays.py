"""Rows of named parameters in, whitenable samples out: all that diagnosis asks of a simulator.

Rows that put different effects into the simulation go into different batches, so that each batch
computes only the terms it needs. Where batches run, in threads or on a cluster, is the caller's.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pup.diagnosis.residuals import Measured
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import Candidates, ParameterSpace
from pup.physics.push import Push
from pup.physics.terms import Place, split_column, term_space
from pup.recording_cuts import beginning
from pup.robot import RobotDescription

Array = NDArray[np.float64]
Row = Mapping[str, float]
"""Parameters by name; those not named have their nominal values."""

BATCH = 384
"""Simulations in a batch, at most."""
WORTH = 8
"""Simulations that are worth a batch of their own."""
COARSER, COARSEST = 2, 0.004
"""Sub-steps of a coarse replay: so many times as long as the robot's, up to so long, s. What they
miss is alike in two simulations that hardly differ, and so is not in their difference."""
WIDEST_FIRST = {"group": 1, "joint": 2}
"""Order of kinds of places; all others come first."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Candidates that are replayed together.

    Attributes:
      rows: where they stand among all.
      candidates: their parameters.
      recordings: which recordings are replayed.
      push: torques from outside.
      until: how much of each recording is replayed, s; all where it is None.
      coarse: whether it may be in longer sub-steps. With contact it never is.
    """

    rows: NDArray[np.int64]
    candidates: Candidates
    recordings: tuple[int, ...]
    push: Push | None = None
    until: float | None = None
    coarse: bool = False


@dataclass(eq=False)
class Bench:
    """Replays batches in this process; a worker has one of its own.

    Attributes:
      measured: what is replayed.
      actuator: torque law of the nominal model.
    """

    measured: Measured
    actuator: str = "pd"
    _simulators: dict[tuple[object, ...], tuple[MujocoSimulator, Measured]] = field(
        default_factory=dict, repr=False
    )

    def run(self, batch: Batch) -> Array:
        """Samples of a batch, shape (n_rows, n_samples of its recordings), rad."""
        simulator, measured = self.simulator(batch.recordings, batch.until, batch.coarse)
        return measured.pick(simulator.replay(batch.candidates, batch.push))

    def simulator(
        self, recordings: tuple[int, ...], until: float | None, coarse: bool = False
    ) -> tuple[MujocoSimulator, Measured]:
        """The simulator of some recordings, or of how they begin, and their samples."""
        key = recordings, until, coarse
        if key not in self._simulators:
            part = some(self.measured, recordings, until)
            rough = coarse and not part.grounded.any()
            robot = self._coarser if rough else part.robot
            simulator = MujocoSimulator(robot, part.recordings, self.actuator)
            self._simulators[key] = simulator, part
        return self._simulators[key]

    @cached_property
    def _coarser(self) -> RobotDescription:
        """The robot in longer sub-steps."""
        own = self.measured.robot.timestep
        return replace(self.measured.robot, timestep=max(own, min(COARSER * own, COARSEST)))


def some(measured: Measured, recordings: Sequence[int], until: float | None) -> Measured:
    """The samples of some recordings, or of how they begin."""
    chosen = [measured.recordings[i] for i in recordings]
    parts = chosen if until is None else [beginning(recording, until) for recording in chosen]
    return Measured.of(measured.robot, parts, chosen)


Runner = Callable[[Sequence[Batch]], list[Array]]
"""Runs batches wherever there are cores, and returns their samples in order."""


def threads(bench: Bench, count: int) -> Runner:
    """A runner in threads of this process."""

    def run(batches: Sequence[Batch]) -> list[Array]:
        for batch in batches:
            bench.simulator(batch.recordings, batch.until, batch.coarse)
        with ThreadPoolExecutor(count) as pool:
            return list(pool.map(bench.run, batches))

    return run


class Replays:
    """Replays rows of parameters against one set of measurements.

    Args:
      measured: what was measured.
      space: the nominal model's parameters.
      runner: runs the batches.
      lanes: how many batches run at once.
    """

    def __init__(
        self, measured: Measured, space: ParameterSpace, runner: Runner, lanes: int
    ) -> None:
        self.measured = measured
        self.space = space
        self.runner = runner
        self.lanes = lanes
        self.simulated = 0
        """Recordings replayed, one for each candidate."""

    def __call__(
        self,
        rows: Sequence[Row],
        recordings: Sequence[int] | None = None,
        push: Push | None = None,
    ) -> Array:
        """Simulated samples, shape (n_rows, n_samples), rad; NaN where a simulation diverged.

        Args:
          rows: the candidates.
          recordings: replay these only; the samples are theirs.
          push: torques from outside on each row and recording.
        """
        every = range(len(self.measured.recordings))
        chosen = tuple(every if recordings is None else recordings)
        return self._run([(self._batches(rows, chosen, push), len(rows))])[0]

    def errors(self, row: Row) -> Array:
        """Measured minus simulated, shape (n_samples,), rad; NaN where the simulation diverged."""
        return np.asarray(self.measured.values - self([row])[0])

    def together(
        self, asked: Sequence[tuple[Sequence[Row], Sequence[int]]], coarse: bool = False
    ) -> list[Array]:
        """Several calls at once, each with its rows and recordings.

        Where they are small, one batch of all rows and recordings costs less than one for each.

        Args:
          asked: the rows, and the recordings that are replayed with them.
          coarse: see Batch.
        """
        each = sum(len(rows) * len(chosen) for rows, chosen in asked)
        every = tuple(range(len(self.measured.recordings)))
        rows = [row for rows, _ in asked for row in rows]
        if len(rows) * len(every) - each < WORTH * (len(asked) - 1):
            told = iter(self._run([(self._batches(rows, every, None, coarse), len(rows))])[0])
            return [
                np.array([next(told)[self.measured.only(chosen)] for _ in rows])
                for rows, chosen in asked
            ]
        return self._run(
            [
                (self._batches(rows, tuple(chosen), None, coarse), len(rows))
                for rows, chosen in asked
            ]
        )

    def narrowed(self, recordings: Sequence[int]) -> "Replays":
        """Replays of some of the recordings, as if there were no others."""

        def run(batches: Sequence[Batch]) -> list[Array]:
            return self.runner(
                [replace(b, recordings=tuple(recordings[i] for i in b.recordings)) for b in batches]
            )

        return Replays(some(self.measured, recordings, None), self.space, run, self.lanes)

    def shortened(self, until: float) -> "Replays":
        """Replays of how the recordings begin, up to some time."""

        def run(batches: Sequence[Batch]) -> list[Array]:
            return self.runner([replace(b, until=until) for b in batches])

        every = range(len(self.measured.recordings))
        return Replays(some(self.measured, every, until), self.space, run, self.lanes)

    def _run(self, calls: Sequence[tuple[list[Batch], int]]) -> list[Array]:
        answers = iter(self.runner([batch for batches, _ in calls for batch in batches]))
        out = []
        for batches, rows in calls:
            chosen = batches[0].recordings
            samples = np.empty((rows, int(self.measured.only(chosen).sum())))
            for batch in batches:
                samples[batch.rows] = next(answers)
            self.simulated += rows * len(chosen)
            out.append(samples)
        return out

    @property
    def count(self) -> int:
        """Candidates replayed, one for each pass over all recordings."""
        return round(self.simulated / len(self.measured.recordings))

    def _batches(
        self,
        rows: Sequence[Row],
        recordings: tuple[int, ...],
        push: Push | None,
        coarse: bool = False,
    ) -> list[Batch]:
        effects = [_effects(row) for row in rows]
        order = np.array(sorted(range(len(rows)), key=effects.__getitem__), dtype=np.int64)
        most = max(1, BATCH // len(recordings))
        worth = max(1, len(rows) * len(recordings) // WORTH)
        parts = max(min(self.lanes, worth), -(-len(rows) // most))
        if parts > self.lanes:
            parts += -parts % self.lanes  # three batches on two lanes take as long as four
        return [
            Batch(
                part,
                self._candidates([rows[i] for i in part]),
                recordings,
                None if push is None else replace(push, values=push.values[part]),
                coarse=coarse,
            )
            for part in np.array_split(order, min(parts, len(rows)))
        ]

    def _candidates(self, rows: Sequence[Row]) -> Candidates:
        space = union(self.space, rows)
        index = {name: i for i, name in enumerate(space.names)}
        values = np.tile(space.nominal, (len(rows), 1))
        for number, row in enumerate(rows):
            for name, value in row.items():
                values[number, index[name]] = value
        return space.candidates(values)


def union(space: ParameterSpace, rows: Sequence[Row]) -> ParameterSpace:
    """A space with the columns of all terms that some rows name."""
    own: dict[tuple[str, Place], list[str]] = {}
    for name in space.names:
        if (told := split_column(name)) is not None:
            own.setdefault((told[0], told[2]), []).append(name)
    terms = dict.fromkeys(own)
    for row in rows:
        for name in row:
            if name not in space.names and (told := split_column(name)) is not None:
                terms[told[0], told[2]] = None
    both = space.select([name for name in space.names if split_column(name) is None])
    # Where places overlap, the shape of the narrower counts, whatever else is in the batch.
    for term in sorted(terms, key=lambda term: WIDEST_FIRST.get(term[1].kind, 0)):
        both = both.plus(space.select(own[term]) if term in own else term_space(*term))
    return both


def _effects(row: Row) -> tuple[str, ...]:
    return tuple(sorted({name.partition("/")[0] for name in row if "@" in name}))
