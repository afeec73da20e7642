"""Jobs that would starve each other of cores come one after the other; a Ray that only answers."""

import argparse
import asyncio
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi")

from pup.errors import InputError
from services.failures import FailedError
from services.gateway.dispatcher import Dispatcher, NoJobsError
from services.gateway.job_routes import artifacts, document
from services.gateway.jobs import Job, JobState, Seen, Status
from services.gateway.metrics import Metrics
from services.gateway.store import Store
from services.job_arguments import command, tasks
from services.job_folder import JobFolder, Outcome
from services.places import training
from workers.cluster import connected, staying

FIT = ("recordings", "--robot", "servo_bench")
OUT = Path("out")


class Ray:
    """A cluster that finds room for no job."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.stopped: list[str] = []
        self.full = set[str]()  # submissions that Ray has given up
        self.done = set[str]()

    async def check(self) -> None:
        """It is there."""

    async def submit(self, submission: str, entrypoint: str, cpus: float, gpus: float) -> None:
        self.asked.append(submission)

    async def stop(self, submission: str) -> None:
        self.stopped.append(submission)

    async def seen(self, submission: str) -> Seen:
        if submission in self.full:
            return Seen(Status.FAILED, unstarted=True)
        if submission in self.done:
            return Seen(Status.SUCCEEDED)
        return Seen(Status.PENDING if submission in self.asked else Status.UNKNOWN)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    (tmp_path / "recordings").mkdir()
    made = Store(f"sqlite:///{tmp_path / 'gateway.db'}")
    yield made
    made.close()


def job(**more: float) -> Job:
    return Job("", "presysid", FIT, "ann", 0.0, **more)


def test_jobs_wait_for_those_before_them(store: Store, tmp_path: Path) -> None:
    async def told() -> None:
        ray = Ray()
        jobs = Dispatcher(store, ray, tmp_path, Metrics(), lambda _: None)
        names = [(await jobs.submit(job(), None))[0].id for _ in range(3)]
        for number, name in enumerate(names):
            for _ in range(2):
                await jobs.tick()
            assert ray.asked == [f"{name}-1" for name in names[: number + 1]]
            assert jobs.waits_for(jobs.job(name)) == "room on the Ray cluster"
            for later in names[number + 1 :]:
                assert jobs.job(later).state is JobState.QUEUED
                assert jobs.waits_for(jobs.job(later)) == "other jobs"
            jobs.folder(name).write_outcome(Outcome(1, 0))
            await jobs.tick()
            assert jobs.job(name).state is JobState.SUCCEEDED

    asyncio.run(told())


def test_a_job_that_found_no_room_goes_behind_the_others(store: Store, tmp_path: Path) -> None:
    async def told() -> None:
        ray = Ray()
        jobs = Dispatcher(store, ray, tmp_path, Metrics(), lambda _: None)
        large, small = [(await jobs.submit(job(), None))[0].id for _ in range(2)]
        await jobs.tick()
        assert ray.asked == [f"{large}-1"]
        ray.full.add(f"{large}-1")
        for _ in range(3):
            await jobs.tick()
        assert ray.asked == [f"{large}-1", f"{small}-1"]
        assert jobs.job(large).state is JobState.QUEUED

    asyncio.run(told())


def test_what_never_finds_room_is_refused(store: Store, tmp_path: Path) -> None:
    async def told(cores: int, **more: float) -> None:
        jobs = Dispatcher(store, Ray(), tmp_path, Metrics(), lambda _: None, 1, cores)
        await jobs.submit(job(**more), None)

    asyncio.run(told(2))
    asyncio.run(told(0, cpus=64))
    with pytest.raises(InputError, match=r"needs 3 cores.*--cpus.*has 2"):
        asyncio.run(told(2, cpus=2))


@pytest.mark.parametrize(
    ("cores", "verb", "arguments"),
    [
        (1, "presysid", FIT),
        (0, "presysid", (*FIT, "--local")),
        (0, "replay", FIT),
        (0, "train", ()),
        (2, "train", ("--runners", "2")),
        (8, "train", ("--runners", "2", "--cores", "8")),
    ],
)
def test_cores_that_a_job_takes_beside_its_process(
    cores: int, verb: str, arguments: tuple[str, ...]
) -> None:
    assert tasks(command(verb, arguments, OUT)) == cores


@pytest.mark.ray
def test_runners_share_what_is_free_beside_the_process() -> None:
    import ray

    @ray.remote(num_cpus=1)
    class Process:
        """Holds a core, as Ray does for the process of a job."""

        def ready(self) -> None: ...

    def options(runners: int) -> argparse.Namespace:
        return argparse.Namespace(address="there", cores=None, runners=runners)

    with staying(), connected(cores=3):
        process = Process.remote()
        ray.get(process.ready.remote())
        with training(options(2)) as cores:
            assert cores == 2
        refused = pytest.raises(InputError, match="2 cores of the cluster are free")
        with refused, training(options(3)):
            pass
        other = Process.remote()
        ray.get(other.ready.remote())
        with pytest.raises(FailedError, match="1 cores"), training(options(2)):
            pass


@pytest.mark.parametrize("trouble", ["away", "full"])
def test_a_cancel_is_repeated_until_the_storage_takes_it(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trouble: str
) -> None:
    shared = tmp_path / "shared"
    (shared / "recordings").mkdir(parents=True)

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    async def told() -> None:
        ray = Ray()
        jobs = Dispatcher(store, ray, shared, Metrics(), lambda _: None)
        name = (await jobs.submit(job(), None))[0].id
        for _ in range(2):
            await jobs.tick()
        jobs.folder(name).claim(1)
        with monkeypatch.context() as patch:
            if trouble == "away":
                shared.rename(tmp_path / "unmounted")
            else:
                patch.setattr("services.job_folder.write_json", full)
            for _ in range(2):
                with pytest.raises(NoJobsError, match=r"is called off, but the shared storage"):
                    await jobs.cancel(name, "ann")
            await jobs.tick()
            assert jobs.job(name).state is JobState.CANCELLING
            assert "the shared storage, which takes no files" in jobs.waits_for(jobs.job(name))
            assert set(ray.stopped) <= {f"{name}-1"} and bool(ray.stopped) == (trouble == "full")
        if trouble == "away":
            (tmp_path / "unmounted").rename(shared)
        await jobs.tick()
        assert jobs.folder(name).order().stop and not jobs.trouble
        written = jobs.folder(name).path / "order.json"
        before = written.stat().st_mtime_ns
        await jobs.tick()
        assert written.stat().st_mtime_ns == before  # once is enough
        jobs.folder(name).write_outcome(Outcome(1, 130))
        await jobs.tick()
        assert jobs.job(name).state is JobState.CANCELLED

    asyncio.run(told())


def test_a_job_whose_folder_was_removed_can_be_called_off(store: Store, tmp_path: Path) -> None:
    async def told() -> None:
        jobs = Dispatcher(store, Ray(), tmp_path, Metrics(), lambda _: None)
        name = (await jobs.submit(job(), None))[0].id
        for _ in range(2):
            await jobs.tick()
        shutil.rmtree(jobs.folder(name).path)
        assert (await jobs.cancel(name, "ann")).state is JobState.CANCELLED

    asyncio.run(told())


def test_an_outcome_of_another_shape_holds_no_job_up(store: Store, tmp_path: Path) -> None:
    async def told() -> None:
        ray = Ray()
        jobs = Dispatcher(store, ray, tmp_path, Metrics(), lambda _: None)
        name = (await jobs.submit(job(), None))[0].id
        for _ in range(2):
            await jobs.tick()
        folder = jobs.folder(name)
        (folder.path / "outcome-1.json").write_text('{"schema": 1, "exit": "none"}')
        folder.out.mkdir()
        (folder.out / "a").touch()
        ray.done.add(f"{name}-1")
        await jobs.tick()
        assert jobs.job(name).state is JobState.SUCCEEDED  # as Ray says
        listed, _ = await artifacts(jobs, jobs.job(name))
        assert [(row["name"], row["sha256"]) for row in listed] == [("a", None)]

    asyncio.run(told())


def test_a_file_that_is_removed_while_files_are_listed_is_none(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = JobFolder.files

    def files(folder: JobFolder) -> Iterator[tuple[str, Path]]:
        for name, path in found(folder):
            if name == "a":
                path.unlink()  # after it was found, before it is asked for its size
            yield name, path

    monkeypatch.setattr(JobFolder, "files", files)

    async def told() -> None:
        jobs = Dispatcher(store, Ray(), tmp_path, Metrics(), lambda _: None)
        made, _ = await jobs.submit(job(), None)
        out = jobs.folder(made.id).out
        out.mkdir()
        for name in "abc":
            (out / name).touch()
        listed, more = await artifacts(jobs, made, 2)
        assert [row["name"] for row in listed] == ["b", "c"] and more is None

    asyncio.run(told())


def test_storage_that_hangs_takes_no_threads_of_others(store: Store, tmp_path: Path) -> None:
    async def told() -> None:
        jobs = Dispatcher(store, Ray(), tmp_path, Metrics(), lambda _: None)
        made, _ = await jobs.submit(job(), None)
        log = jobs.folder(made.id).log
        os.mkfifo(log)  # who opens it waits, as on a mount whose server is gone
        asked = [asyncio.create_task(document(jobs, made)) for _ in range(64)]
        try:
            await asyncio.sleep(0.2)
            assert not any(task.done() for task in asked)
            assert await asyncio.wait_for(asyncio.to_thread(lambda: "link"), 10) == "link"
        finally:
            end = os.open(log, os.O_RDWR)
            await asyncio.gather(*asked)
            os.close(end)

    asyncio.run(told())
