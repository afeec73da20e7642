"""The Ray that a job runs on: a cluster that is there, or one embedded in this process."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from tempfile import mkdtemp

import ray

from pup.errors import InputError
from workers import reaper

OBJECT_STORE = 256 * 2**20  # bytes; the recordings are the largest object


@contextmanager
def connected(address: str | None = None, cores: int | None = None) -> Iterator[None]:
    """Connect to Ray for the time of a job.

    An embedded Ray lives and dies with this process and listens on the loopback interface alone,
    with the token authentication that Ray sets up by default.

    Args:
      address: of a running cluster (`host:port`, `ray://…` or `auto`); None embeds one.
      cores: of the embedded one; None takes those it finds.

    Raises:
      InputError: there is no cluster at that address.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # what newer Rays do
    if address is None:
        with _embedded(cores):
            yield
        return
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except (ConnectionError, ValueError, RuntimeError) as error:
        told = " ".join(str(error).split())[:200]
        raise InputError(f"--address {address}: no Ray cluster answers there ({told})") from error
    try:
        yield
    finally:
        ray.shutdown()


@contextmanager
def _embedded(cores: int | None) -> Iterator[None]:
    folder = mkdtemp(prefix="pup-ray-")
    watch = reaper.start(folder)
    assert watch.stdin is not None
    try:
        ray.init(
            address="local",
            num_cpus=cores,
            include_dashboard=False,
            log_to_driver=False,
            logging_level="ERROR",
            object_store_memory=OBJECT_STORE,
            _temp_dir=folder,
            _node_ip_address="127.0.0.1",
        )
        yield
    finally:
        ray.shutdown()
        watch.stdin.close()
        watch.wait()
        os.environ.pop(reaper.SESSION, None)
