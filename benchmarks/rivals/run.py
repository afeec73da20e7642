"""Rivals run on the cases of a set: a verdict for each, in the form of `diagnosis.json`."""

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from threadpoolctl import threadpool_limits

from benchmarks.rivals.case import Case, Verdict
from benchmarks.rivals.network import FILE, Network, black_box, in_the_loop
from benchmarks.rivals.refits import exhaustive, ladder
from benchmarks.rivals.rms import rms
from benchmarks.rivals.sparse import sparse
from pup.blind.score import Replayed
from pup.files import write_json
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription
from services.blind_oracle import replayed
from services.blind_run import Order
from services.diagnosis import CORRECTED, DIAGNOSIS, write_fit
from services.failures import caught, mended

Rival = Callable[[Case], Verdict | tuple[Verdict, Network]]

RIVALS: Mapping[str, Rival] = {
    "residual_rms": rms,
    "friction_ladder": ladder,
    "exhaustive_bic": exhaustive,
    "sparse_regression": sparse,
    "residual_network": black_box,
}


@dataclass(frozen=True)
class Cost:
    """What a verdict took: candidates simulated, seconds, and seconds of the processor."""

    simulations: int
    seconds: float
    processor: float

    @classmethod
    def now(cls, case: Case | None = None) -> "Cost":
        """What it took until now."""
        simulations = case.replays.count if case else 0
        return cls(simulations, time.perf_counter(), time.process_time())

    def __add__(self, other: "Cost") -> "Cost":
        return Cost(
            self.simulations + other.simulations,
            self.seconds + other.seconds,
            self.processor + other.processor,
        )

    def since(self, begin: "Cost") -> "Cost":
        """What it took from then on."""
        return Cost(
            self.simulations - begin.simulations,
            self.seconds - begin.seconds,
            self.processor - begin.processor,
        )


def place_of(folder: Path, rival: str, order: Order) -> Path:
    """Where a rival's verdict on a case stands."""
    return folder / rival / order.name


def robot_of(order: Order) -> str:
    """The robot that a case is of."""
    return load_recordings([order.recordings])[0].robot


def run_case(order: Order, rivals: Sequence[str], folder: Path) -> Iterator[tuple[str, str]]:
    """Have rivals judge a case, after the nominal fit that they share.

    Args:
      order: the case.
      rivals: their names.
      folder: of the verdicts.

    Yields:
      Each rival with what it said, or why it failed, which is written down too.
    """
    with threadpool_limits(limits=1):
        begin = Cost.now()
        robot = RobotDescription.load(robot_of(order))
        case = Case.of(robot, load_recordings([order.recordings], robot))
        shared = Cost.now(case).since(begin)
        for rival in rivals:
            out = place_of(folder, rival, order)
            try:
                yield rival, _judged(case, rival, shared, out)
            except Exception as error:  # whatever it is, the others go on
                yield rival, f"failed, {caught(out, error)}"


def _judged(case: Case, rival: str, shared: Cost, out: Path) -> str:
    _ = case.before  # simulated for the score; no rival asked for it
    begin = Cost.now(case)
    told = RIVALS[rival](case)
    cost = shared + Cost.now(case).since(begin)
    verdict, network = told if isinstance(told, tuple) else (told, None)
    if verdict.fit is not None:
        write_fit(case.robot, verdict.fit, out / CORRECTED)
    if network is not None:
        network.save(out / CORRECTED / FILE)
    document = case.document(verdict, cost.simulations, str(out / CORRECTED))
    document |= {"seconds": cost.seconds, "processor_seconds": cost.processor}
    write_json(out / DIAGNOSIS, document)
    mended(out)
    return f"{document['verdict']} {', '.join(n.effect for n in verdict.named[:3])}".strip()


def replay(diagnosed: Path, tests: Sequence[Recording]) -> Replayed | None:
    """See `pup.blind.score.Replay`; a network that stands beside a robot acts in its simulation."""
    file = diagnosed / CORRECTED / FILE
    with in_the_loop(Network.load(file)) if file.exists() else nullcontext():
        return replayed(diagnosed, tests)
