"""Errors as problem documents (RFC 9457)."""

import logging
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException
from starlette.routing import Match

from pup.errors import InputError
from pup.transfer.trial import TrialError, UnknownError
from services.gateway.dispatcher import NoJobsError
from services.gateway.posteriors import StoppingError
from services.gateway.store import ReplacedError

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"
METHODS = ("DELETE", "GET", "HEAD", "PATCH", "POST", "PUT")


class Problem(BaseModel):
    """What went wrong, as RFC 9457 has it."""

    type: str = "about:blank"
    title: str
    status: int
    detail: str = ""
    instance: str = ""


def problem(status: int, detail: str, request: Request, **headers: str) -> JSONResponse:
    """A problem as a response."""
    told = Problem(
        title=HTTPStatus(status).phrase,
        status=status,
        detail=detail,
        instance=request.url.path,
    )
    return JSONResponse(told.model_dump(), status, headers, media_type=MEDIA_TYPE)


def responses(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """For OpenAPI: that these may come, as problems."""
    schema = {"schema": {"$ref": "#/components/schemas/Problem"}}
    return {
        status: {"description": HTTPStatus(status).phrase, "content": {MEDIA_TYPE: schema}}
        for status in statuses
    }


def _allowed(request: Request) -> list[str]:
    """Methods that some route takes at a path; the framework tells those of the first one alone."""

    def taken(method: str) -> bool:
        scope = {**request.scope, "method": method}
        return any(route.matches(scope)[0] is Match.FULL for route in request.app.routes)

    return [method for method in METHODS if taken(method)]


def handle(app: FastAPI) -> None:
    """Let an application tell its errors so."""

    @app.exception_handler(HTTPException)
    async def of_http(request: Request, error: HTTPException) -> JSONResponse:
        headers = dict(error.headers or {})
        if error.status_code == 405:
            headers["Allow"] = ", ".join(_allowed(request))
        return problem(error.status_code, str(error.detail), request, **headers)

    @app.exception_handler(RequestValidationError)
    async def of_validation(request: Request, error: RequestValidationError) -> JSONResponse:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"])
        return problem(422, f"{place}: {first['msg']}", request)

    @app.exception_handler(UnknownError)
    async def of_unknown(request: Request, error: UnknownError) -> JSONResponse:
        return problem(404, str(error), request)

    @app.exception_handler(TrialError)
    async def of_trial(request: Request, error: TrialError) -> JSONResponse:
        return problem(409, str(error), request)

    @app.exception_handler(NoJobsError)
    async def of_jobs(request: Request, error: NoJobsError) -> JSONResponse:
        return problem(503, str(error), request)

    @app.exception_handler(StoppingError)
    async def of_stopping(request: Request, error: StoppingError) -> JSONResponse:
        return problem(503, str(error), request, **{"Retry-After": "5"})

    @app.exception_handler(ReplacedError)
    async def of_replaced(request: Request, error: ReplacedError) -> JSONResponse:
        return problem(503, str(error), request, **{"Retry-After": "1"})

    @app.exception_handler(SQLAlchemyError)
    async def of_database(request: Request, error: SQLAlchemyError) -> JSONResponse:
        log.error("database failed", extra={"path": request.url.path}, exc_info=error)
        told = "the database takes nothing now; try again"
        return problem(503, told, request, **{"Retry-After": "1"})

    @app.exception_handler(InputError)
    async def of_input(request: Request, error: InputError) -> JSONResponse:
        return problem(422, str(error), request)

    @app.exception_handler(Exception)
    async def of_any(request: Request, error: Exception) -> JSONResponse:
        log.error("request failed", extra={"path": request.url.path}, exc_info=error)
        return problem(500, "see the gateway's log", request)
