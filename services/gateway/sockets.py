"""Where a gateway listens, told before its database is touched, and for how long it listens."""

import asyncio
import socket

import zmq
from uvicorn.protocols.http.auto import AutoHTTPProtocol

from pup.errors import InputError

SECONDS = 10.0
"""A request has come as a whole after this, or at most twice this, or its connection is closed."""


def web_socket(host: str, port: int) -> socket.socket:
    """A socket that listens.

    Raises:
      InputError: the address cannot be had.
    """
    try:
        family, *_, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(place[:2], family=family, backlog=2048)
    except OSError as error:
        why = "cannot be bound; is another gateway running?"
        raise InputError(f"web: {host}:{port} {why} ({error.strerror})") from error


def check_link(address: str) -> None:
    """Bind the link and let go of it.

    Raises:
      InputError: the address cannot be had.
    """
    with zmq.Context() as context, context.socket(zmq.ROUTER) as trial:
        bind_link(trial, address)


def bind_link(router: zmq.Socket[bytes], address: str) -> None:
    """Bind a socket to the link's address.

    Raises:
      InputError: the address cannot be had.
    """
    try:
        router.bind(address)
    except zmq.ZMQError as error:
        raise InputError(f"link: {address} cannot be bound ({error})") from error


class Impatient(AutoHTTPProtocol):  # type: ignore[misc, valid-type]  # chosen as uvicorn starts
    """HTTP that closes connections whose request does not come.

    So many connections are served at once, and one that stays silent counts as any other: without
    this a stranger could keep a stop out by opening them all.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:
        """See asyncio.Protocol."""
        super().connection_made(transport)
        self._seen: object = None
        self._timer = self.loop.call_later(SECONDS, self._look)

    def connection_lost(self, exc: Exception | None) -> None:
        """See asyncio.Protocol."""
        self._timer.cancel()
        super().connection_lost(exc)

    def _look(self) -> None:
        """Close it where nothing has come of a request since the last look but a part of it."""
        told = self.cycle
        waits = told is None or told.more_body or told.response_complete
        if waits and told is self._seen:
            self.transport.close()
            return
        self._seen = told
        self._timer = self.loop.call_later(SECONDS, self._look)
