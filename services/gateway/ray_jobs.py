"""Ray's job submission over its REST interface, as a gateway needs it.

The gateway names each submission itself, so that asking twice is asking once.
"""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import httpx

from pup.errors import InputError
from services.gateway.jobs import Seen, Status

TIMEOUT = 10.0
STOP_WAIT = 30
"""Between Ray's asking a job's processes to end and its killing them, s: longer than the job's own
process waits for its verb."""
UNSTARTED = "JOB_SUPERVISOR_ACTOR_START_TIMEOUT"


class RayAwayError(RuntimeError):
    """The cluster does not answer, or not us: the end of a sentence on it."""


class RayJobs:
    """A cluster's job submission.

    Args:
      url: of its dashboard, such as `http://ray-head:8265`.
      token_file: with the token of its authentication; empty for what Ray itself reads.

    Raises:
      InputError: the address is none, or the file cannot be read.
    """

    def __init__(self, url: str, token_file: str) -> None:
        token_of(token_file)  # told at the start, and not by jobs that wait
        try:
            self.http = httpx.AsyncClient(base_url=url, auth=_Token(token_file), timeout=TIMEOUT)
        except (httpx.InvalidURL, ValueError) as error:
            raise InputError(f"ray: {url[:60]!r} is no address ({error})") from error

    async def check(self) -> None:
        """Find out whether it answers.

        Raises:
          RayAwayError: it does not, and why.
        """
        await self._ask("GET", "/api/version")

    async def submit(self, submission: str, entrypoint: str, cpus: float, gpus: float) -> None:
        """Ask for a job; nothing happens where it has one of this name already.

        Raises:
          RayAwayError: the cluster does not answer, or takes no jobs.
        """
        asked: dict[str, Any] = {
            "submission_id": submission,
            "entrypoint": entrypoint,
            "entrypoint_num_cpus": cpus,
            "runtime_env": {"env_vars": {"RAY_JOB_STOP_WAIT_TIME_S": str(STOP_WAIT)}},
            "metadata": {"job_name": submission},
        }
        if gpus:
            asked["entrypoint_num_gpus"] = gpus
        answer = await self._ask("POST", "/api/jobs/", json=asked)
        if answer.is_error and (await self.seen(submission)).status is Status.UNKNOWN:
            raise RayAwayError(f"takes no job ({answer.text.strip()[-200:]})")

    async def seen(self, submission: str) -> Seen:
        """How a job is there.

        Raises:
          RayAwayError: the cluster does not answer.
        """
        answer = await self._ask("GET", f"/api/jobs/{submission}")
        if answer.status_code == 404:
            return Seen(Status.UNKNOWN)
        try:
            told = answer.json()
            return Seen(
                Status(told["status"]),
                told.get("message") or "",
                told.get("driver_exit_code"),
                told.get("error_type") == UNSTARTED,
            )
        except (ValueError, KeyError, TypeError) as error:
            raise RayAwayError(f"answers {answer.status_code}") from error

    async def stop(self, submission: str) -> None:
        """Ask a job's processes to end; those that do not are killed.

        Raises:
          RayAwayError: the cluster does not answer.
        """
        await self._ask("POST", f"/api/jobs/{submission}/stop")

    async def close(self) -> None:
        """Let go of the connections."""
        await self.http.aclose()

    async def _ask(self, method: str, path: str, **options: Any) -> httpx.Response:
        try:
            answer = await self.http.request(method, path, **options)
        except httpx.HTTPError as error:
            raise RayAwayError(f"does not answer ({error or type(error).__name__})") from error
        except InputError as error:  # the token's file is being changed, say
            raise RayAwayError(f"cannot be asked ({error})") from error
        if answer.status_code in (401, 403):
            raise RayAwayError(f"refuses the gateway's token ({answer.status_code})")
        return answer


class _Token(httpx.Auth):
    """Ray's token, read again for each request: it is changed while the gateway runs."""

    def __init__(self, file: str) -> None:
        self.file = file

    def auth_flow(self, request: httpx.Request) -> Iterator[httpx.Request]:
        if token := token_of(self.file):
            request.headers["Authorization"] = f"Bearer {token}"
        yield request


def token_of(file: str, environment: Mapping[str, str] = os.environ) -> str:
    """Ray's token: of the file, else of the variables that Ray itself reads.

    Raises:
      InputError: a file cannot be read.
    """
    file = file or environment.get("RAY_AUTH_TOKEN_PATH", "")
    if not file:
        return environment.get("RAY_AUTH_TOKEN", "").strip()
    try:
        return Path(file).read_text(encoding="ascii").strip()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"ray_token: {file} cannot be read") from error
