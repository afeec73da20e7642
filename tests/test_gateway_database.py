"""A database that is late, locked or gone: what the gateway says, and how soon."""

import asyncio
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest

pytest.importorskip("fastapi")
pytest.importorskip("botorch")

from commandline import pup

from pup.transfer.study import Study, StudySettings
from services.gateway.store import TRIED, TRY, WAITS, Change, Store, engine_options

SERVER = "postgresql+psycopg://pup:secret@db/pup"


def locked(file: Path) -> sqlite3.Connection:
    """A connection that lets nobody else write, nor read."""
    held = sqlite3.connect(file, isolation_level=None)
    held.execute("BEGIN EXCLUSIVE")
    return held


def test_a_locked_database_is_told_before_a_probe_gives_up(tmp_path: Path) -> None:
    async def live() -> None:
        store = Store(f"sqlite:///{tmp_path / 'gateway.db'}")
        with closing(locked(tmp_path / "gateway.db")):
            began = time.monotonic()
            assert not await store.writable()
            assert time.monotonic() - began < TRY + 0.5
        await asyncio.sleep(TRIED + 0.1)
        assert await store.writable()
        store.close()

    asyncio.run(live())


def test_a_database_that_does_not_answer_yet_is_no_bad_input(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Code 1: systemd starts the gateway again."""
    file = tmp_path / "gateway.db"
    monkeypatch.setenv("PUP_DATA", str(tmp_path))
    monkeypatch.setenv("PUP_DATABASE", f"sqlite:///{file}?timeout=0.1")
    monkeypatch.setenv("PUP_LOG", "error")
    monkeypatch.setenv("PUP_PORT", "0")  # it listens first, as another test's may do now
    monkeypatch.setenv("PUP_LINK", "tcp://127.0.0.1:*")
    with closing(locked(file)):
        done = pup("serve")
    assert done.code == 1
    assert done.err.splitlines()[-1].startswith("pup serve: database: does not answer now (")
    assert "Traceback" not in done.err


def test_a_study_of_before_whose_trials_are_all_initial_goes_on(tmp_path: Path) -> None:
    """When more of them could be initial than there were, `--trials 3` alone stored 5 of 3."""

    async def live() -> None:
        file = tmp_path / "gateway.db"
        store = Store(f"sqlite:///{file}")
        study = Study("few", StudySettings("darwin_op2", "a" * 64, trials=3, initial=3))
        await store.write(Change(study))
        with closing(sqlite3.connect(file)) as before, before:
            before.execute("UPDATE studies SET settings = json_set(settings, '$.initial', 5)")
        assert await store.studies() == [(study, None)]
        store.close()

    asyncio.run(live())


@pytest.mark.parametrize("url", ["sqlite://", "sqlite:////x/y.db", "mysql://db/pup"])
def test_other_databases_are_opened_as_they_are(url: str) -> None:
    assert engine_options(url) == {}


@pytest.mark.parametrize("url", [SERVER, SERVER.replace("+psycopg", "")])
def test_no_call_waits_long_for_postgresql(url: str) -> None:
    assert engine_options(url) == {"pool_pre_ping": True, "connect_args": WAITS}


def test_what_the_url_tells_of_a_connection_stands() -> None:
    url = f"{SERVER}?options=-csearch_path%3Dlab&connect_timeout=60"
    told = engine_options(url)["connect_args"]
    assert set(WAITS) - set(told) == {"options", "connect_timeout"}
