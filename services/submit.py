"""The jobs behind `pup submit` and `pup jobs`: what runs on the cluster of a running service."""

import argparse
import sys
import time
from codecs import getincrementaldecoder
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import quote

import httpx

from pup.errors import InputError
from pup.files import sha256
from services.failures import FailedError
from services.job_arguments import command
from services.transfer import PATIENCE, Gateway, away, detail, token_of

PERIOD = 1.0
"""Between two looks at a job, s."""
OPEN = ("queued", "waiting", "running", "cancelling")


def submit(options: argparse.Namespace) -> dict[str, Any]:
    """Have a verb run; with `wait` until it ends, with its log on standard error.

    Raises:
      InputError: the verb or the service refuses it, before or while it ran.
      FailedError: it ended without a result otherwise.
      KeyboardInterrupt: the user waits no longer; the job goes on.
    """
    arguments = [a for a in options.arguments if a != "--"]
    command(options.verb, arguments, Path("out"))
    asked = {"verb": options.verb, "arguments": arguments}
    for name in ("cpus", "gpus", "retries"):
        if (value := getattr(options, name)) is not None:
            asked[name] = value
    gateway = _gateway(options)
    job = gateway.post("/v1/jobs", asked, options.key)
    if not options.wait:
        return {"job": job, "page": f"{options.url}/jobs/{job['id']}"}
    try:
        print(f"{options.url}/jobs/{job['id']}", file=sys.stderr, flush=True)
        for told in _log(gateway, job["id"], follow=True):
            print(told, end="", file=sys.stderr, flush=True)
    except KeyboardInterrupt as stop:
        name = job["id"]
        raise KeyboardInterrupt(f"{name} goes on; pup jobs logs {name} --follow") from stop
    return {"job": _ended(gateway, job["id"])}


def jobs(options: argparse.Namespace) -> dict[str, Any]:
    """List, show, call off or fetch jobs.

    Raises:
      InputError: there is no such job, or the service refuses.
    """
    return ACTIONS[options.action](_gateway(options), options)


def _list(gateway: Gateway, _: argparse.Namespace) -> dict[str, Any]:
    return {"jobs": gateway.all("/v1/jobs", "jobs")}


def _status(gateway: Gateway, options: argparse.Namespace) -> dict[str, Any]:
    return {"job": gateway.get(_place(options))}


def _logs(gateway: Gateway, options: argparse.Namespace) -> dict[str, Any]:
    gateway.get(_place(options))  # says what is wrong, if something is
    told = _log(gateway, options.job, options.follow)
    if options.json:
        return {"log": "".join(told)}
    for text in told:
        print(text, end="", flush=True)
    return {}


def _cancel(gateway: Gateway, options: argparse.Namespace) -> dict[str, Any]:
    job = gateway.post(f"{_place(options)}:cancel", None)
    while job["state"] == "cancelling":
        time.sleep(PERIOD)
        job = gateway.get(_place(options))
    return {"job": job}


def _retry(gateway: Gateway, options: argparse.Namespace) -> dict[str, Any]:
    place = _place(options)
    attempt = len(gateway.get(place)["attempts"]) + 1
    return {"job": gateway.post(f"{place}:retry", {"attempt": attempt})}


def _fetch(gateway: Gateway, options: argparse.Namespace) -> dict[str, Any]:
    place = f"{_place(options)}/artifacts"
    listed = gateway.all(place, "artifacts")
    known = {a["name"] for a in listed}
    if missing := [name for name in options.names if name not in known]:
        raise InputError(f"{options.job} has no artefact {missing[0]}")
    wanted = [a for a in listed if not options.names or a["name"] in options.names]
    files = [_download(gateway, place, a, options.out) for a in wanted]
    return {"files": [str(file) for file in files]}


def _download(gateway: Gateway, place: str, artifact: dict[str, Any], out: Path) -> Path:
    """Fetch a file of the list at a place whole, unless it lies there already."""
    name, digest = str(artifact["name"]), artifact["sha256"]
    path = out / name
    if not path.resolve().is_relative_to(out.resolve()):
        raise InputError(f"{gateway.url}: names a file outside of --out: {name[:100]!r}")
    if digest and path.is_file() and sha256(path) == digest:
        return path
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.part")
    at = f"{place}/{quote(name)}"  # as it is, a name with # or ? would end there
    try:
        with gateway.http.stream("GET", at) as answer, open(part, "wb") as file:
            if answer.status_code != 200:
                raise InputError(f"{gateway.url}: {name}: it answers {answer.status_code}")
            for chunk in answer.iter_bytes():
                file.write(chunk)
        if digest and sha256(part) != digest:
            raise InputError(f"{name}: arrived with another SHA-256; fetch it again")
        part.replace(path)
    except httpx.HTTPError as error:
        raise InputError(f"{gateway.url}: {name}: {error or type(error).__name__}") from error
    finally:
        part.unlink(missing_ok=True)
    return path


def _log(gateway: Gateway, job: str, follow: bool) -> Iterator[str]:
    """What a job says; a stream that broke, or does not come yet, is taken up where it was.

    Raises:
      InputError: the gateway refuses it, or is away for too long.
    """
    place, heard = f"/v1/jobs/{job}", time.monotonic()
    at, over, text = 0, False, getincrementaldecoder("utf-8")("replace")
    said = ""
    while not over:
        ended = gateway.get(place)["state"] not in OPEN  # waits for a gateway that is away
        query = {"offset": at, "follow": "true" if follow else "false"}
        try:
            with gateway.http.stream("GET", f"{place}/logs", params=query) as answer:
                if answer.status_code == 200:
                    heard, said = time.monotonic(), ""
                    for chunk in answer.iter_bytes():
                        at += len(chunk)
                        yield text.decode(chunk)
                    over = ended or not follow
                    continue
                answer.read()
            why = away(answer)
            if not why:
                raise InputError(f"{gateway.url}: no log of {job}: {detail(answer)}")
            if why != said:
                gateway.told(f"the log of {job} does not come ({why}); waiting")
            said = why
        except httpx.HTTPError as error:  # also of a job that says nothing for long
            why = str(error) or type(error).__name__
        if time.monotonic() - heard > PATIENCE:
            raise InputError(f"{gateway.url}: the log of {job} does not come ({why})")
        time.sleep(PERIOD)


def _ended(gateway: Gateway, job: str) -> Any:
    told = gateway.get(f"/v1/jobs/{job}")
    if told["state"] == "succeeded":
        return told
    line = f"{job} has {told['state']}: {told['reason']}"
    if told["state"] == "failed" and told["failures"] <= told["retries"]:
        raise InputError(line)  # bad input ends a job at once, all else when no retry is left
    raise FailedError(line)


def _gateway(options: argparse.Namespace) -> Gateway:
    told = lambda line: print(line, file=sys.stderr, flush=True)  # noqa: E731
    return Gateway(options.url, token_of(options.token_file), told)


def _place(options: argparse.Namespace) -> str:
    from services.gateway.keys import check_name

    check_name(options.job)
    return f"/v1/jobs/{options.job}"


def show(shown: dict[str, Any]) -> None:
    """Print the outcome for people."""
    for job in shown.get("jobs", [shown["job"]] if "job" in shown else []):
        print(line(job))
    for job in [shown["job"]] if "job" in shown else []:
        for attempt in job["attempts"]:
            outcome = attempt["outcome"] or ("running" if attempt["started"] else "waiting")
            print(f"  attempt {attempt['number']}: {outcome}")
    if "page" in shown:
        print(f"  {shown['page']}")
    for file in shown.get("files", []):
        print(file)


def line(job: dict[str, Any]) -> str:
    """A job in a line."""
    told = f"{job['id']}  {job['state']:<10} {job['verb']:<9} {job['who']}"
    why = job["waits_for"] and f"waits for {job['waits_for']}"
    why = why or job["reason"] or job["progress"]
    return f"{told}  {why}" if why else told


ACTIONS = {
    "list": _list,
    "status": _status,
    "logs": _logs,
    "cancel": _cancel,
    "retry": _retry,
    "fetch": _fetch,
}
