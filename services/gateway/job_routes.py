"""The REST interface of jobs: submit, watch, call off, fetch."""

import asyncio
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import suppress
from itertools import islice
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Path, Query, Request
from fastapi.responses import PlainTextResponse, Response, StreamingResponse
from pydantic import BaseModel, Field

from services.gateway import names
from services.gateway.access import IdempotencyKey, IdempotentRoute, asking, needs
from services.gateway.answers import FileAnswer, as_json, stream
from services.gateway.dispatcher import LIST, NO_STORAGE, Dispatcher, NoJobsError
from services.gateway.jobs import Job, JobState
from services.gateway.keys import Role, User
from services.gateway.problems import responses
from services.gateway.records import Row, job_document
from services.gateway.shapes import WITHOUT_FRACTION, Retry, Strict
from services.gateway.storage import on_storage
from services.job_arguments import COUNT, LENGTH, Verb
from services.job_folder import turn

CHUNK = 2**16
FOLLOW = 0.5
"""Between two looks at the log of a job that runs, s."""
SUBMITTED = "The job; the same request with its key is answered so again, but for its header."
KNOWN = "This key has a job, whose first answer is kept no longer: the job as it is now."
ARTIFACTS = 10_000
"""Artefacts of a job on a page of their list."""

JobName = Annotated[str, Path(pattern=names.WHOLE, description="Id of a job.")]
Viewer = Annotated[User, needs(Role.VIEWER)]
Operator = Annotated[User, needs(Role.OPERATOR)]
READ = responses(400, 401, 403, 404, 422)
FILES = responses(400, 401, 403, 404, 422, 503)
WRITE = responses(400, 401, 403, 404, 409, 411, 413, 422, 503)
router = APIRouter(prefix="/v1", route_class=IdempotentRoute)


class NewJob(Strict):
    """A job to run: a verb of the command line and what stands behind it."""

    verb: Verb
    arguments: Annotated[
        list[Annotated[str, Field(max_length=LENGTH)]],
        Field(max_length=COUNT, description="Paths are relative to the shared storage."),
    ] = Field([])
    cpus: Annotated[float, Field(gt=0, le=4096, allow_inf_nan=False)] = 1.0
    gpus: Annotated[float, Field(ge=0, le=64, allow_inf_nan=False)] = 0.0
    retries: Annotated[int, Field(ge=0, le=100), WITHOUT_FRACTION] = 3


class AttemptShape(BaseModel):
    """An attempt; times are seconds since 1970."""

    number: int
    asked: float
    known: bool
    started: float | None
    ended: float | None
    outcome: str


class JobShape(BaseModel):
    """A job."""

    id: str
    verb: str
    arguments: list[str]
    who: str
    created: float
    cpus: float
    gpus: float
    retries: int
    state: JobState
    reason: str
    cancelled_by: str
    failures: int
    attempts: list[AttemptShape]
    waits_for: str
    progress: str


class JobList(BaseModel):
    """A page of jobs, newest first; `next` goes on where it is given as `after`."""

    jobs: list[JobShape]
    next: str | None


class ArtifactShape(BaseModel):
    """A file that a job wrote; its SHA-256 once the job is done."""

    name: str
    bytes: int
    modified: float
    sha256: str | None


class ArtifactList(BaseModel):
    """A page of what a job wrote; `next` goes on where it is given as `after`."""

    artifacts: list[ArtifactShape]
    next: str | None


def dispatcher_of(request: Request) -> Dispatcher:
    """The jobs of the gateway that was asked."""
    dispatcher: Dispatcher = request.app.state.dispatcher
    return dispatcher


async def document(dispatcher: Dispatcher, job: Job) -> Row:
    """A job as it is told, with what it waits for and the last line that it said."""
    folder = dispatcher.folder(job.id)
    progress = await on_storage(folder.last_line)
    return job_document(job) | {"waits_for": dispatcher.waits_for(job), "progress": progress}


async def artifacts(
    dispatcher: Dispatcher, job: Job, limit: int = ARTIFACTS, after: str = ""
) -> tuple[list[Row], str | None]:
    """What a job wrote, a page at a time, and the last name of the page where there are more."""

    def told() -> Iterator[Row]:
        folder = dispatcher.folder(job.id)
        done = job.state is JobState.SUCCEEDED
        outcome = folder.outcome(job.last.number) if done else None
        digests = outcome.artifacts if outcome else {}
        for name, path in folder.files():
            if after and turn(name) <= turn(after):
                continue
            with suppress(OSError):  # it was removed since it was found
                status = path.stat()
                row = {"name": name, "bytes": status.st_size, "modified": status.st_mtime}
                yield row | {"sha256": digests.get(name)}

    found = await on_storage(lambda: list(islice(told(), limit + 1)))
    return found[:limit], found[limit - 1]["name"] if len(found) > limit else None


@router.get("/jobs", response_model=JobList, responses=READ)
async def list_jobs(
    request: Request,
    _: Viewer,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    after: Annotated[str, Query(max_length=64, description="The last id of the page before.")] = "",
    state: JobState | None = None,
) -> Response:
    """Jobs, newest first, a page at a time."""
    dispatcher = dispatcher_of(request)
    jobs = dispatcher.newest()
    if after:
        jobs = jobs[jobs.index(dispatcher.job(after)) + 1 :]
    jobs = [job for job in jobs if state in (None, job.state)]
    told = [await document(dispatcher, job) for job in jobs[:limit]]
    return as_json({"jobs": told, "next": jobs[limit - 1].id if len(jobs) > limit else None})


@router.post(
    "/jobs",
    status_code=201,
    response_model=JobShape,
    responses=WRITE
    | {201: {"description": SUBMITTED}, 200: {"description": KNOWN, "model": JobShape}},
)
async def submit_job(
    request: Request, user: Operator, wanted: NewJob, key: IdempotencyKey = None
) -> Response:
    """Run a verb on the cluster; the same key is one job, however often it is sent."""
    dispatcher = dispatcher_of(request)
    asked: dict[str, Any] = wanted.model_dump() | {"arguments": tuple(wanted.arguments)}
    job, new = await dispatcher.submit(Job("", who=user.name, created=time.time(), **asked), key)
    told = await document(dispatcher, job)
    return as_json(told, 201 if new else 200, Location=f"/v1/jobs/{job.id}")


@router.get("/jobs/{job:name}", response_model=JobShape, responses=READ)
async def get_job(request: Request, _: Viewer, job: JobName) -> Response:
    """One job."""
    dispatcher = dispatcher_of(request)
    return as_json(await document(dispatcher, dispatcher.job(job)))


@router.post("/jobs/{job:name}:cancel", response_model=JobShape, responses=WRITE)
async def cancel_job(
    request: Request, user: Operator, job: JobName, key: IdempotencyKey = None
) -> Response:
    """Call a job off: its processes end, what they wrote stays. Operators do so with their own."""
    dispatcher = dispatcher_of(request)
    _check(user, dispatcher.job(job))
    return as_json(await document(dispatcher, await dispatcher.cancel(job, user.name)))


@router.post("/jobs/{job:name}:retry", response_model=JobShape, responses=WRITE)
async def retry_job(
    request: Request, user: Operator, job: JobName, wanted: Retry, key: IdempotencyKey = None
) -> Response:
    """Attempt a job again that ended without a result; it resumes from its checkpoints.

    `attempt` is the number of the new attempt.
    """
    dispatcher = dispatcher_of(request)
    _check(user, dispatcher.job(job))
    again = await dispatcher.retry(job, wanted.attempt, user.name)
    return as_json(await document(dispatcher, again))


@router.get(
    "/jobs/{job:name}/logs",
    responses=FILES | {200: {"content": {"text/plain": {}}}},
    response_class=PlainTextResponse,
)
async def get_logs(
    request: Request,
    _: Viewer,
    job: JobName,
    offset: Annotated[int, Query(ge=0, le=2**53, description="First byte.")] = 0,
    follow: Annotated[bool, Query(description="Until the job has ended.")] = False,
) -> Response:
    """What a job said, in all its attempts, from a byte on."""
    dispatcher = dispatcher_of(request)
    dispatcher.job(job)
    if dispatcher.ray is None:  # an answer that has begun can say so no more
        raise NoJobsError(NO_STORAGE)

    async def told() -> AsyncIterator[bytes]:
        at, path = offset, dispatcher.folder(job).log
        while True:
            over = not dispatcher.job(job).open
            while chunk := await on_storage(_read, path, at):
                at += len(chunk)
                yield chunk
            if over or not follow or request.app.state.stopping or asking(request) is None:
                return
            await asyncio.sleep(FOLLOW)

    return StreamingResponse(told(), media_type="text/plain; charset=utf-8")


@router.get("/jobs/{job:name}/artifacts", response_model=ArtifactList, responses=FILES)
async def list_artifacts(
    request: Request,
    _: Viewer,
    job: JobName,
    limit: Annotated[int, Query(ge=1, le=ARTIFACTS)] = ARTIFACTS,
    after: Annotated[
        str, Query(max_length=4096, description="The last name of the page before.")
    ] = "",
) -> Response:
    """What a job wrote, a page at a time: files of a folder by name, then those of its folders."""
    dispatcher = dispatcher_of(request)
    told, more = await artifacts(dispatcher, dispatcher.job(job), limit, after)
    return as_json({"artifacts": told, "next": more})


@router.get(
    "/jobs/{job:name}/artifacts/{name:path}",
    responses=FILES | responses(416) | {200: {"content": {"application/octet-stream": {}}}},
    response_class=FileAnswer,
)
async def get_artifact(request: Request, _: Viewer, job: JobName, name: str) -> Response:
    """A file that a job wrote; ranges of bytes can be had."""
    folder = dispatcher_of(request).folder(job)
    path = await on_storage(folder.file, name)
    if path is None:
        raise HTTPException(404, f"{job} has no artefact {name[:200]}")
    return FileAnswer(path, media_type="application/octet-stream", filename=path.name)


@router.get(
    "/jobs/{job:name}/events",
    responses=READ | {200: {"content": {"text/event-stream": {}}}},
    response_class=StreamingResponse,
)
async def stream_job(request: Request, _: Viewer, job: JobName) -> Response:
    """Server-sent events: one whenever the job changed or said something."""
    dispatcher_of(request).job(job)
    return stream(request, LIST + job)


@router.get(
    "/jobs/-/events",
    responses=READ | {200: {"content": {"text/event-stream": {}}}},
    response_class=StreamingResponse,
)
async def stream_jobs(request: Request, _: Viewer) -> Response:
    """Server-sent events: one whenever a job changed."""
    return stream(request, LIST)


def may(user: User, job: Job) -> bool:
    """Whether a user may call a job off or try it again."""
    return user.role is Role.ADMIN or (user.role is Role.OPERATOR and user.name == job.who)


def _check(user: User, job: Job) -> None:
    if not may(user, job):
        raise HTTPException(403, f"{job.id} is {job.who}'s; the role admin is needed")


def _read(path: Any, at: int) -> bytes:
    try:
        with open(path, "rb") as file:
            file.seek(at)
            return file.read(CHUNK)
    except FileNotFoundError:
        return b""
