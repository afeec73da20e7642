"""The journal of a run over a blind set: which set, which engine, when."""

import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pup.blind.score import DIAGNOSIS
from pup.errors import InputError
from pup.files import read_json, sha256, write_json
from services.held import LOCK
from services.provenance import ALSO, engine, now

JOURNAL = "run.json"
SAME_SET = ("key_sha256", "recordings_sha256")
SAME_ENGINE = ("source_sha256", "versions")


class Journal:
    """`run.json` of a folder of diagnoses; begun, or gone on with.

    All diagnoses of a folder are of one set and by one engine: the files that make it, whatever
    commit they are of. Every start of the run is a session of its own.

    Args:
      folder: of the diagnoses.
      commitment: of the set.

    Raises:
      InputError: the folder holds something else, or diagnoses of another set or engine.
    """

    def __init__(self, folder: Path, commitment: Mapping[str, Any]) -> None:
        self.folder = folder
        self.engine = engine(ALSO)
        of_set = {name: commitment.get(name) for name in SAME_SET}
        told = read_journal(folder)
        if told is None:
            if {file.name for file in folder.iterdir()} - {LOCK}:
                raise InputError(f"{folder}: not empty, and no {JOURNAL} in it; use another folder")
            told = {"schema": 1, "set": of_set, "engine": self.engine, "sessions": []}
        if told["set"] != of_set:
            raise InputError(f"{folder}: holds diagnoses of another set; use another folder")
        if any(told["engine"].get(n) != self.engine[n] for n in SAME_ENGINE):
            by = told["engine"].get("git_sha") or "no commit"
            raise InputError(
                f"{folder}: holds diagnoses by another engine ({by}, and its files or packages "
                "have changed since); use another folder"
            )
        self._told = told

    def document(self) -> dict[str, Any]:
        """What is written."""
        return dict(self._told)

    @contextmanager
    def session(self, lanes: int, failed: Mapping[str, str]) -> Iterator[None]:
        """A start of the run; it has no end if it was killed.

        Args:
          lanes: cases at once.
          failed: filled meanwhile with the cases that fail and why.
        """
        session = {
            "started": now(),
            "ended": None,
            "git_sha": self.engine["git_sha"],
            "dirty": self.engine["dirty"],
            "host": platform.node(),
            "process": os.getpid(),
            "cases_at_once": lanes,
        }
        self._told["sessions"].append(session)
        self._write()
        try:
            yield
        finally:
            # Processes started later than this one have imported what stood there then.
            changed = engine(ALSO)["source_sha256"] != self.engine["source_sha256"]
            session |= {
                "ended": now(),
                "source_changed": changed,
                "failed": dict(sorted(failed.items())),
            }
            self._write()

    def seal(self, case: str) -> None:
        """Note the digest of a case's diagnosis, just written."""
        digests = self._told.setdefault("diagnoses", {})
        digests[case] = sha256(self.folder / case / DIAGNOSIS)
        self._write()

    def _write(self) -> None:
        write_json(self.folder / JOURNAL, self._told)


def read_journal(folder: Path) -> dict[str, Any] | None:
    """The journal of a folder of diagnoses; None where there is none.

    Raises:
      InputError: the file is no journal.
    """
    file = folder / JOURNAL
    if not file.is_file():
        return None
    told = read_json(file)
    known = {"set": dict, "engine": dict, "sessions": list}
    if (
        not isinstance(told, dict)
        or told.get("schema") != 1
        or any(not isinstance(told.get(name), kind) for name, kind in known.items())
    ):
        raise InputError(f"{file}: not the journal of a run over a blind set (schema 1)")
    return told


def doubts(
    folder: Path, journal: Mapping[str, Any], commitment: Mapping[str, Any]
) -> Iterator[str]:
    """What in a folder of diagnoses is not as a proof has it, a line each.

    Args:
      folder: of the diagnoses.
      journal: its journal; what one of an earlier run does not tell is not checked.
      commitment: of the set.
    """
    frozen, sessions = commitment.get("engine_git_sha"), journal["sessions"]
    by = {journal["engine"].get("git_sha"), *(session.get("git_sha") for session in sessions)}
    others = sorted(str(sha) for sha in by - {None, frozen})
    if frozen and others:
        yield f"The set is committed to engine {frozen}; diagnosed by {', '.join(others)}."
    if any(session.get("source_changed") for session in sessions):
        yield "Files of the engine were changed while it diagnosed."
    edited = [
        case
        for case, digest in journal.get("diagnoses", {}).items()
        if (folder / case / DIAGNOSIS).is_file() and sha256(folder / case / DIAGNOSIS) != digest
    ]
    if edited:
        yield f"Edited since they were written: the diagnoses of {', '.join(sorted(edited))}."
