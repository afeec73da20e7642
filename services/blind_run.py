"""The blind job that diagnoses: verdicts on all cases of a sealed set, several at once.

A case is diagnosed by one process on one core: inside, a small case does not parallelise. What is
written of a case is what `pup diagnose` writes but the report; `run.json` tells with which engine.
"""

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pup.blind.seal import COMMITMENT, read_set
from pup.errors import InputError
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription, built_in_robots
from services.blind_journal import JOURNAL, Journal
from services.diagnosis import DIAGNOSIS, alone, run_diagnosis
from services.failures import ERROR, FailedError, caught, lost, mended, named
from services.places import Pools

SEED = 0

Tell = Callable[..., None]
"""See `progress.counted`."""


@dataclass(frozen=True)
class Order:
    """One case to be diagnosed.

    Attributes:
      name: of its folder.
      recordings: where its recordings are.
      out: where its diagnosis goes.
    """

    name: str
    recordings: Path
    out: Path

    @property
    def weight(self) -> int:
        """How much work it is, roughly: bytes of its recordings."""
        return sum(file.stat().st_size for file in self.recordings.glob("*.parquet"))

    @property
    def done(self) -> bool:
        """Whether there is a diagnosis."""
        return (self.out / DIAGNOSIS).is_file()


@dataclass(frozen=True)
class Outcome:
    """What became of a case: the verdict and how long it took, or what went wrong, and by whom."""

    verdict: str = ""
    seconds: float = 0.0
    error: str = ""
    mistaken: bool = False


def orders(folder: Path, out: Path, limit: int | None) -> tuple[list[Order], dict[str, Any]]:
    """The cases of a set, first ids first, and its commitment.

    Args:
      folder: the set.
      out: where diagnoses go.
      limit: take only so many cases.

    Raises:
      InputError: the folder is no set, not the one committed to, or without a case; or the
        diagnoses would go into it.
    """
    commitment = read_set(folder)
    if out.resolve().is_relative_to(folder.resolve()):
        raise InputError(f"{out}: lies in the set's own folder; use another")
    cases = cases_of(folder, limit)
    if not cases:
        raise InputError(f"{folder}: its {COMMITMENT} stands there without a case")
    found = [Order(c.name, c / "recordings", out.absolute() / c.name) for c in cases]
    return found, commitment


def cases_of(folder: Path, limit: int | None) -> list[Path]:
    """Folders of a set's cases, first ids first."""
    # Absolute, as a worker's working directory is another.
    return sorted(case.absolute() for case in folder.glob("case_*") if case.is_dir())[:limit]


def run_cases(
    wanted: Sequence[Order], journal: Journal, pools: Pools, lanes: int, tell: Tell
) -> None:
    """Diagnose the cases that have no diagnosis yet.

    One that fails is recorded, and tried again by the next run.

    Args:
      wanted: the cases.
      journal: of the run.
      pools: of what does them, several at once.
      lanes: how many at once.
      tell: told how many are done.

    Raises:
      InputError: some cases failed, all of them by bad input.
      FailedError: some failed otherwise.
    """
    # The longest first, so that none is left for the end.
    todo = sorted((o for o in wanted if not o.done), key=lambda o: (-o.weight, o.name))
    failed: dict[str, str] = {}
    mistaken = True
    done, share = len(wanted) - len(todo), 0.0
    whole = sum(order.weight for order in todo)
    with journal.session(lanes, failed), closing(pools(diagnose_case)) as pool:
        tell(done, len(wanted))
        for order in todo:
            pool.begin(order)
        for _ in todo:
            order, outcome = pool.settled()
            told = _settled(order, outcome)
            if told.error:
                failed[order.name] = told.error
                mistaken = mistaken and told.mistaken
            else:
                journal.seal(order.name)
            done += not told.error
            share += order.weight / max(whole, 1)
            tell(done, len(wanted), _note(order, told, failed), share)
    if failed:
        kind = InputError if mistaken else FailedError
        raise kind(_complaint(failed, len(wanted), journal.folder))


def diagnose_case(order: Order) -> Outcome:
    """Diagnose a case on one core; what goes wrong is written down instead of raised."""
    try:
        robot, recordings = _read(order)
        told = run_diagnosis(
            robot, recordings, order.out, alone(1), lambda stage, share: None, SEED, report=False
        )
    except Exception as error:  # whatever it is, the other cases go on
        return Outcome(error=caught(order.out, error), mistaken=isinstance(error, InputError))
    mended(order.out)
    return Outcome(told["verdict"], told["seconds"])


def _read(order: Order) -> tuple[RobotDescription, tuple[Recording, ...]]:
    """A case's recordings, and the robot that they are of."""
    names = {recording.robot for recording in load_recordings([order.recordings])}
    unknown = names.difference(built_in_robots())
    if unknown or len(names) > 1:
        raise InputError(
            f"{order.recordings}: recordings of {', '.join(sorted(names))}; a case is of one robot "
            f"of {', '.join(built_in_robots())}"
        )
    robot = RobotDescription.load(names.pop())
    return robot, load_recordings([order.recordings], robot)


def _settled(order: Order, outcome: Any) -> Outcome:
    """An outcome; a case whose process was lost has none, and gets its error file here."""
    if isinstance(outcome, Outcome):
        return outcome
    return Outcome(error=lost(order.out, outcome))


def _note(order: Order, told: Outcome, failed: dict[str, str]) -> str:
    last = f"failed, {told.error}" if told.error else f"{told.verdict} in {told.seconds:.0f} s"
    return f"{order.name}: {last}" + (f"; {len(failed)} failed" if failed else "")


def _complaint(failed: dict[str, str], cases: int, folder: Path) -> str:
    return (
        f"{folder}: {len(failed)} of {cases} cases failed, see their {ERROR}; the same command "
        f"tries them again: {named(failed, f' in {JOURNAL}')}"
    )
