"""The pages of what goes on: studies, jobs, one of them, agents. Nothing comes from elsewhere."""

import logging
import math
from pathlib import Path
from urllib.parse import parse_qs

from fastapi import APIRouter, Request
from fastapi.responses import RedirectResponse, Response
from markupsafe import Markup

from services.gateway import drawing, job_routes, names  # noqa: F401 - names makes {study:name} known
from services.gateway.access import COOKIE, asking
from services.gateway.artefacts import ways
from services.gateway.conductor import Conductor
from services.gateway.dispatcher import NoJobsError
from services.gateway.html import login, page, part
from services.gateway.keys import Tokens
from services.gateway.posteriors import NOTHING
from services.gateway.records import study_document, trial_document
from services.gateway.storage import on_storage

log = logging.getLogger(__name__)

STATIC = Path(__file__).parent / "static"
YEAR = 365 * 86400
FORM_LIMIT = 1024
"""Of a form, bytes."""
PATIENCE = 1.0
"""For the Gaussian process: the gate must be shown soon, s."""
SHOWN = 60
"""Numbers of an agent's health on its card."""
JOBS, ARTIFACTS, LOG = 100, 100, 6000
"""Jobs on their page; files and last bytes of the log on the page of one."""

router = APIRouter(include_in_schema=False)


@router.get("/login")
async def ask(request: Request) -> Response:
    """Asks for a token."""
    return page("login.html", request, None, wrong=False)


@router.post("/login")
async def enter(request: Request) -> Response:
    """Keeps the token as a cookie that scripts cannot read and other sites cannot send."""
    form = parse_qs((await request.body())[:FORM_LIMIT].decode(errors="replace"))
    token = form.get("token", [""])[0].strip()
    tokens: Tokens = request.app.state.tokens
    if tokens.user(token) is None:
        return page("login.html", request, None, 401, wrong=True)
    response = RedirectResponse("/", 303)
    secure = request.url.scheme == "https"
    response.set_cookie(COOKIE, token, YEAR, httponly=True, samesite="strict", secure=secure)
    return response


@router.post("/logout")
async def leave() -> Response:
    """Forgets the token."""
    response = RedirectResponse("/login", 303)
    response.delete_cookie(COOKIE)
    return response


@router.get("/studies")
async def studies(request: Request) -> Response:
    """All studies."""
    if (user := asking(request)) is None:
        return login()
    conductor: Conductor = request.app.state.conductor
    told = [
        study_document(study) | {"waits_for": conductor.waits_for(study)}
        for study in reversed(conductor.studies.values())
    ]
    return page("studies.html", request, user, studies=told)


@router.get("/studies/{study:name}")
@router.get("/studies/{study:name}/live")
async def one(request: Request, study: str) -> Response:
    """A study; `live` is the part that changes."""
    if (user := asking(request)) is None:
        return login()
    conductor: Conductor = request.app.state.conductor
    found = conductor.study(study)
    try:
        posterior = await conductor.posterior(study, PATIENCE)
    except Exception as error:  # whoever holds the gate needs the page all the same
        log.error("no posterior", extra={"study": study}, exc_info=error)
        posterior = NOTHING
    trial, sample = found.open, None
    view = conductor.agents.get(trial.agent or "") if trial else None
    if view and trial and view.sample and view.sample.trial == trial.wire:
        sample = view.sample
    best = posterior["best"]
    silent = ""
    if view and not view.present:
        silent = f"for {view.silent:.0f} s" if math.isfinite(view.silent) else "yet"
    name = part(request, "study.html", "study_live.html")
    return page(
        name,
        request,
        user,
        study=study_document(found) | {"waits_for": conductor.waits_for(found)},
        trials=[trial_document(t) for t in reversed(found.trials)],
        trial=trial and trial_document(trial),
        sample=sample,
        silent=silent,
        best=best,
        progress=Markup(drawing.progress(found)),
        slices=[Markup(s) for s in drawing.slices(posterior, found)] if best else [],
    )


@router.get("/jobs")
@router.get("/jobs/live")
async def jobs(request: Request) -> Response:
    """Jobs, newest first; `live` is the part that changes."""
    if (user := asking(request)) is None:
        return login()
    dispatcher = job_routes.dispatcher_of(request)
    found = dispatcher.newest()
    told = [await job_routes.document(dispatcher, job) for job in found[:JOBS]]
    more = len(found) - len(told)
    name = part(request, "jobs.html", "jobs_live.html")
    return page(name, request, user, jobs=told, more=more, trouble=dispatcher.trouble)


@router.get("/jobs/{job:name}")
@router.get("/jobs/{job:name}/live")
async def one_job(request: Request, job: str) -> Response:
    """A job; `live` is the part that changes."""
    if (user := asking(request)) is None:
        return login()
    dispatcher = job_routes.dispatcher_of(request)
    found = dispatcher.job(job)
    try:
        files, more = await job_routes.artifacts(dispatcher, found, ARTIFACTS)
    except NoJobsError:  # the page says what the job waits for
        files, more = [], None
    name = part(request, "job.html", "job_live.html")
    return page(
        name,
        request,
        user,
        job=await job_routes.document(dispatcher, found),
        open=found.open,
        mine=job_routes.may(user, found),
        ways=await on_storage(ways, found, dispatcher.shared),
        artifacts=files,
        more=more,
        log=await on_storage(dispatcher.folder(job).tail, LOG),
    )


@router.get("/agents")
@router.get("/agents/live")
async def agents(request: Request) -> Response:
    """The agents and how they are; `live` is the part that changes."""
    if (user := asking(request)) is None:
        return login()
    conductor: Conductor = request.app.state.conductor
    told = [view.document() for view in conductor.admitted]
    for agent in told:
        agent["health"] = list(agent["health"].items())[:SHOWN]
    name = part(request, "agents.html", "agents_live.html")
    return page(name, request, user, agents=told)
