"""What `pup jobs` and `pup submit` do when something else than the gateway answers."""

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlsplit

import pytest
from commandline import pup

pytest.importorskip("httpx")

JOB = {"id": "job-1", "state": "succeeded", "verb": "presysid", "who": "ann", "waits_for": ""}
JOB |= {"reason": "", "progress": "", "attempts": [], "failures": 0, "retries": 3}
PAGE = b"<html>no upstream</html>"
PROBLEM = b'{"title": "Not Found", "status": 404, "detail": "there is no job job-1"}'
LOG = "attempt 1 on node\nünfit\n".encode()
BROKEN = (200, LOG[:19], len(LOG))  # within a letter
Answer = tuple[int, bytes, int]


@contextmanager
def gateway(*logs: Answer) -> Iterator[tuple[str, list[str]]]:
    """A service, or the proxy before it, that gives these answers to those who ask for a log."""
    asked: list[str] = []
    coming = list(logs)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            whole = json.dumps(JOB).encode()
            status, body, size = 200, whole, len(whole)
            if "/logs" in self.path:
                status, body, size = coming.pop(0)
            self.send_response(status)
            self.send_header("Content-Length", str(size))
            self.end_headers()
            self.wfile.write(body)

        def do_POST(self) -> None:
            self.do_GET()

        def log_message(self, *_: object) -> None: ...

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", asked
    finally:
        server.shutdown()
        server.server_close()


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.submit.PERIOD", 0.01)
    monkeypatch.setenv("PUP_TOKEN", "x")


def page(status: int, body: bytes = PAGE) -> Answer:
    return status, body, len(body)


@pytest.mark.parametrize("follow", [(), ("--follow",)])
def test_the_page_of_an_error_is_no_log(follow: tuple[str, ...]) -> None:
    with gateway(page(502), page(502), BROKEN, page(502), page(200, LOG[19:])) as (url, asked):
        done = pup("jobs", "logs", "job-1", *follow, "--url", url)
    assert (done.code, done.out) == (0, LOG.decode())
    assert done.err.splitlines() == 2 * ["the log of job-1 does not come (it answers 502); waiting"]
    queries = [parse_qs(urlsplit(path).query) for path in asked if "?" in path]
    assert [query["offset"] for query in queries] == [["0"], ["0"], ["0"], ["19"], ["19"]]


def test_who_waits_for_a_job_reads_no_page_of_an_error_either() -> None:
    with gateway(page(503), page(200, LOG)) as (url, _):
        done = pup("submit", "--url", url, "--wait", "presysid", "x", "--robot", "servo_bench")
    assert done.code == 0
    assert done.err.splitlines()[1:] == [
        "the log of job-1 does not come (it answers 503); waiting",
        *LOG.decode().splitlines(),
    ]


@pytest.mark.parametrize(
    ("answer", "words"),
    [(page(404, PROBLEM), "there is no job job-1"), (page(302), "it answers 302")],
)
def test_what_waiting_does_not_help_is_an_error(answer: Answer, words: str) -> None:
    with gateway(answer) as (url, _):
        done = pup("jobs", "logs", "job-1", "--url", url)
    assert done.code == 2 and not done.out
    assert len(done.err.splitlines()) == 1 and words in done.err


def test_patience_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("services.submit.PATIENCE", 0.0)
    with gateway(page(502)) as (url, _):
        done = pup("jobs", "logs", "job-1", "--url", url)
    assert done.code == 2 and "the log of job-1 does not come" in done.err.splitlines()[-1]
