"""Has jobs run on a Ray cluster, and brings what is stored in line with what became of them.

What keeps an attempt from being lost or made twice: it is stored before Ray is asked for it, under
a name of ours, so that it can be asked for again; its process takes it by a file in shared storage
that can be made but once, and ends when the order there names another attempt. A gateway that dies
between any two of these finds in the store and in shared storage where it was.
"""

import asyncio
import hashlib
import logging
import secrets
import shlex
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pup.errors import InputError
from pup.transfer.trial import TrialError, UnknownError
from services.gateway.jobs import Job, JobState, Seen, Status, reconciled
from services.gateway.metrics import Metrics
from services.gateway.ray_jobs import RayAwayError, RayJobs
from services.gateway.storage import on_storage
from services.gateway.store import Event, ReplacedError, Store
from services.job_arguments import RESUMABLE, command, tasks
from services.job_folder import JobFolder, Order, folder_of

log = logging.getLogger(__name__)

PERIOD = 1.0
"""Between two looks at the jobs under way, s."""
AT_ONCE = 8
"""Jobs that are looked at together."""
OPEN_LIMIT = 1000
"""Jobs that may be under way or wait."""
LIST = "jobs/"
"""What those are told by who wait for any job to change; no study has this name."""
NO_CLUSTER = "this service has no Ray cluster; set ray and shared"
NO_STORAGE = "the shared storage is not set, so no file of a job can be read; set ray and shared"
NOWHERE = Path("/nonexistent")
"""The shared storage where none is set: an empty path would be the working directory."""


class NoJobsError(RuntimeError):
    """The service has no cluster, or cannot reach what jobs need."""


@dataclass(frozen=True)
class _NoFolder(JobFolder):
    """A job's folder where no shared storage is set: its files are not gone, but out of sight."""

    def files(self) -> Iterator[tuple[str, Path]]:
        raise NoJobsError(NO_STORAGE)

    def file(self, name: str) -> Path | None:
        raise NoJobsError(NO_STORAGE)


class Dispatcher:
    """The jobs of one gateway.

    Args:
      store: what must not be forgotten.
      ray: the cluster; None where none is set, and jobs of earlier days are left as they are.
      shared: root of the shared storage, which nothing is read from without a cluster.
      metrics: counts.
      notify: tells whoever waits that a job changed.
      at_once: jobs that Ray is asked for together; see Config.
      cores: of the cluster; 0 where it grows by itself.
    """

    def __init__(
        self,
        store: Store,
        ray: RayJobs | None,
        shared: Path,
        metrics: Metrics,
        notify: Callable[[str], None],
        at_once: int = 1,
        cores: int = 0,
    ) -> None:
        self.store, self.ray = store, ray
        self.shared = NOWHERE if ray is None else shared
        self.metrics, self.notify = metrics, notify
        self.at_once, self.cores = at_once, cores
        self.jobs: dict[str, Job] = {}
        self.trouble = ""
        """What all jobs wait for, in words, or empty."""
        self._away = self._failed = ""
        self._stopped: ReplacedError | None = None
        self._locks: dict[str, asyncio.Lock] = defaultdict(asyncio.Lock)
        self._sizes: dict[str, int] = {}
        self._turn: set[str] = set()

    async def load(self) -> None:
        """Read the store."""
        self.jobs = {job.id: job for job in await self.store.jobs()}

    async def run(self) -> None:
        """Go on until the process ends.

        Raises:
          ReplacedError: another gateway has taken over.
        """
        while self._stopped is None:
            await self.tick()
            await asyncio.sleep(PERIOD)
        raise self._stopped

    async def tick(self) -> None:
        """Look once at all jobs under way."""
        if self.ray is None:
            waits = any(job.open for job in self.jobs.values())
            self._say("a cluster: set ray and shared" if waits else "")
            return
        self._away = self._failed = ""
        try:
            await self.ray.check()
        except RayAwayError as error:
            self._away = f"the Ray cluster, which {error}"
        self.metrics.ray.set(not self._away)
        self._turn = self._due()
        room = asyncio.Semaphore(AT_ONCE)

        async def look(name: str) -> None:
            async with room:
                await self._look(name)

        await asyncio.gather(*(look(job.id) for job in self.jobs.values() if job.open))
        self._say(self._away or self._failed)

    def _due(self) -> set[str]:
        """Queued jobs whose turn it is, the first ones that came.

        A job's process holds its cores while its tasks wait for some: too many would wait for ever.
        One that found no room goes behind the others, who may find some.
        """
        now = time.time()
        queued = [j for j in self.jobs.values() if j.state is JobState.QUEUED and not j.waits(now)]
        queued.sort(key=lambda job: job.roomless)
        return {job.id for job in queued[: max(0, self.at_once - self._under_way())]}

    def _under_way(self) -> int:
        return sum(j.open and j.state is not JobState.QUEUED for j in self.jobs.values())

    def job(self, name: str) -> Job:
        """A job by its id.

        Raises:
          UnknownError: there is none.
        """
        if name not in self.jobs:
            raise UnknownError(f"there is no job {name}")
        return self.jobs[name]

    def folder(self, name: str) -> JobFolder:
        """The folder of a job; one that refuses to be read where no shared storage is set."""
        folder = folder_of(self.shared, self.job(name).id)
        return _NoFolder(folder.path) if self.ray is None else folder

    async def submit(self, wanted: Job, key: str | None) -> tuple[Job, bool]:
        """Take on a job; one that was submitted with the same key is found again.

        Args:
          wanted: what shall be run; its id is made here.
          key: of the client's own, or None.

        Returns:
          The job, and whether it is new.

        Raises:
          NoJobsError: there is no cluster, or too much waits for it.
          InputError: the verb would refuse the arguments.
          TrialError: the key had another job.
        """
        self._check_cluster()
        job = _named(wanted, key)
        async with self._locks[job.id]:
            if before := self.jobs.get(job.id):
                if (before.verb, before.arguments) != (job.verb, job.arguments):
                    raise TrialError("this Idempotency-Key had another job")
                return before, False
            if sum(j.open for j in self.jobs.values()) >= OPEN_LIMIT:
                raise NoJobsError(f"{OPEN_LIMIT} jobs wait already")
            try:
                await on_storage(self._check, job)
                await on_storage(self._order, job, 0)
            except OSError as error:
                raise NoJobsError(_full(error)) from error
            detail = {"verb": job.verb, "arguments": list(job.arguments)}
            await self._write(job, Event("submitted", job.who, detail=detail))
        return job, True

    async def cancel(self, name: str, who: str) -> Job:
        """Call a job off; nothing of it goes on, whether Ray answers or not.

        Raises:
          TrialError: it has ended.
          NoJobsError: there is no cluster, and nothing was done; or its process is yet to be told,
            as soon as the shared storage takes files.
        """
        self._check_cluster()
        async with self._locks[name]:
            job = self.job(name)
            if not job.open:
                raise TrialError(f"{name} has {job.state}")
            if (now := job.cancel(who)) != job:
                await self._write(now, Event("cancelled", who))
            if now.open:
                try:
                    await on_storage(folder_of(self.shared, name).revoke)
                except OSError as error:
                    raise NoJobsError(f"{name} is called off, but {_full(error)}") from error
        await self._look(name)
        return self.job(name)

    async def retry(self, name: str, attempt: int, who: str) -> Job:
        """Attempt a job again that ended without a result; it resumes.

        Raises:
          NoJobsError: there is no cluster.
          TrialError: it goes on, is done, or has another number of attempts.
        """
        self._check_cluster()
        async with self._locks[name]:
            job = self.job(name)
            if job.open or job.state is JobState.SUCCEEDED:
                raise TrialError(f"{name} is {job.state}; only what ended without a result can be")
            if attempt != len(job.attempts) + 1:
                raise TrialError(f"{name}: the next attempt is {len(job.attempts) + 1}")
            await self._write(job.again(who), Event("retried", who))
        return self.job(name)

    def newest(self) -> Sequence[Job]:
        """All jobs, newest first."""
        return list(reversed(self.jobs.values()))

    def waits_for(self, job: Job) -> str:
        """What a job waits for, in words."""
        if not job.open:
            return ""
        if self.trouble:
            return self.trouble
        if job.state is JobState.QUEUED and (left := job.waits(time.time())):
            return f"its next attempt, in {left:.0f} s"
        if job.state is JobState.QUEUED and self._under_way() >= self.at_once:
            return "other jobs"
        return "room on the Ray cluster" if job.state is JobState.WAITING else ""

    def measure(self) -> None:
        """Bring the gauges up to date."""
        states = [job.state for job in self.jobs.values()]
        for state in JobState:
            self.metrics.jobs.labels(state.value).set(states.count(state))

    async def _look(self, name: str) -> None:
        try:
            async with self._locks[name]:
                job = self.jobs[name]
                if job.state is JobState.QUEUED:
                    await self._attempt(job)
                elif job.open:
                    try:
                        await self._follow(job)
                    finally:  # again: the storage may have taken nothing when it was called off
                        if self.jobs[name].state is JobState.CANCELLING:
                            await on_storage(folder_of(self.shared, name).revoke)
        except OSError as error:
            self._failed = f"the shared storage, which takes no files ({error.strerror or error})"
        except RayAwayError as error:
            self._failed = f"the Ray cluster, which {error}"
        except ReplacedError as error:
            self._stopped = error
        except Exception as error:
            log.error("job failed", extra={"job": name}, exc_info=error)

    async def _attempt(self, job: Job) -> None:
        """Store a new attempt, then ask Ray for it."""
        if self._away or job.id not in self._turn:
            return
        before, job = job, job.attempted(time.time())
        try:
            await on_storage(self._order, job, job.last.number)
        except InputError as error:  # a newer program may refuse what an older one took
            failed = replace(before, state=JobState.FAILED, reason=str(error))
            await self._write(failed, Event("failed"))
            return
        await self._write(job, Event("attempted", detail={"attempt": job.last.number}))
        await self._submit(job)

    async def _submit(self, job: Job) -> None:
        assert self.ray is not None
        folder = folder_of(self.shared, job.id)
        entrypoint = f"python -m services.job_runner {shlex.quote(str(folder.path))}"
        entrypoint += f" {job.last.number}"
        await self.ray.submit(_submission(job), entrypoint, job.cpus, job.gpus)
        await self._write(job.known())

    async def _follow(self, job: Job) -> None:
        """See what became of the attempt under way."""
        assert self.ray is not None
        folder, number = folder_of(self.shared, job.id), job.last.number
        outcome = await on_storage(folder.outcome, number)
        claimed = await on_storage(folder.claimed, number)
        seen = Seen(Status.AWAY)
        if not self._away:
            seen = await self.ray.seen(_submission(job))
        now = reconciled(job, seen, outcome, claimed, time.time())
        if now.last.ended is not None and now.state is not JobState.SUCCEEDED:
            await on_storage(folder.revoke)  # it may live on behind a cut
        if now != job:
            await self._write(now, None if now.state is job.state else Event(now.state.value))
        if now.open and now.state is not JobState.QUEUED:
            unknown = seen.status is Status.UNKNOWN
            if now.cancelled_by and seen.status in (Status.PENDING, Status.RUNNING):
                await self.ray.stop(_submission(now))
            elif unknown and not now.last.known and not now.cancelled_by:
                await self._submit(now)
        elif now.cancelled_by and seen.status is Status.PENDING:
            await self.ray.stop(_submission(now))
        if now.last.ended is not None:
            self.metrics.attempts.labels(now.state.value).inc()
        await self._heard(now)

    async def _heard(self, job: Job) -> None:
        """Tell whoever watches that there is more to read."""
        folder = folder_of(self.shared, job.id)
        size = await on_storage(folder.log_size)
        if self._sizes.get(job.id) != size:
            self._sizes[job.id] = size
            self.notify(LIST + job.id)

    def _check_cluster(self) -> None:
        if self.ray is None:
            raise NoJobsError(NO_CLUSTER)

    def _check(self, job: Job) -> None:
        """Refuse what the verb would refuse, and what finds no room on a cluster of fixed size."""
        out = folder_of(self.shared, job.id).out
        asked = job.cpus + tasks(command(job.verb, job.arguments, out, job.cpus, self.shared))
        if self.cores and asked > self.cores:
            raise InputError(
                f"needs {asked:g} cores, {job.cpus:g} for its process (--cpus) and the others for "
                f"its tasks; the cluster has {self.cores}"
            )

    def _order(self, job: Job, attempt: int) -> None:
        """Tell the job's process what to do."""
        folder = folder_of(self.shared, job.id)
        told = command(job.verb, job.arguments, folder.out, job.cpus)
        folder.write_order(Order(job.id, attempt, False, job.verb not in RESUMABLE, told))

    async def _write(self, job: Job, event: Event | None = None) -> None:
        """Store a job, then make it known."""
        if event is not None:
            event.detail["job"] = job.id
            log.info("job %s", event.kind, extra={"job": job.id, "who": event.who})
        await self.store.write_job(job, event)
        self.jobs[job.id] = job
        self.notify(LIST + job.id)
        self.notify(LIST)

    def _say(self, trouble: str) -> None:
        if trouble != self.trouble:
            log.warning(f"jobs wait for {trouble}" if trouble else "jobs go on")
            for name in [LIST, *(LIST + job.id for job in self.jobs.values() if job.open)]:
                self.notify(name)
        self.trouble = trouble


def _named(job: Job, key: str | None) -> Job:
    """With an id: of the key, where there is one, so that the same request finds the same job."""
    told = f"{job.who}\n{key}".encode()
    digest = secrets.token_hex(6) if key is None else hashlib.sha256(told).hexdigest()[:12]
    return replace(job, id=f"job-{digest}")


def _full(error: OSError) -> str:
    return f"the shared storage takes no files ({error.strerror or error})"


def _submission(job: Job) -> str:
    """What Ray calls an attempt."""
    return f"{job.id}-{job.last.number}"
