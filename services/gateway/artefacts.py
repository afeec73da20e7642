"""Documents that jobs wrote into shared storage, read for the pages: within limits, and cached."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path, PurePosixPath
from typing import Generic, TypeVar

from pydantic import ValidationError

from pup.errors import InputError
from services.gateway.documents import (
    BoundsDocument,
    DiagnosisDocument,
    Document,
    TrainingDocument,
)
from services.gateway.jobs import Job
from services.job_folder import JobFolder, folder_of

T = TypeVar("T", bound=Document)

LIMIT = 8 * 2**20
"""Of a document, bytes."""
STAGES = 50
"""Folders of a job that are looked into."""
LISTED = 100
"""Documents in a list."""
REPORT = "report.html"


@dataclass(frozen=True)
class Kind(Generic[T]):
    """A kind of document.

    Attributes:
      title: of its pages.
      path: of them.
      file: its name.
      shape: of its content.
      verbs: that write it; the first one does nothing else.
    """

    title: str
    path: str
    file: str
    shape: type[T]
    verbs: tuple[str, ...]


BOUNDS = Kind("Bounds", "bounds", "bounds.json", BoundsDocument, ("presysid", "run"))
TRAINING = Kind("Training", "training", "training.json", TrainingDocument, ("train", "run"))
DIAGNOSES = Kind("Diagnoses", "diagnoses", "diagnosis.json", DiagnosisDocument, ("diagnose", "run"))
KINDS = (BOUNDS, TRAINING, DIAGNOSES)


@dataclass(frozen=True)
class Artefact(Generic[T]):
    """A document of a job.

    Attributes:
      job: that wrote it.
      name: of the artefact; empty while there is none.
      document: what it tells; None where it cannot be shown.
      trouble: why not, in one line.
      report: name of the report beside it, or empty.
    """

    job: Job
    name: str = ""
    document: T | None = None
    trouble: str = ""
    report: str = ""


def of_jobs(kind: Kind[T], jobs: Iterable[Job], shared: Path) -> list[Artefact[T]]:
    """The newest documents of a kind; a job that is to write one and has not is told too.

    Args:
      kind: of document.
      jobs: newest first.
      shared: root of the shared storage.
    """

    def told() -> Iterator[Artefact[T]]:
        for job in jobs:
            if job.verb not in kind.verbs:
                continue
            found = of_job(kind, job, shared)
            if not found and job.open and job.verb == kind.verbs[0]:
                yield Artefact(job)
            yield from found

    return list(islice(told(), LISTED))


def of_job(kind: Kind[T], job: Job, shared: Path) -> list[Artefact[T]]:
    """The documents of a kind that a job wrote: into its folder, or into those of its stages."""
    folder = folder_of(shared, job.id)
    return [_artefact(kind, job, folder, name) for name in _names(folder, kind.file)]


def ways(job: Job, shared: Path) -> list[tuple[str, str]]:
    """Titles and paths of the pages that show what a job wrote.

    Args:
      job: the job.
      shared: root of the shared storage.
    """
    folder = folder_of(shared, job.id)
    told = [(kind.title, f"/{kind.path}/{job.id}") for kind in KINDS if _names(folder, kind.file)]
    return told + ([("Report", f"/reports/{job.id}/{REPORT}")] if folder.file(REPORT) else [])


def _names(folder: JobFolder, file: str) -> list[str]:
    try:
        with os.scandir(folder.out) as entries:
            stages = sorted(e.name for e in entries if e.is_dir(follow_symlinks=False))
    except OSError:
        return []
    names = [file, *(f"{stage}/{file}" for stage in stages[:STAGES])]
    return [name for name in names if folder.file(name)]


def _artefact(kind: Kind[T], job: Job, folder: JobFolder, name: str) -> Artefact[T]:
    report = str(PurePosixPath(name).with_name(REPORT))
    beside = report if folder.file(report) else ""
    try:
        return Artefact(job, name, read(folder.out / name, kind.shape), report=beside)
    except InputError as error:
        return Artefact(job, name, trouble=f"{name} cannot be shown: {error}", report=beside)


def read(path: Path, shape: type[T]) -> T:
    """Read a document; one that did not change since is not read again.

    Raises:
      InputError: it cannot be read or is not of the shape; the message is one line.
    """
    try:
        status = path.stat()
        if status.st_size > LIMIT:
            raise InputError(f"larger than {LIMIT} bytes")
        return _read(path, shape, status.st_mtime_ns, status.st_size)
    except OSError as error:
        raise InputError(error.strerror or "it cannot be read") from error


@lru_cache(maxsize=3 * LISTED)
def _read(path: Path, shape: type[T], modified: int, size: int) -> T:
    try:
        return shape.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        place = ".".join(map(str, first["loc"]))
        told = f"{place}: {first['msg']}" if place else first["msg"]
        raise InputError(told.replace("\n", " ")[:300]) from error
