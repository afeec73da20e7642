"""Ends what a killed owner leaves behind: an embedded Ray, or the processes of a laboratory.

Ray's own processes follow a killed owner within seconds, some of its agents only after minutes,
and its folder never; those of a laboratory do not follow at all. The owner starts this module as a
process that holds the other end of a pipe: when the pipe closes, whatever way the owner ended, it
ends the processes marked with the session's name in their environment and removes the folder. On
systems without /proc it only does the latter.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

SESSION = "PUP_SESSION"
"""Environment variable that marks the processes of one owner."""
ALIVE = b"alive"
"""What an owner says that ends its processes and goes on; one that is killed says nothing."""


def start(folder: str) -> "subprocess.Popen[bytes]":
    """Mark all that this process starts from now on, and start the watching process."""
    os.environ[SESSION] = folder
    return watch(folder)


def watch(folder: str) -> "subprocess.Popen[bytes]":
    """Start the watching process; closing its standard input, or dying, sets it off.

    For an owner that marks its processes itself: this one may start others meanwhile.
    """
    unmarked = {k: v for k, v in os.environ.items() if k != SESSION}
    return subprocess.Popen(
        [sys.executable, "-m", "workers.reaper", folder, str(os.getpid())],
        stdin=subprocess.PIPE,
        env=unmarked,
        start_new_session=True,  # Ctrl-C in the terminal is not for it
    )


def marked(mark: str) -> list[int]:
    """Processes that have a mark, `NAME=value`, in their environment."""
    wanted, found = mark.encode(), []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if wanted in (process / "environ").read_bytes().split(b"\0"):
                found.append(int(process.name))
        except OSError:
            continue  # ended meanwhile, or of another user
    return found


def end(mark: str, spared: int | None = None, tries: int = 50, calm: int = 1) -> bool:
    """Kill the processes that have a mark, and those that they start meanwhile.

    Args:
      mark: as in `marked`.
      spared: a process that has it and goes on.
      tries: a tenth of a second each.
      calm: times in a row that none may be seen. One that is being started has no environment for
        a moment, and on a busy machine for longer.

    Returns:
      Whether none is left.
    """
    quiet = 0
    for _ in range(tries):
        left = [pid for pid in marked(mark) if pid != spared]
        quiet = 0 if left else quiet + 1
        if quiet == calm:
            return True
        for pid in left:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.1)
    return False


def close(watching: "subprocess.Popen[bytes]", folder: str) -> None:
    """Set the watching process off from an owner that goes on, and wait for it."""
    watching.communicate(ALIVE)
    if os.environ.get(SESSION) == folder:
        del os.environ[SESSION]


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # Ray sends it to all processes of a stopped job
    told = sys.stdin.buffer.read()
    _, session, owner = sys.argv
    if told == ALIVE:  # it has only disconnected, and waits
        end(f"{SESSION}={session}", spared=int(owner))
    else:
        end(f"{SESSION}={session}", tries=100, calm=20)
    shutil.rmtree(session, ignore_errors=True)
