"""The REST interface of docs/gateway.md, and what hangs together with it."""

import time
from dataclasses import fields
from functools import partial
from importlib.metadata import version
from typing import Annotated, Any

from fastapi import APIRouter, FastAPI, HTTPException, Path, Query, Request
from fastapi.responses import PlainTextResponse, Response, StreamingResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from pup.transfer import orders
from pup.transfer.study import Study, StudySettings
from services.gateway import job_routes, lab_pages, names, pages, problems, stops
from services.gateway.access import (
    BODY_LIMIT,
    CHALLENGE,
    UNKNOWN,
    IdempotencyKey,
    IdempotentRoute,
    asking,
    needs,
)
from services.gateway.answers import as_json, conductor_of, stream
from services.gateway.conductor import Conductor
from services.gateway.dispatcher import Dispatcher
from services.gateway.keys import Role, Tokens, User
from services.gateway.link import Link
from services.gateway.metrics import Metrics
from services.gateway.problems import problem, responses
from services.gateway.recordings import Shelves
from services.gateway.records import settings_of, study_document, trial_document
from services.gateway.shapes import (
    AgentList,
    EventList,
    NewStudy,
    Posterior,
    Reason,
    Retry,
    StudyList,
    StudyShape,
    TrialList,
    TrialShape,
    reason_in,
    reason_or_none,
)
from services.gateway.store import Store

StudyName = Annotated[str, Path(pattern=names.WHOLE, description="Name of a study.")]
AgentName = Annotated[str, Path(pattern=names.WHOLE, description="Name of an agent.")]
Number = Annotated[int, Path(ge=1, le=10**9, description="Of a trial in its study, from 1.")]
Limit = Annotated[int, Query(ge=1, le=1000)]
After = Annotated[str, Query(max_length=64, description="The last name of the page before.")]
Viewer = Annotated[User, needs(Role.VIEWER)]
Operator = Annotated[User, needs(Role.OPERATOR)]

READ = responses(400, 401, 403, 404, 422)
STOP = responses(400, 401, 403, 404, 409, 411, 413, 422)
DATABASE = responses(503)
WRITE = STOP | DATABASE
v1 = APIRouter(prefix="/v1", route_class=IdempotentRoute)
emergency = APIRouter(prefix="/v1")
"""What must not wait for the database; done twice it does no harm."""


def application(
    store: Store,
    tokens: Tokens,
    conductor: Conductor,
    dispatcher: Dispatcher,
    link: Link | None,
    shelves: Shelves | None = None,
) -> FastAPI:
    """The web application of a gateway.

    Args:
      store: of what must not be forgotten.
      tokens: who may ask.
      conductor: of the studies.
      dispatcher: of the jobs.
      link: to the agents; None where only the interface is wanted.
      shelves: recordings that pages show.
    """
    app = FastAPI(
        title="pup",
        version=version("pup"),
        description="Jobs on a cluster; transfer of policies to robots: studies, trials, agents.",
        docs_url=None,  # its page loads scripts from elsewhere
        redoc_url=None,
    )
    app.state.store, app.state.tokens, app.state.locks = store, tokens, {}
    app.state.conductor, app.state.dispatcher = conductor, dispatcher
    app.state.link, app.state.stopping = link, False
    app.state.shelves = shelves or Shelves({})
    app.include_router(v1)
    app.include_router(emergency)
    app.include_router(job_routes.router)
    app.include_router(_service())
    app.include_router(pages.router)
    app.include_router(lab_pages.router)
    app.mount("/static", StaticFiles(directory=pages.STATIC), name="static")
    problems.handle(app)
    app.add_middleware(_Guard, metrics=conductor.metrics)
    made = app.openapi

    def openapi() -> dict[str, Any]:
        told = made()
        schemas = told.setdefault("components", {}).setdefault("schemas", {})
        schemas.setdefault("Problem", problems.Problem.model_json_schema())
        return told

    app.openapi = openapi  # type: ignore[method-assign]  # as FastAPI wants it
    return app


class _Guard:
    """Refuses bodies that are too large, measures, and forbids browsers what pages do not need.

    Plain ASGI: the framework's own kind of middleware takes as long as a whole answer.
    """

    HEADERS = (
        (b"x-content-type-options", b"nosniff"),
        (b"referrer-policy", b"no-referrer"),
        (b"cache-control", b"no-store"),
        (
            b"content-security-policy",
            b"default-src 'self'; frame-ancestors 'none'; base-uri 'none'; form-action 'self'",
        ),
    )

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app, self.metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        began, method = time.perf_counter(), scope["method"]

        async def sending(message: Message) -> None:
            if message["type"] == "http.response.start":
                told = list(message.get("headers", ()))
                own = {name for name, _ in told}  # a report has a policy of its own
                message["headers"] = told + [h for h in self.HEADERS if h[0] not in own]
                spent = time.perf_counter() - began
                self.metrics.requests.labels(method, message["status"]).observe(spent)
            await send(message)

        refusal = self._refusal(scope)
        await (refusal or self.app)(scope, receive, sending)

    def _refusal(self, scope: Scope) -> Response | None:
        told = dict(scope["headers"])
        length = told.get(b"content-length", b"0")  # without one, and not chunked: no body
        if b"transfer-encoding" in told or not length.isdigit():
            return problem(411, "a Content-Length is needed", Request(scope))
        if int(length) > BODY_LIMIT:
            return problem(413, f"more than {BODY_LIMIT} bytes", Request(scope))
        if scope["path"] == "/login" and int(length) > pages.FORM_LIMIT:  # anybody may send it
            return problem(413, f"more than {pages.FORM_LIMIT} bytes", Request(scope))
        reads = scope["path"].startswith("/v1/") and scope["method"] == "POST"
        if reads and asking(Request(scope)) is None:  # a body of a stranger is not even read
            return problem(401, UNKNOWN, Request(scope), **CHALLENGE)
        return None


@v1.get("/studies", response_model=StudyList, responses=READ)
async def list_studies(
    request: Request, _: Viewer, limit: Limit = 100, after: After = ""
) -> Response:
    """Studies by name, a page at a time."""
    studies = conductor_of(request).studies
    names = sorted(name for name in studies if name > after)
    told = [study_document(studies[name]) for name in names[:limit]]
    return as_json({"studies": told, "next": names[limit - 1] if len(names) > limit else None})


@v1.post(
    "/studies",
    status_code=201,
    response_model=StudyShape,
    responses=WRITE | {200: {"description": "There is one like it: joined.", "model": StudyShape}},
)
async def create_study(
    request: Request, user: Operator, wanted: NewStudy, key: IdempotencyKey = None
) -> Response:
    """Make a study, or join one of the same name and settings."""
    known = {f.name for f in fields(StudySettings)}
    told = {k: v for k, v in wanted.model_dump(mode="json").items() if k in known}
    settings = settings_of(told)
    simulated = wanted.simulated.checked(len(settings.lower)) if wanted.simulated else None
    study, new = await conductor_of(request).create(wanted.name, settings, simulated, user.name)
    place = f"/v1/studies/{study.name}"
    return as_json(study_document(study), 201 if new else 200, Location=place)


@v1.get("/studies/{study:name}", response_model=StudyShape, responses=READ)
async def get_study(request: Request, _: Viewer, study: StudyName) -> Response:
    """One study."""
    conductor = conductor_of(request)
    found = conductor.study(study)
    return as_json(study_document(found) | {"waits_for": conductor.waits_for(found)})


@v1.get("/studies/{study:name}/trials", response_model=TrialList, responses=READ)
async def list_trials(
    request: Request,
    _: Viewer,
    study: StudyName,
    limit: Limit = 1000,
    after: Annotated[int, Query(ge=0, le=10**9)] = 0,
) -> Response:
    """Trials of a study by number."""
    trials = conductor_of(request).study(study).trials[after:]
    told = [trial_document(t) for t in trials[:limit]]
    return as_json({"trials": told, "next": after + limit if len(trials) > limit else None})


@v1.get("/studies/{study:name}/posterior", response_model=Posterior, responses=READ)
async def get_posterior(request: Request, _: Viewer, study: StudyName) -> Response:
    """The Gaussian process: what would be chosen now, and slices through it."""
    return as_json(await conductor_of(request).posterior(study))


@v1.get("/studies/{study:name}/history", response_model=EventList, responses=READ | DATABASE)
async def list_events(
    request: Request,
    _: Viewer,
    study: StudyName,
    limit: Limit = 1000,
    after: Annotated[int, Query(ge=0, le=2**53)] = 0,
) -> Response:
    """What happened and why: decisions with their reasons, reports, orders."""
    conductor_of(request).study(study)
    store: Store = request.app.state.store
    told = await store.events(study, after, limit)
    return as_json({"events": told, "next": told[-1]["id"] if len(told) == limit else None})


@v1.get(
    "/studies/{study:name}/events",
    responses=READ | {200: {"content": {"text/event-stream": {}}}},
    response_class=StreamingResponse,
)
async def stream_study(request: Request, _: Viewer, study: StudyName) -> Response:
    """Server-sent events: one whenever the study changed, with its revision."""
    conductor_of(request).study(study)
    return stream(request, study)


@v1.post("/studies/{study:name}:pause", response_model=StudyShape, responses=WRITE)
async def pause_study(
    request: Request, user: Operator, study: StudyName, why: Reason, key: IdempotencyKey = None
) -> Response:
    """Make no more trials and hand none out; the one that an agent has ends as it may."""
    order = partial(orders.pause, reason=f"{user.name}: {why.reason}")
    return as_json(
        study_document(await conductor_of(request).change(study, user.name, order, "paused"))
    )


@v1.post("/studies/{study:name}:resume", response_model=StudyShape, responses=WRITE)
async def resume_study(
    request: Request, user: Operator, study: StudyName, key: IdempotencyKey = None
) -> Response:
    """Make trials again; robots that were stopped may walk for the study again."""
    conductor = conductor_of(request)
    told = await conductor.go_on(study, user.name, orders.resume, "resumed")
    return as_json(study_document(told))


@v1.post(
    "/studies/{study:name}/trials/{number:nth}:release",
    response_model=TrialShape,
    responses=WRITE,
)
async def release_trial(
    request: Request, user: Operator, study: StudyName, number: Number, key: IdempotencyKey = None
) -> Response:
    """Let a trial go to the robot."""
    order = partial(orders.release, number=number)
    told = await conductor_of(request).change(study, user.name, order, "released")
    return _trial(told, number)


@v1.post(
    "/studies/{study:name}/trials/{number:nth}:retry", response_model=TrialShape, responses=WRITE
)
async def retry_trial(
    request: Request,
    user: Operator,
    study: StudyName,
    number: Number,
    wanted: Retry,
    key: IdempotencyKey = None,
) -> Response:
    """Run an aborted or lost trial again; `attempt` is the number of the new attempt."""
    order = partial(orders.retry, number=number, attempt=wanted.attempt)
    told = await conductor_of(request).go_on(study, user.name, order, "retried")
    return _trial(told, number)


@v1.post(
    "/studies/{study:name}/trials/{number:nth}:cancel", response_model=TrialShape, responses=WRITE
)
async def cancel_trial(
    request: Request, user: Operator, study: StudyName, number: Number, key: IdempotencyKey = None
) -> Response:
    """Take a trial back, or ask its agent to stop it; the study pauses."""
    return _trial(await conductor_of(request).cancel(study, number, user.name), number)


@v1.post(
    "/studies/{study:name}/trials/{number:nth}:void", response_model=TrialShape, responses=WRITE
)
async def void_trial(
    request: Request,
    user: Operator,
    study: StudyName,
    number: Number,
    why: Reason,
    key: IdempotencyKey = None,
) -> Response:
    """Let a walk not count after all; the study pauses, and chooses anew what it chose by it."""
    reason = f"made void by {user.name}: {why.reason}"
    order = partial(orders.void, number=number, reason=reason)
    told = await conductor_of(request).change(study, user.name, order, "voided")
    return _trial(told, number)


def _trial(study: Study, number: int) -> Response:
    return as_json(trial_document(study.trial(number)))


@v1.get("/agents", response_model=AgentList, responses=responses(401, 403))
async def list_agents(request: Request, _: Viewer) -> Response:
    """Agents that are let in, and how they are."""
    return as_json({"agents": [view.document() for view in conductor_of(request).admitted]})


@v1.get(
    "/agents/-/events",
    responses=READ | {200: {"content": {"text/event-stream": {}}}},
    response_class=StreamingResponse,
)
async def stream_agents(request: Request, _: Viewer) -> Response:
    """Server-sent events: one whenever an agent was heard, at most one a second."""
    return stream(request, "")


@emergency.post(
    "/agents/{agent:name}:stop", status_code=202, responses=STOP, openapi_extra=reason_or_none()
)
async def stop_agent(
    request: Request, user: Operator, agent: AgentName, key: IdempotencyKey = None
) -> Response:
    """Emergency stop by message; the switch at the robot is faster. Each request sends one.

    It needs no body, and none keeps it from stopping. The answer's `unwritten` tells what could not
    be written within 2 s.
    """
    reason = reason_in(await request.body())
    unwritten = await stops.stop(conductor_of(request), agent, user.name, reason)
    return as_json({"stopped": agent, "unwritten": unwritten}, 202)


def _service() -> APIRouter:
    router = APIRouter(tags=["service"])

    @router.get("/healthz", response_class=PlainTextResponse)
    async def healthz() -> str:
        """Whether the process runs."""
        return "ok\n"

    @router.get("/readyz", response_class=PlainTextResponse, responses=responses(503))
    async def readyz(request: Request) -> str:
        """Whether agents can connect and the database takes writes."""
        link: Link | None = request.app.state.link
        if link is not None and not link.bound:
            raise HTTPException(503, "the link is not bound")
        if not await request.app.state.store.writable():
            raise HTTPException(503, "the database takes no writes")
        return "ready\n"

    @router.get("/metrics", response_class=PlainTextResponse, responses=responses(401, 403))
    async def metrics(request: Request, _: Viewer) -> Response:
        """For Prometheus."""
        conductor = conductor_of(request)
        conductor.measure()
        request.app.state.dispatcher.measure()
        return Response(generate_latest(conductor.metrics.registry), 200, {}, CONTENT_TYPE_LATEST)

    return router
