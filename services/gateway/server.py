"""`pup serve`: one process with the link to the agents, the studies, the jobs, the pages."""

import asyncio
import contextlib
import json
import logging
import signal
import socket
import ssl
import sys
import time
from functools import partial
from pathlib import Path
from typing import Any, cast

import uvicorn
from fastapi import FastAPI
from sqlalchemy import make_url
from sqlalchemy.exc import ArgumentError, SQLAlchemyError

from pup.errors import InputError
from services.gateway.app import application
from services.gateway.conductor import Conductor
from services.gateway.config import Config
from services.gateway.dispatcher import Dispatcher
from services.gateway.fits import Fits
from services.gateway.keys import KeyRing, Tokens
from services.gateway.link import Link
from services.gateway.metrics import Metrics
from services.gateway.ray_jobs import RayJobs
from services.gateway.recordings import Shelves
from services.gateway.sockets import Impatient, check_link, web_socket
from services.gateway.store import ReplacedError, Store, refusal

log = logging.getLogger(__name__)
STANDARD = set(vars(logging.makeLogRecord({}))) | {"message", "taskName"}
GRACE = 3
"""For requests to end when the gateway stops, s."""


class JsonLines(logging.Formatter):
    """A JSON object a line: time, level, logger, message, and what was given besides."""

    def format(self, record: logging.LogRecord) -> str:
        """The line of a record."""
        told: dict[str, Any] = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
            + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        told |= {k: v for k, v in vars(record).items() if k not in STANDARD}
        if record.exc_info:
            told["error"] = self.formatException(record.exc_info)
        return json.dumps(told, default=str)


def serve(config: Config) -> dict[str, Any]:
    """Run a gateway until it is told to stop.

    Raises:
      InputError: a setting, a file or an address cannot be used.
      FailedError: the database does not answer now.
    """
    _check_certificate(config)
    _check_kept(config.url)
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    logging.basicConfig(level=config.log.upper(), handlers=[handler], force=True)
    for name in ("alembic", "zmq", "asyncio", "httpx", "httpcore"):
        logging.getLogger(name).setLevel("WARNING")
    config.data.mkdir(parents=True, exist_ok=True)
    tokens, ring = config.token_store, config.key_ring
    if not len(tokens):
        if not config.loopback:
            raise InputError("no token exists; make one first: pup serve token NAME --role admin")
        log.warning("no token exists, so nobody can ask; pup serve token NAME --role admin")
    if not config.loopback and not config.certificate:
        log.warning("tokens travel unencrypted: set certificate and key, or use a TLS proxy")
    return asyncio.run(_run(config, tokens, ring))


def _check_certificate(config: Config) -> None:
    if not config.certificate:
        return

    def phrase() -> str:  # asked at a terminal otherwise, and where there is none, for nothing
        raise InputError(f"key {config.key}: is encrypted; give it without a pass phrase")

    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(config.certificate, config.key, phrase)
    except OSError as error:  # of a file, or of what stands in it
        why = error.strerror or error
        raise InputError(f"certificate {config.certificate}, key {config.key}: {why}") from error


def _check_kept(url: str) -> None:
    """Refuse a database in memory: it is another one in each thread, and gone at a restart."""
    with contextlib.suppress(ArgumentError):  # told where it is opened
        place = make_url(url)
        if place.get_backend_name() == "sqlite" and place.database in (None, "", ":memory:"):
            like = "sqlite:////var/lib/pup/gateway.db"
            raise InputError(f"database: {url} keeps nothing; name a file, as in {like}")


async def _run(config: Config, tokens: Tokens, ring: KeyRing) -> dict[str, Any]:
    web = web_socket(config.host, config.port)
    check_link(config.link)  # before the database: it would be taken from a gateway that runs
    ray = RayJobs(config.ray, config.ray_token) if config.ray else None
    store, fits, metrics = Store(config.url), Fits(), Metrics()
    conductor = Conductor(store, fits, metrics)
    dispatcher = Dispatcher(
        store,
        ray,
        Path(config.shared),
        metrics,
        conductor.notify,
        config.jobs_at_once,
        config.ray_cores,
    )
    link = Link(config, ring, conductor)
    try:
        await _load(conductor, dispatcher)
        link.start()
        app = application(store, tokens, conductor, dispatcher, link, Shelves(config.shelves))
        server = _Server(
            uvicorn.Config(
                app,
                http=Impatient,
                log_config=None,
                access_log=False,
                server_header=False,
                ssl_certfile=config.certificate or None,
                ssl_keyfile=config.key or None,
                timeout_graceful_shutdown=GRACE,
                limit_concurrency=1000,
            )
        )
        await _until_stopped(config, conductor, dispatcher, link, server, web)
    except ReplacedError as error:
        raise InputError(str(error)) from error
    finally:
        web.close()
        if ray is not None:
            await ray.close()
        link.close()
        fits.close()
        store.close()
    if conductor.stopped:
        raise InputError(str(conductor.stopped))
    return {"stopped": True}


async def _load(conductor: Conductor, dispatcher: Dispatcher) -> None:
    """Read what the database holds.

    Raises:
      InputError: it is damaged.
      FailedError: it does not answer now.
    """
    try:
        await conductor.load()
        await dispatcher.load()
    except (SQLAlchemyError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise refusal(error, "is damaged; restore a backup") from error


async def _until_stopped(
    config: Config,
    conductor: Conductor,
    dispatcher: Dispatcher,
    link: Link,
    server: "_Server",
    web: socket.socket,
) -> None:
    works = [
        asyncio.create_task(act(), name=name)
        for name, act in (
            ("studies", conductor.run),
            ("jobs", dispatcher.run),
            ("link", link.run),
            ("keys", link.watch),
            ("web", partial(server.serve, [web])),
        )
    ]
    warm = asyncio.create_task(conductor.fits.warm_up())
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, server.stop)
    log.info("listening", extra={"web": f"{config.host}:{config.port}", "link": config.link})
    done, _ = await asyncio.wait(works, return_when=asyncio.FIRST_COMPLETED)
    server.stop()
    with contextlib.suppress(TimeoutError):
        await asyncio.wait_for(asyncio.shield(works[-1]), 2 * GRACE)
    for work in (*works, warm):
        work.cancel()
    await asyncio.gather(*works, warm, return_exceptions=True)
    for work in done:
        if not work.cancelled() and (error := work.exception()):
            raise error


class _Server(uvicorn.Server):
    """Uvicorn without signal handlers of its own."""

    @contextlib.contextmanager
    def capture_signals(self) -> Any:
        """The gateway handles signals itself."""
        yield

    def stop(self) -> None:
        """Take no more requests, and end streams and what waits for a fit."""
        app = cast(FastAPI, self.config.app)  # as it was given, not by name
        app.state.stopping = True
        app.state.conductor.posteriors.stop()
        self.should_exit = True
