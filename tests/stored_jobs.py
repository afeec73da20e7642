"""Jobs in every state, as a gateway of yesterday left them in its store and in shared storage."""

import asyncio
import time
from pathlib import Path

from services.gateway.jobs import Attempt, Job, JobState
from services.gateway.store import Store
from services.job_folder import Order, Outcome, folder_of

NOW = time.time()
FIT = ("recordings", "--robot", "darwin_leg")


def of(name: str, state: JobState, reason: str = "", who: str = "operator", **more) -> Job:
    over = state in (JobState.SUCCEEDED, JobState.FAILED, JobState.CANCELLED, JobState.LOST)
    ended, outcome = (NOW - 5, reason or "done") if over else (None, "")
    attempt = Attempt(1, NOW - 90, True, NOW - 80, ended, outcome)
    return Job(
        f"job-{name}",
        "presysid",
        FIT,
        who,
        NOW - 100,
        state=state,
        reason=reason,
        attempts=(attempt,),
        **more,
    )


ALL = (
    of("done", JobState.SUCCEEDED),
    of("failed", JobState.FAILED, "exit code 1: out of memory <script>alert(1)</script>"),
    of("lost", JobState.LOST, "the Ray cluster does not know it any more; was its head restarted?"),
    of("cancelled", JobState.CANCELLED, "cancelled by operator", cancelled_by="operator"),
    of("running", JobState.RUNNING),
    of("other", JobState.RUNNING, who="somebody-else"),
)


def keep(data: Path, shared: Path) -> None:
    """Write them, before the gateway starts."""
    data.mkdir(parents=True)
    store = Store(f"sqlite:///{data.absolute() / 'gateway.db'}")
    for job in ALL:
        asyncio.run(store.write_job(job))
        folder = folder_of(shared, job.id)
        folder.write_order(Order(job.id, 1, False, False, ["presysid", *FIT]))
        folder.claim(1)
        folder.log.write_text("attempt 1 on node\ngeneration 3 of 100, loss 0.0123\n")
    store.close()
    done = folder_of(shared, "job-done")
    (done.out / "checkpoints").mkdir(parents=True)
    (done.out / "bounds.json").write_text('{"schema": 1}')
    (done.out / "checkpoints" / "fit 1%.npz").write_bytes(bytes(range(256)) * 1000)
    (done.out / ".bounds.json.tmp").write_text("half")
    (done.out / "link").symlink_to("/etc/hostname")
    done.write_outcome(Outcome(1, 0, "", done.digests()))
