"""The process of a job on a Ray cluster: `python -m services.job_runner FOLDER ATTEMPT`.

It runs the verb that the folder's order names, with the log in shared storage, and writes down how
it ended. It starts only when an earlier attempt on the same folder has ended or fallen silent, and
ends when the order names another attempt or says stop. Whatever way it ends, nothing that it
started lives on.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from tempfile import mkdtemp
from typing import IO

from pup.errors import InputError
from services.held import OURS
from services.job_folder import REVOKED, JobFolder, Outcome
from workers import reaper

BEAT = 1.0
"""Between two signs of life, s."""
SILENCE = 10.0
"""After which an earlier attempt is taken for dead, s; it looks at its order each BEAT."""
ASK_AGAIN = 5.0
"""Until a verb that did not end with us, as it does when Ray stops a job, is asked to, s."""
PATIENCE = 20.0
"""For a verb that was asked to end, s."""
SAFE = {"PYTHONSAFEPATH": "1"}
"""Has a verb, and what it starts, import nothing from the shared storage, where it runs."""


class Runner:
    """One attempt at a job.

    Args:
      folder: of the job.
      attempt: number.
    """

    def __init__(self, folder: JobFolder, attempt: int) -> None:
        self.folder, self.attempt = folder, attempt
        self.asked: float | None = None
        """When it was asked to stop."""
        self._beats = 0

    def stop(self, *_: object) -> None:
        """Answer to SIGTERM and SIGINT."""
        self.asked = self.asked or time.monotonic()

    def run(self) -> int:
        """Run the verb; gives its exit code."""
        if not self._mine() or not self.folder.claim(self.attempt):
            return REVOKED
        self._wait_for_predecessor()
        if not self._mine():
            return REVOKED
        order = self.folder.order()  # the last word on what to run
        if order.fresh:
            shutil.rmtree(self.folder.out, ignore_errors=True)
        with open(self.folder.log, "a", encoding="utf-8", errors="replace") as log:
            begun = time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime())
            log.write(f"attempt {self.attempt} on {socket.gethostname()}, {begun} UTC\n")
            log.flush()
            code = self._verb(order.command, log)
        artifacts = self.folder.digests() if code == 0 else {}
        told = self.folder.last_line()
        self.folder.write_outcome(Outcome(self.attempt, code, told, artifacts))
        return code

    def _verb(self, command: list[str], log: IO[str]) -> int:
        mark = mkdtemp(prefix="pup-job-")
        watch = reaper.start(mark)  # outlives a kill of this process, and ends what is left
        try:
            child = subprocess.Popen(
                [sys.executable, "-m", "services.cli", *command],
                cwd=self.folder.shared,
                env=os.environ | SAFE | OURS,  # no lock of a node that vanished is waited for
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
            code = self._follow(child)
        finally:
            reaper.close(watch, mark)
        return code if code >= 0 else 128 - code

    def _follow(self, child: "subprocess.Popen[bytes]") -> int:
        told = False
        while True:
            self._beat()
            if self.asked is None and not self._mine():
                self.asked = time.monotonic() - ASK_AGAIN
            since = 0.0 if self.asked is None else time.monotonic() - self.asked
            if since > ASK_AGAIN and not told:
                child.terminate()
                told = True
            elif since > ASK_AGAIN + PATIENCE:
                child.kill()
            try:
                return child.wait(BEAT)
            except subprocess.TimeoutExpired:
                continue

    def _beat(self) -> None:
        self._beats += 1
        with suppress(OSError):  # a storage that is away for a moment ends no job
            self.folder.beat(self.attempt, self._beats)

    def _mine(self) -> bool:
        """Whether the attempt is still wanted, as far as is known."""
        try:
            order = self.folder.order()
        except (InputError, OSError):
            return self.asked is None
        return self.asked is None and order.attempt == self.attempt and not order.stop

    def _wait_for_predecessor(self) -> None:
        before = self.folder.heard()
        since = time.monotonic()
        while before and not self.folder.outcome(before[0]) and self._mine():
            if time.monotonic() - since > SILENCE:
                return
            time.sleep(BEAT)
            if (now := self.folder.heard()) != before:
                before, since = now, time.monotonic()


def main(folder: Path, attempt: int) -> int:
    """Run an attempt at the job of a folder."""
    runner = Runner(JobFolder(folder), attempt)
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, runner.stop)
    try:
        return runner.run()
    except (InputError, OSError) as error:
        print(f"job: {error}; is the shared storage there?", file=sys.stderr)
        return 1


if __name__ == "__main__":
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    sys.exit(main(Path(sys.argv[1]), int(sys.argv[2])))
