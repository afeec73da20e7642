"""The Ray that a job runs on: a cluster that is there, or one embedded in this process.

When an actor dies while tasks of its own run, Ray 2.60 counts those tasks as running for ever
(ray issue 64627), and with its cap on workers a node soon starts none but one every few seconds.
The cap is for tasks that wait for other tasks, which ours do not: an embedded Ray is without it,
and the nodes of a cluster are best started with RAY_SETTINGS in their environment.
"""

import logging
import os
import signal
import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from tempfile import mkdtemp
from types import FrameType
from typing import Any
from urllib.parse import urlsplit

import grpc  # type: ignore[import-untyped]  # it tells no types
import ray
from ray._private import ray_constants
from ray._private import utils as ray_utils
from ray._private import worker as ray_worker
from ray._private.grpc_utils import init_grpc_channel
from ray.exceptions import AuthenticationError

from pup.errors import InputError
from workers import reaper

OBJECT_STORE = 256 * 2**20  # bytes; the recordings are the largest object
PROBE_SECONDS = 5.0
GREETING_SECONDS = 20.0
"""In which a busy cluster greets who connects."""
RAY_SETTINGS = {
    "RAY_worker_cap_enabled": "0",  # see the module
    # A node whose link is down answers nobody, and does not refuse either: what was asked of it
    # waits until the connection is found dead, by default after seven minutes.
    "RAY_grpc_client_keepalive_time_ms": "10000",
    "RAY_grpc_client_keepalive_timeout_ms": "20000",
}
"""Of Ray, for all processes of a cluster, in their environment."""
_staying: ExitStack | None = None
"""Ends the connection that stays; see `staying`."""


@contextmanager
def connected(address: str | None = None, cores: int | None = None) -> Iterator[None]:
    """Connect to Ray for the time of a job.

    An embedded Ray lives and dies with this process and listens on the loopback interface alone,
    with the token authentication that Ray sets up by default.

    Args:
      address: of a running cluster (`host:port`, `ray://…` or `auto`); None embeds one.
      cores: of the embedded one; None takes those it finds.

    Raises:
      InputError: there is no cluster at that address, or it has another token.
    """
    if _staying is None:
        with _connected(address, cores):
            yield
        return
    if not ray.is_initialized():
        _staying.enter_context(_connected(address, cores))
    yield


@contextmanager
def staying() -> Iterator[None]:
    """Have Ray stay for the jobs that come one after the other, all with the same options.

    The first one to connect starts it: a new Ray, whose processes import everything anew, takes
    seconds.
    """
    global _staying
    with ExitStack() as stack:
        _staying = stack
        try:
            yield
        finally:
            _staying = None


@contextmanager
def _connected(address: str | None, cores: int | None) -> Iterator[None]:
    for name, value in RAY_SETTINGS.items():
        os.environ.setdefault(name, value)
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # what newer Rays do
    with _messages(), _joined(address) if address else _embedded(cores):
        yield


def cores_there() -> int:
    """Cores of the Ray this process is connected to."""
    return int(ray.cluster_resources().get("CPU", 1))


@contextmanager
def _joined(address: str) -> Iterator[None]:
    _probe(address)
    try:
        try:
            with _own_signals():
                ray.init(address=address, log_to_driver=False, logging_level=logging.ERROR)
        except AuthenticationError as error:
            raise InputError(
                f"--address {address}: no token that the Ray cluster takes; set RAY_AUTH_TOKEN or "
                "RAY_AUTH_TOKEN_PATH to that of the cluster"
            ) from error
        except (ConnectionError, ValueError, RuntimeError) as error:
            told = " ".join(str(error).split())[:200]
            raise InputError(
                f"--address {address}: no Ray cluster answers there, or not to this token ({told})"
            ) from error
        yield
    finally:
        ray.shutdown()


def _probe(address: str) -> None:
    """Refuse an address where nothing listens, or what listens greets nobody as Ray does.

    Ray would try again for over ten minutes, and hear no Ctrl-C meanwhile.
    """
    if address == "auto":
        return
    try:
        place = urlsplit(address if "://" in address else f"//{address}")
        host, port = place.hostname, place.port
    except ValueError:
        host = port = None
    if not host or not port or place.scheme not in ("", "ray"):
        raise InputError(f"--address {address}: expected host:port, ray://host:port or auto")
    try:
        socket.create_connection((host, port), PROBE_SECONDS).close()
        with init_grpc_channel(place.netloc, [("grpc.enable_http_proxy", 0)]) as channel:
            grpc.channel_ready_future(channel).result(GREETING_SECONDS)
    except (OSError, grpc.FutureTimeoutError) as error:
        silent = isinstance(error, grpc.FutureTimeoutError)
        told = "what listens there is none, or hangs" if silent else error.strerror or error
        raise InputError(f"--address {address}: no Ray cluster answers there ({told})") from error


@contextmanager
def _embedded(cores: int | None) -> Iterator[None]:
    folder = mkdtemp(prefix="pup-ray-")
    watch = reaper.start(folder)
    try:
        _start(cores, folder)
        yield
    finally:
        ray.shutdown()
        reaper.close(watch, folder)


def _start(cores: int | None, folder: str) -> None:
    try:
        with _own_signals(), _loopback():
            ray.init(
                address="local",
                num_cpus=cores,
                include_dashboard=False,
                log_to_driver=False,
                logging_level=logging.ERROR,
                object_store_memory=OBJECT_STORE,
                _temp_dir=folder,
                _node_ip_address="127.0.0.1",
            )
    except Exception as error:  # Ray has no kind of its own for it
        if "timed out during startup" not in str(error):
            raise
        raise InputError(
            "Ray did not start within half a minute: this machine is busy with something else, "
            "or out of memory; repeat the command when it is not, or give --address"
        ) from error


@contextmanager
def _messages() -> Iterator[None]:
    """Have Ray tell of lost workers on standard error: standard output is for results.

    The actors that a stopped job kills itself are not lost.
    """
    usual = ray_worker.print_to_stdstream

    def tell(data: dict[str, Any], ignore_prefix: bool) -> None:
        lines = [line for line in data["lines"] if "killed by `ray.kill`" not in line]
        if lines:
            usual(data | {"lines": lines, "is_err": True}, ignore_prefix)

    ray_worker.print_to_stdstream = tell
    try:
        yield
    finally:
        ray_worker.print_to_stdstream = usual


@contextmanager
def _own_signals() -> Iterator[None]:
    """Keep Ctrl-C and SIGTERM until Ray has started; a second one is answered at once.

    Raised inside Ray's start they can be lost, and Ray would put an answer of its own in the place
    of ours to SIGTERM. A process that is just being forked has these answers too: Ctrl-C reaches it
    as well, but is not for it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    me, asked = os.getpid(), list[int]()
    usual = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def keep(number: int, frame: FrameType | None) -> None:
        answer = usual[signal.Signals(number)]
        if os.getpid() == me and asked and callable(answer):
            answer(number, frame)
        asked.append(number)

    for number, answer in usual.items():
        if callable(answer):
            signal.signal(number, keep)
    set_handler, ray_utils.set_sigterm_handler = ray_utils.set_sigterm_handler, _leave
    try:
        yield
    finally:
        ray_utils.set_sigterm_handler = set_handler
        for number, answer in usual.items():
            signal.signal(number, answer)
    for number in asked[:1]:
        signal.raise_signal(number)


def _leave(handler: object) -> None:
    """Set no answer to SIGTERM."""


@contextmanager
def _loopback() -> Iterator[None]:
    """Keep Ray on the loopback interface; on Linux it takes another one even when told to.

    So no other machine can talk to it, and it outlives a change of network.
    """
    usual = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        yield
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = usual
