"""Who asks, and requests that come twice.

A program sends `Authorization: Bearer <token>`. A browser sends a cookie that only this service's
pages can make it send (SameSite=Strict); its changes need an `Idempotency-Key` besides, a header
that no foreign form can set.
"""

import asyncio
import hashlib
from collections.abc import Callable, Coroutine
from typing import Annotated, Any

from fastapi import Depends, Header, HTTPException, Request, Response
from fastapi.routing import APIRoute
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from services.gateway.keys import Role, Tokens, User
from services.gateway.store import Answer, Store

COOKIE = "pup_token"
BODY_LIMIT = 4 * 2**20
"""Of a request, bytes."""
UNKNOWN, CHALLENGE = "a valid bearer token is needed", {"WWW-Authenticate": "Bearer"}
"""What somebody is told who has none."""
_bearer = HTTPBearer(auto_error=False, description="A token of `pup serve token`.")
Handler = Callable[[Request], Coroutine[Any, Any, Response]]


def asking(request: Request) -> User | None:
    """Whose token a request carries."""
    tokens: Tokens = request.app.state.tokens
    scheme, _, token = request.headers.get("Authorization", "").partition(" ")
    if scheme.lower() == "bearer" and token:
        return tokens.user(token.strip())
    cookie = request.cookies.get(COOKIE)
    if cookie is None or (request.method != "GET" and "Idempotency-Key" not in request.headers):
        return None
    return tokens.user(cookie)


def needs(role: Role) -> Any:
    """A dependency: the user, who must have at least a role."""

    async def user(
        request: Request,
        _: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)] = None,
    ) -> User:
        found = asking(request)
        if found is None:
            raise HTTPException(401, UNKNOWN, CHALLENGE)
        if found.role < role:
            name = role.name.lower()
            raise HTTPException(
                403, f"the role {name} is needed; yours is {found.role.name.lower()}"
            )
        return found

    return Depends(user)


IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=128,
        pattern=r"^[!-~]+$",
        description="Any text of your own: the same request with the same key is carried out once, "
        "and for a week answered with the same status and body, and `Idempotent-Replayed: true`.",
    ),
]


class IdempotentRoute(APIRoute):
    """Answers a POST with a key that was seen before as it was answered then.

    Only answers that changed something, or could have, are kept: one that refused (4xx) or failed
    (5xx) may be tried again. A gateway that dies between the change and the keeping does no harm:
    each change is itself one that is made but once.
    """

    def get_route_handler(self) -> Handler:
        """The route's handler, with that before and after."""
        handle = super().get_route_handler()

        async def handler(request: Request) -> Response:
            key = request.headers.get("Idempotency-Key")
            user = asking(request)
            if request.method != "POST" or key is None or user is None:
                return await handle(request)
            store: Store = request.app.state.store
            body = await request.body()
            told = f"{request.method} {request.url.path}\n".encode() + body
            digest = hashlib.sha256(told).hexdigest()
            locks: dict[tuple[str, str], asyncio.Lock] = request.app.state.locks
            mine = (key, user.name)
            if mine in locks:
                told = "a request with this Idempotency-Key is under way"
                raise HTTPException(409, told, {"Retry-After": "1"})
            locks[mine] = asyncio.Lock()
            try:
                if before := await store.answer(key, user.name):
                    if before.request != digest:
                        raise HTTPException(409, "this Idempotency-Key had another request")
                    headers = {"Idempotent-Replayed": "true"}
                    if before.location:
                        headers["Location"] = before.location
                    return Response(before.body, before.status, headers, "application/json")
                response = await handle(request)
                if response.status_code < 300:
                    made = response.status_code, response.body, response.headers.get("Location")
                    await store.answered(Answer(key, user.name, digest, *made))
                return response
            finally:
                del locks[mine]

        return handler
