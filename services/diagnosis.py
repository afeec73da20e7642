"""The diagnosis job: recordings in, `diagnosis.json`, `report.html` and `corrected/` out."""

import hashlib
import platform
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pup.diagnosis.document import document
from pup.diagnosis.engine import Diagnosis, diagnose
from pup.diagnosis.replays import Runner
from pup.diagnosis.report import write_report
from pup.diagnosis.residuals import Measured
from pup.diagnosis.store import Store
from pup.files import write_json
from pup.physics.terms import split_column
from pup.recording import Recording
from pup.robot import RobotDescription, TermSpec
from pup.robot_writer import write_corrected
from pup.sysid.problem import MODEL

Progress = Callable[[str, float], None]


def run_diagnosis(
    robot: RobotDescription,
    recordings: Sequence[Recording],
    out: Path,
    runner: Callable[[Measured], Runner],
    lanes: int,
    progress: Progress,
    seed: int = 0,
) -> dict[str, Any]:
    """Diagnose recordings and write the files; run again, it goes on where it was stopped.

    Args:
      robot: the robot.
      recordings: of that robot.
      out: folder for `diagnosis.json`, `report.html` and `corrected/`.
      runner: makes what runs batches of replays.
      lanes: how many run at once.
      progress: told the stage and the share of all that is done.
      seed: of everything random.

    Returns:
      The document of `diagnosis.json`.
    """
    store = Store(out / "checkpoints", _digest(robot, recordings))
    found = diagnose(robot, recordings, lambda m: store.around(runner(m)), lanes, progress, seed)
    corrected = _write_corrected(found, out)
    told = document(found, corrected)
    write_json(out / "diagnosis.json", told)
    progress("report", 0.98)
    write_report(found, out / "report.html", _provenance(robot, recordings, told, seed))
    store.clear()
    progress("done", 1.0)
    return told


def _write_corrected(found: Diagnosis, out: Path) -> str:
    """Write the robot as it was found to be; what is nominal stays as it was fitted."""
    fit = found.model.fit if found.model else found.nominal.fit
    values = {n: v for n, v in fit.values.items() if "@" not in n}
    terms: dict[tuple[str, str, str], dict[str, float]] = {}
    for name, value in fit.values.items():
        told = split_column(name)
        if told is not None:
            effect, quantity, place = told
            terms.setdefault((effect, place.kind, place.name), {})[quantity] = value
    known = list(found.robot.terms) + [
        TermSpec(effect, kind, name, given)  # type: ignore[arg-type]
        for (effect, kind, name), given in terms.items()
    ]
    folder = out / "corrected"
    write_corrected(found.robot, folder, values, known, "Corrected by `pup diagnose`.", "pd")
    return str(folder)


def _provenance(
    robot: RobotDescription, recordings: Sequence[Recording], told: dict[str, Any], seed: int
) -> dict[str, Any]:
    """What the diagnosis was made from, and what to record next."""
    packages = ("pup", "mujoco", "numpy")
    return {
        "robot_digest": robot.digest,
        "recordings": {r.id: r.digest for r in recordings},
        "seed": seed,
        "versions": {p: version(p) for p in packages} | {"python": platform.python_version()},
        "next_recording": told["next_recording"],
    }


def _digest(robot: RobotDescription, recordings: Sequence[Recording]) -> str:
    parts = [str(MODEL), robot.digest, *(recording.digest for recording in recordings)]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()
