"""Ray's token: read again for each request, for it may be changed while the gateway runs."""

import asyncio
from pathlib import Path

import httpx
import pytest

from pup.errors import InputError
from services.gateway.ray_jobs import RayAwayError, RayJobs

URL = "http://ray-head:8265"


def heard(file: Path, *tokens: str | None) -> list[str | None]:
    """What Ray hears of the gateway while its file holds one token after the other; None: gone."""
    told: list[str | None] = []

    def answer(request: httpx.Request) -> httpx.Response:
        told.append(request.headers.get("Authorization"))
        return httpx.Response(200, json={})

    async def live() -> None:
        file.write_text("first\n")
        ray = RayJobs(URL, str(file))
        ray.http._transport = httpx.MockTransport(answer)
        for token in tokens:
            if token is None:
                file.unlink()
                with pytest.raises(RayAwayError, match="cannot be read"):
                    await ray.check()
            else:
                file.write_text(token)
                await ray.check()
        await ray.close()

    asyncio.run(live())
    return told


def test_a_changed_token_is_used_at_once(tmp_path: Path) -> None:
    told = heard(tmp_path / "token", "one\n", "two\n", "")
    assert told == ["Bearer one", "Bearer two", None]


def test_jobs_wait_while_the_file_is_away(tmp_path: Path) -> None:
    assert heard(tmp_path / "token", "one", None, "two") == ["Bearer one", "Bearer two"]


def test_a_file_that_is_not_there_at_the_start_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"ray_token: .*/none cannot be read"):
        RayJobs(URL, str(tmp_path / "none"))
