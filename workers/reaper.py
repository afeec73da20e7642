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
from pathlib import Path

SESSION = "PUP_SESSION"
"""Environment variable that marks the processes of one owner."""


def start(folder: str) -> "subprocess.Popen[bytes]":
    """Start the watching process; closing its standard input, or dying, sets it off."""
    os.environ[SESSION] = folder
    unmarked = {k: v for k, v in os.environ.items() if k != SESSION}
    return subprocess.Popen(
        [sys.executable, "-m", "workers.reaper", folder, str(os.getpid())],
        stdin=subprocess.PIPE,
        env=unmarked,
        start_new_session=True,  # Ctrl-C in the terminal is not for it
    )


def _marked(folder: str) -> list[int]:
    """Processes of the session."""
    mark = f"{SESSION}={folder}".encode()
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (process / "environ").read_bytes().split(b"\0"):
                found.append(int(process.name))
        except OSError:
            continue  # ended meanwhile, or of another user
    return found


def _reap(folder: str, owner: int) -> None:
    """End the session's processes but its owner, which may have only disconnected."""
    for _ in range(50):
        left = [pid for pid in _marked(folder) if pid != owner]
        for pid in left:
            try:
                os.kill(pid, signal.SIGKILL)
            except ProcessLookupError:
                continue
        if not left:
            break
        time.sleep(0.1)
    shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # Ray sends it to all processes of a stopped job
    sys.stdin.buffer.read()
    _reap(sys.argv[1], int(sys.argv[2]))
