"""The pages of what was found: recordings, bounds, training curves, diagnoses, and their reports.

All is read from shared storage and from the folders of recordings, never written.
"""

import asyncio
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, TypeVar
from urllib.parse import quote

from fastapi import APIRouter, HTTPException, Query, Request
from fastapi.responses import RedirectResponse, Response
from markupsafe import Markup

from pup.errors import InputError
from services.gateway import artefacts, charts
from services.gateway.access import asking
from services.gateway.answers import FileAnswer, conductor_of
from services.gateway.artefacts import BOUNDS, DIAGNOSES, TRAINING, Artefact, Kind
from services.gateway.documents import Document
from services.gateway.html import login, page, part
from services.gateway.job_routes import dispatcher_of
from services.gateway.jobs import Job
from services.gateway.recordings import LOOKED, Shelves
from services.gateway.storage import on_storage

T = TypeVar("T", bound=Document)
V = TypeVar("V")

SANDBOX = (
    "sandbox allow-same-origin allow-downloads; default-src 'none'; img-src data:; "
    "style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""For reports, which somebody may have put there who can write to shared storage alone: no script,
no form, nothing from anywhere. Of the same origin, so that their links bring the cookie along."""

Skip = Annotated[int, Query(ge=0, le=LOOKED, description="Recordings before the page.")]
router = APIRouter(include_in_schema=False)


@dataclass(frozen=True)
class Tile:
    """A way to pages, on the first one.

    Attributes:
      title: of the pages.
      path: of them.
      count: how many there are, in words.
      newest: in words.
    """

    title: str
    path: str
    count: str
    newest: str = ""


@router.get("/")
async def start(request: Request) -> Response:
    """The way to everything."""
    if (user := asking(request)) is None:
        return login()
    conductor, jobs = conductor_of(request), dispatcher_of(request).newest()
    agents = conductor.admitted
    tiles = [
        await on_storage(_recordings_tile, _shelves(request)),
        _tile(BOUNDS, await _documents(request, BOUNDS)),
        _tile(TRAINING, await _documents(request, TRAINING)),
        Tile("Studies", "/studies", _counted(s.state for s in conductor.studies.values())),
        _tile(DIAGNOSES, await _documents(request, DIAGNOSES)),
        Tile("Jobs", "/jobs", _counted(job.state for job in jobs)),
        Tile("Agents", "/agents", _counted("here" if a.present else "away" for a in agents)),
    ]
    return page("start.html", request, user, tiles=tiles)


@router.get("/recordings")
async def recordings(request: Request) -> Response:
    """All recordings."""
    if (user := asking(request)) is None:
        return login()
    shelves = _shelves(request)
    told = [await on_storage(shelves.listed, name) for name in shelves.folders]
    return page("recordings.html", request, user, shelves=told)


@router.get("/recordings/{shelf:name}")
async def shelf_of_recordings(request: Request, shelf: str, skip: Skip = 0) -> Response:
    """The recordings of a folder, a page at a time."""
    if (user := asking(request)) is None:
        return login()
    told = await on_storage(_shelves(request).listed, shelf, skip)
    return page("recordings.html", request, user, shelves=[told])


@router.get("/recordings/{shelf:name}/{name:path}")
async def one_recording(request: Request, shelf: str, name: str) -> Response:
    """A recording: command, position and current of each joint."""
    if (user := asking(request)) is None:
        return login()
    shelves = _shelves(request)
    file = await on_storage(shelves.file, shelf, name)
    try:
        found = await shelves.read(file)
    except InputError as error:
        told = {"name": name, "trouble": str(error)}
        return page("recording.html", request, user, recording=None, **told)
    joints = found.joints[: charts.JOINTS]

    def drawn() -> list[tuple[str, list[Markup]]]:
        return [(n, [Markup(s) for s in charts.joint(found, j)]) for j, n in enumerate(joints)]

    return page(
        "recording.html",
        request,
        user,
        name=name,
        recording=found,
        duration=found.time[-1] - found.time[0],
        joints=await asyncio.to_thread(drawn),
        currents=any(column.startswith("current/") for column in found.extras),
        more=len(found.joints) - len(joints),
    )


@router.get("/bounds")
async def all_bounds(request: Request) -> Response:
    """What pre-sysID found, newest first."""
    return await _list(request, BOUNDS)


@router.get("/bounds/{job:name}")
async def one_bounds(request: Request, job: str) -> Response:
    """The bounds of a job."""
    if (user := asking(request)) is None:
        return login()
    found = await _of_job(request, BOUNDS, job)
    told = await _drawn(found, lambda d: [(p, charts.bounds(p, d)) for p in d.parameters])
    return page("bounds_one.html", request, user, job=_job(request, job), bounds=told)


@router.get("/training")
@router.get("/training/live")
async def trainings(request: Request) -> Response:
    """Trainings, newest first; `live` is the part that changes."""
    return await _list(request, TRAINING)


@router.get("/training/{job:name}")
@router.get("/training/{job:name}/live")
async def one_training(request: Request, job: str) -> Response:
    """The curves of a job; `live` is the part that changes."""
    if (user := asking(request)) is None:
        return login()
    found = await _of_job(request, TRAINING, job)
    name = part(request, "training_one.html", "training_one_live.html")
    told = await _drawn(found, lambda d: charts.curves(d.curve))
    line = await on_storage(dispatcher_of(request).folder(job).last_line)
    return page(name, request, user, job=_job(request, job), trainings=told, line=line)


@router.get("/diagnoses")
async def diagnoses(request: Request) -> Response:
    """Verdicts, newest first."""
    return await _list(request, DIAGNOSES)


@router.get("/diagnoses/{job:name}")
async def one_diagnosis(request: Request, job: str) -> Response:
    """The verdicts of a job."""
    if (user := asking(request)) is None:
        return login()
    found = await _of_job(request, DIAGNOSES, job)
    return page("diagnoses.html", request, user, found=found, job=_job(request, job))


@router.get("/reports/{job:name}/{name:path}")
async def report(request: Request, job: str, name: str) -> Response:
    """A report that a job wrote, as it is; other files that reports link to are downloads."""
    if asking(request) is None:
        return login()
    path = await on_storage(dispatcher_of(request).folder(job).file, name)
    if path is None:
        raise HTTPException(404, f"{job} has no artefact {name[:200]}")
    if path.suffix != ".html":
        return RedirectResponse(f"/v1/jobs/{job}/artifacts/{quote(name)}", 303)
    headers = {"Content-Security-Policy": SANDBOX}
    return FileAnswer(path, media_type="text/html; charset=utf-8", headers=headers)


async def _list(request: Request, kind: Kind[T]) -> Response:
    if (user := asking(request)) is None:
        return login()
    name = part(request, f"{kind.path}.html", f"{kind.path}_live.html")
    found = await _documents(request, kind)
    return page(name, request, user, found=found, most=artefacts.LISTED)


async def _documents(request: Request, kind: Kind[T]) -> list[Artefact[T]]:
    dispatcher = dispatcher_of(request)
    return await on_storage(artefacts.of_jobs, kind, dispatcher.newest(), dispatcher.shared)


async def _of_job(request: Request, kind: Kind[T], name: str) -> list[Artefact[T]]:
    dispatcher = dispatcher_of(request)
    job = dispatcher.job(name)
    return await on_storage(artefacts.of_job, kind, job, dispatcher.shared)


async def _drawn(
    found: Sequence[Artefact[T]], draw: Callable[[T], list[tuple[V, str]]]
) -> list[tuple[Artefact[T], list[tuple[V, Markup]]]]:
    """Documents with their pictures, which are made beside what others ask."""

    def drawn(document: T) -> list[tuple[V, Markup]]:
        return [(what, Markup(picture)) for what, picture in draw(document)]

    return await asyncio.to_thread(
        lambda: [(a, drawn(a.document) if a.document else []) for a in found]
    )


def _job(request: Request, name: str) -> Job:
    return dispatcher_of(request).job(name)


def _shelves(request: Request) -> Shelves:
    shelves: Shelves = request.app.state.shelves
    return shelves


def _counted(states: Iterable[str]) -> str:
    told = Counter(map(str, states))
    return ", ".join(f"{count} {state}" for state, count in told.most_common()) or "none yet"


def _recordings_tile(shelves: Shelves) -> Tile:
    robots = Counter[str]()
    told = [shelves.listed(name) for name in shelves.folders]
    for listing in told:
        robots.update(r.header.metadata["robot"] for r in listing.shown if r.header)
    named = ", ".join(f"{count} of {robot}" for robot, count in robots.most_common(5))
    total, shown = sum(one.total for one in told), sum(one.end for one in told)
    count = f"{total}{'' if all(one.all_found for one in told) else ' or more'}"
    newest = named if shown == total else f"of {shown} looked at: {named}"
    return Tile("Recordings", "/recordings", count, newest)


def _tile(kind: Kind[T], found: Sequence[Artefact[T]]) -> Tile:
    newest = (f"{a.document.robot}: {a.document.summary}" for a in found if a.document)
    count = sum(bool(a.name) for a in found)
    return Tile(kind.title, f"/{kind.path}", f"{count or 'none yet'}", next(newest, ""))
