"""What routes answer with, and what they ask."""

import asyncio
import json
from collections.abc import AsyncIterator
from typing import Any

from fastapi import HTTPException, Request
from fastapi.responses import FileResponse, Response, StreamingResponse
from starlette.types import Message, Receive, Scope, Send

from services.gateway.access import asking
from services.gateway.conductor import Conductor

STREAM = 15.0
"""Between two signs of life of a stream of events, s."""


def conductor_of(request: Request) -> Conductor:
    """The studies of the gateway that was asked."""
    conductor: Conductor = request.app.state.conductor
    return conductor


def as_json(value: Any, status: int = 200, **headers: str) -> Response:
    """A JSON value as an answer."""
    body = json.dumps(value, allow_nan=False, separators=(",", ":")).encode()
    return Response(body, status, headers, "application/json")


class FileAnswer(FileResponse):
    """A file, or a range of its bytes; one that cannot be had is refused as all else is."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it.

        Raises:
          HTTPException: the framework has a text of its own for a range that it refuses.
        """

        async def sending(message: Message) -> None:
            status = message.get("status", 200)
            if status >= 400:
                told = {k.decode(): v.decode() for k, v in message["headers"]}
                place = told.get("content-range")
                headers = {"Content-Range": place} if place else None
                asked = Request(scope).headers.get("Range", "")[:200]
                raise HTTPException(status, f"Range {asked!r} cannot be had of this file", headers)
            await send(message)

        await super().__call__(scope, receive, sending)


def stream(request: Request, name: str) -> Response:
    """Server-sent events: one whenever what has this name changed, with its revision."""
    conductor = conductor_of(request)

    async def told() -> AsyncIterator[str]:
        revision = conductor.revision[name]
        yield f"retry: 2000\ndata: {revision}\n\n"
        while not (await request.is_disconnected() or request.app.state.stopping):
            if asking(request) is None:  # the token was revoked meanwhile
                return
            now = await conductor.wait(name, revision, STREAM)
            yield f"data: {now}\n\n" if now != revision else "event: alive\ndata: {}\n\n"
            revision = now
            await asyncio.sleep(0.5)  # a browser need not know sooner

    return StreamingResponse(told(), media_type="text/event-stream")
