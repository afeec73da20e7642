"""The diagnosis job: recordings in, `diagnosis.json`, `report.html` and `corrected/` out."""

import hashlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from pup.diagnosis.document import document
from pup.diagnosis.engine import diagnose
from pup.diagnosis.fit import Fit
from pup.diagnosis.replays import Bench, Replays, Runner, threads
from pup.diagnosis.report import write_report
from pup.diagnosis.residuals import Measured
from pup.diagnosis.result import Diagnosis
from pup.diagnosis.rivals import Rivals, compare
from pup.diagnosis.store import Store
from pup.files import write_json
from pup.physics.parameters import robot_space
from pup.physics.terms import Kind, split_column
from pup.recording import Recording
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import check_folder, write_corrected
from pup.sysid.problem import MODEL
from services.provenance import versions
from services.stopwatch import Stopwatch

Progress = Callable[[str, float], None]

DIAGNOSIS = "diagnosis.json"
CORRECTED = "corrected"
CHECKPOINTS = "checkpoints"
"""Goes when the diagnosis is done."""
SPENT = "spent.json"


@dataclass(frozen=True)
class Where:
    """Where batches of replays run.

    Attributes:
      runner: makes what runs them with an actuator, `pd` or `nn_pd`.
      lanes: how many run at once.
      here: whether in this process, whose processor time then is the diagnosis's.
    """

    runner: Callable[[Measured, str], Runner]
    lanes: int
    here: bool


def alone(cores: int) -> Where:
    """In threads of this process."""
    return Where(
        lambda measured, actuator: threads(Bench(measured, actuator), cores), cores, here=True
    )


def run_diagnosis(
    robot: RobotDescription,
    recordings: Sequence[Recording],
    out: Path,
    where: Where,
    progress: Progress,
    seed: int = 0,
    report: bool = True,
    rivals: bool = False,
    effects: int = 8,
) -> dict[str, Any]:
    """Diagnose recordings and write the files; run again, it goes on where it was stopped.

    Args:
      robot: the robot.
      recordings: of that robot.
      out: folder for `diagnosis.json`, `report.html` and `corrected/`.
      where: runs batches of replays.
      progress: told the stage and the share of all that is done.
      seed: of everything random.
      report: whether to write `report.html` too.
      rivals: whether to fit and judge rivals too, which needs PyTorch.
      effects: that are looked for at most.

    Returns:
      The document of `diagnosis.json`: that of the contract, and how many `seconds` it took from
      the first start on; `processor_seconds` too where all was done in this process.
    """
    check_folder(robot, out / CORRECTED)  # told before hours of fits, and not after them
    kept = out / CHECKPOINTS
    watch = Stopwatch(kept / SPENT, _digest(robot, recordings))
    run = keeper(where, kept)
    others = None
    with threadpool_limits(limits=1):  # the sums of BLAS depend on its threads, a verdict must not
        found = diagnose(
            robot,
            recordings,
            lambda m: watch.around(run(m)),
            where.lanes,
            progress,
            seed,
            effects,
        )
        if rivals:
            progress("rivals", 0.97)
            others = _rivals(found, where, kept, watch, seed)
    told = document(found, _write_corrected(found, out))
    if rivals:
        told["rivals"] = others.document() if others else None
    seconds, processor = watch.spent()
    told |= {"seconds": seconds} | ({"processor_seconds": processor} if where.here else {})
    write_json(out / DIAGNOSIS, told)
    if report:
        progress("report", 0.98)
        source = _provenance(robot, recordings, told, seed)
        write_report(found, out / "report.html", source, others)
    _clear(kept)
    progress("done", 1.0)
    return told


def _rivals(
    found: Diagnosis, where: Where, kept: Path, watch: Stopwatch, seed: int
) -> Rivals | None:
    """Rivals of a diagnosis, whose replays are kept as the diagnosis's own are."""

    def replays_with(actuator: str) -> Replays:
        run = watch.around(keeper(where, kept, actuator)(found.measured))
        return Replays(found.measured, robot_space(found.robot, actuator), run, where.lanes)

    return compare(found, replays_with, seed)


def keeper(where: Where, kept: Path, actuator: str = "pd") -> Callable[[Measured], Runner]:
    """What runs batches of replays and keeps the answers in a folder."""

    def runner(measured: Measured) -> Runner:
        # Planned recordings are replayed too, and their answers are not of those measured; names
        # tell actuators apart.
        store = Store(kept, _digest(measured.robot, measured.recordings))
        return store.around(where.runner(measured, actuator))

    return runner


def _clear(kept: Path) -> None:
    """Remove what a diagnosis keeps while it lasts, but nothing of another job's."""
    # Who is killed while writing leaves a file whose name begins with a dot.
    for pattern in ("*.f32", ".*.f32.*", SPENT, f".{SPENT}.*"):
        for file in kept.glob(pattern):
            file.unlink()
    with suppress(OSError):  # it holds something else, or never was
        kept.rmdir()


def _write_corrected(found: Diagnosis, out: Path) -> str:
    """Write the robot as it was found to be; what is nominal stays as it was fitted.

    Where nothing can be said, it is the robot as it was: a fit that does not settle is no better.
    """
    if found.model is None:
        notes = "As described: `pup diagnose` could tell nothing of it."
        write_corrected(found.robot, out / CORRECTED, {}, found.robot.terms, notes)
    else:
        notes = "Corrected by `pup diagnose`."
        write_fit(found.robot, found.model.fit, out / CORRECTED, notes)
    return str(out / CORRECTED)


def write_fit(robot: RobotDescription, fit: Fit, folder: Path, notes: str = "") -> None:
    """Write a robot with the nominal parameters and the effects of a fit beside its own terms.

    Args:
      robot: that was fitted.
      fit: with PD servos.
      folder: where to write.
      notes: comment at the head of `robot.toml`.
    """
    nominal: dict[str, float] = {}
    terms: dict[tuple[str, Kind, str], dict[str, float]] = {}
    for name, value in fit.values.items():
        told = split_column(name)
        if told is None:
            nominal[name] = value
        else:
            effect, quantity, place = told
            terms.setdefault((effect, place.kind, place.name), {})[quantity] = value
    specs = [TermSpec(*key, given) for key, given in terms.items()]
    write_corrected(robot, folder, nominal, [*robot.terms, *specs], notes)


def _provenance(
    robot: RobotDescription, recordings: Sequence[Recording], told: dict[str, Any], seed: int
) -> dict[str, Any]:
    """What the diagnosis was made from, and what to record next."""
    return {
        "robot_digest": robot.digest,
        "recordings": {r.id: r.digest for r in recordings},
        "seed": seed,
        "versions": versions("pup", "mujoco", "numpy"),
        "next_recording": told["next_recording"],
    }


def _digest(robot: RobotDescription, recordings: Sequence[Recording]) -> str:
    parts = [str(MODEL), robot.digest, repr(robot.timestep), *(r.digest for r in recordings)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
