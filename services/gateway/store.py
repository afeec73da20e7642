"""What the gateway must not forget, in SQLite or PostgreSQL through SQLAlchemy.

A change is one transaction: the study, the trials, what happened, all or nothing. Each start of a
gateway takes a new epoch; a gateway that finds a newer one was replaced and may write no more.
"""

import asyncio
import math
import sqlite3
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import sqlalchemy as sa
from alembic import command
from alembic.config import Config as Migrations
from alembic.util import CommandError
from sqlalchemy.exc import OperationalError, SQLAlchemyError

from pup.errors import InputError
from pup.transfer.study import Study
from pup.transfer.trial import Trial
from services.failures import FailedError
from services.gateway.jobs import Job
from services.gateway.records import Row, job_of, job_row, study_of, study_row, trial_row

T = TypeVar("T")
ANSWERS_KEPT = 7 * 86400.0  # s
TRIED = 1.0
"""Between two tries whether the database takes writes, s: anybody may ask."""
TRY = 2.0
"""For such a try, s: less than a probe waits, so that it hears why."""
LIBPQ = ("psycopg", "psycopg2")
WAITS = {
    "connect_timeout": 5,  # s
    "keepalives_idle": 10,  # s
    "keepalives_interval": 5,  # s
    "keepalives_count": 3,
    "tcp_user_timeout": 15_000,  # ms
    "options": "-c statement_timeout=10000",  # ms
}
"""For PostgreSQL: one that vanished would hold the store's only thread for a quarter of an hour."""
PASSING = (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL)
"""Of SQLite's errors those that may pass; a file that cannot be opened is a mistake."""


class ReplacedError(RuntimeError):
    """Another gateway was started on the same database."""


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes:
      kind: in a word.
      who: did it: the name of an agent or of a token, or `gateway`.
      trial: number, where it was about one.
      detail: what else is to be known.
    """

    kind: str
    who: str = "gateway"
    trial: int | None = None
    detail: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Change:
    """What a transaction writes of one study."""

    study: Study
    trials: Sequence[Trial] = ()
    events: Sequence[Event] = ()
    simulated: Row | None = None


@dataclass(frozen=True)
class Answer:
    """The answer to a request with an idempotency key."""

    key: str
    who: str
    request: str
    status: int
    body: bytes
    location: str | None = None


class Store:
    """The database of one gateway; its calls run one after the other in a thread of their own.

    Args:
      url: of SQLAlchemy, such as `sqlite:////var/lib/pup/gateway.db`.

    Raises:
      InputError: it cannot be opened, or a newer program wrote it.
      FailedError: it does not answer now, and may later.
    """

    def __init__(self, url: str) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="store")
        self._tried = (-math.inf, False)
        try:
            self.engine = sa.create_engine(url, **engine_options(url))
            if self.engine.dialect.name == "sqlite":
                sa.event.listen(self.engine, "connect", _pragmas)
                sa.event.listen(self.engine, "begin", lambda c: c.exec_driver_sql("BEGIN"))
            with self.engine.begin() as connection:
                _migrate(connection)
                tables = sa.MetaData()
                tables.reflect(connection)
                self.tables = tables.tables
                self.epoch = self._take_over(connection)
        except CommandError as error:
            raise InputError(f"database: a newer program wrote it ({error})") from error
        except (SQLAlchemyError, ModuleNotFoundError) as error:
            raise refusal(error, "cannot be opened") from error

    async def run(self, act: Callable[[sa.Connection], T]) -> T:
        """Run a transaction in the store's thread."""

        def transaction() -> T:
            with self.engine.begin() as connection:
                return act(connection)

        return await asyncio.get_running_loop().run_in_executor(self._thread, transaction)

    async def write(self, change: Change) -> None:
        """Write a change whole or not at all.

        Raises:
          ReplacedError: another gateway has taken over.
        """
        await self.run(lambda connection: self._write(connection, change))

    async def log(self, events: Sequence[Event], study: str | None = None) -> None:
        """Write events that change no trial."""
        await self.run(lambda connection: self._log(connection, study, events))

    async def studies(self) -> list[tuple[Study, Row | None]]:
        """All studies with their simulated rollouts, oldest first."""
        return await self.run(self._studies)

    async def write_job(self, job: Job, event: Event | None = None) -> None:
        """Write a job, and what happened to it.

        Raises:
          ReplacedError: another gateway has taken over.
        """

        def write(connection: sa.Connection) -> None:
            self._check(connection)
            row = job_row(job)
            self._put(connection, "jobs", {"id": row.pop("id")}, row)
            self._log(connection, None, [event] if event else [])

        await self.run(write)

    async def jobs(self) -> list[Job]:
        """All jobs, oldest first."""
        table = self.tables["jobs"]
        query = sa.select(table).order_by(table.c.created, table.c.id)
        return await self.run(lambda c: [job_of(dict(r._mapping)) for r in c.execute(query)])

    async def events(self, study: str, after: int, limit: int) -> list[Row]:
        """What happened in a study, oldest first."""
        table = self.tables["events"]
        query = sa.select(table).where(table.c.study == study, table.c.id > after)
        query = query.order_by(table.c.id).limit(limit)
        return await self.run(lambda c: [dict(r._mapping) for r in c.execute(query)])

    async def answer(self, key: str, who: str) -> Answer | None:
        """The answer given to a request before."""
        table = self.tables["answers"]
        query = sa.select(table).where(table.c.key == key, table.c.who == who)
        row = await self.run(lambda c: c.execute(query).one_or_none())
        return row and Answer(row.key, row.who, row.request, row.status, row.body, row.location)

    async def answered(self, answer: Answer) -> None:
        """Keep an answer for whoever asks again; forget those of last week."""
        table = self.tables["answers"]

        def keep(connection: sa.Connection) -> None:
            old = table.c.time < time.time() - ANSWERS_KEPT
            connection.execute(sa.delete(table).where(old))
            rest = {"request": answer.request, "status": answer.status}
            rest |= {"body": answer.body, "location": answer.location}
            where = {"key": answer.key, "who": answer.who}
            self._put(connection, "answers", where, rest | {"time": time.time()})

        await self.run(keep)

    async def writable(self) -> bool:
        """Whether the database takes writes of this gateway; tried once a second at most.

        A try that is given up leaves the thread when the database lets go of it.
        """
        at, told = self._tried
        if time.monotonic() - at > TRIED:
            try:
                await asyncio.wait_for(self.run(self._check), TRY)
                told = True
            except (SQLAlchemyError, ReplacedError, TimeoutError):
                told = False
            self._tried = time.monotonic(), told
        return told

    def close(self) -> None:
        """Let go of the database."""
        self._thread.shutdown()
        self.engine.dispose()

    def _take_over(self, connection: sa.Connection) -> int:
        table = self.tables["gateways"]
        last = connection.execute(sa.select(sa.func.max(table.c.epoch))).scalar() or 0
        before = sa.update(table).where(table.c.epoch == last)
        connection.execute(before.values(started=table.c.started))  # waits for its last commit
        connection.execute(sa.insert(table).values(epoch=last + 1, started=time.time()))
        return last + 1

    def _check(self, connection: sa.Connection) -> None:
        """Take the right to write, or find that another gateway has it."""
        table = self.tables["gateways"]
        mine = sa.update(table).where(table.c.epoch == self.epoch)
        connection.execute(mine.values(started=table.c.started))  # locks until the commit
        if connection.execute(sa.select(sa.func.max(table.c.epoch))).scalar() != self.epoch:
            raise ReplacedError("another gateway was started on this database; this one stops")

    def _write(self, connection: sa.Connection, change: Change) -> None:
        self._check(connection)
        row = study_row(change.study)
        more = {} if change.simulated is None else {"simulated": change.simulated}
        name = {"name": row.pop("name")}
        self._put(connection, "studies", name, row | more, {"created": time.time()})
        for trial in change.trials:
            row = trial_row(trial)
            where = {"study": row.pop("study"), "number": row.pop("number")}
            self._put(connection, "trials", where, row)
        self._log(connection, change.study.name, change.events)

    def _log(self, connection: sa.Connection, study: str | None, events: Sequence[Event]) -> None:
        rows = [
            {
                "time": time.time(),
                "study": study,
                "trial": e.trial,
                "kind": e.kind,
                "who": e.who,
                "detail": e.detail,
            }
            for e in events
        ]
        if rows:
            connection.execute(sa.insert(self.tables["events"]), rows)

    def _put(
        self,
        connection: sa.Connection,
        name: str,
        where: Row,
        values: Row,
        first: Row | None = None,
    ) -> None:
        """Change a row or, where there is none, add it with what is set but once."""
        table = self.tables[name]
        same = sa.and_(*(table.c[column] == value for column, value in where.items()))
        if not connection.execute(sa.update(table).where(same).values(values)).rowcount:
            connection.execute(sa.insert(table).values(where | values | (first or {})))

    def _studies(self, connection: sa.Connection) -> list[tuple[Study, Row | None]]:
        trials: dict[str, list[Row]] = {}
        for row in connection.execute(sa.select(self.tables["trials"])):
            trials.setdefault(row.study, []).append(dict(row._mapping))
        table = self.tables["studies"]
        rows = connection.execute(sa.select(table).order_by(table.c.created, table.c.name))
        return [
            (study_of(dict(row._mapping), trials.get(row.name, [])), row.simulated) for row in rows
        ]


def engine_options(url: str) -> dict[str, Any]:
    """Of SQLAlchemy's engine: no call waits long for a PostgreSQL that vanished.

    What the URL itself tells of a connection is left as it is.
    """
    place = sa.make_url(url)
    if place.get_backend_name() != "postgresql" or place.get_driver_name() not in LIBPQ:
        return {}
    waits = {name: value for name, value in WAITS.items() if name not in place.query}
    return {"pool_pre_ping": True, "connect_args": waits}


def refusal(error: Exception, otherwise: str) -> InputError | FailedError:
    """What is told of an error of the database in a line.

    Args:
      error: as it came.
      otherwise: what is the matter where trying again does not help.
    """
    place = (str(error) or type(error).__name__).splitlines()[0]
    if isinstance(error, OperationalError) and _may_pass(error):
        return FailedError(f"database: does not answer now ({place})")
    return InputError(f"database: {otherwise} ({place})")


def _may_pass(error: OperationalError) -> bool:
    """Whether trying again may help: a server may be late, a wrong path stays wrong."""
    code = getattr(error.orig, "sqlite_errorcode", None)
    return code is None or code & 0xFF in PASSING  # the low byte of an extended code is its kind


def _pragmas(connection: Any, _: Any) -> None:
    """A journal that readers do not wait for, and commits that outlive a power cut.

    Python's own transactions begin after a table was made: a kill would leave half a migration.
    """
    connection.isolation_level = None
    cursor = connection.cursor()
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=5000"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def _migrate(connection: sa.Connection) -> None:
    migrations = Migrations()
    migrations.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
    migrations.attributes["connection"] = connection
    command.upgrade(migrations, "head")
