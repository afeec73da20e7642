"""A `pup` that runs in a process group of its own, to be stopped and killed."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

from workers import reaper

ROOT = Path(__file__).parent.parent
PATIENCE = 600.0
END = 540.0
"""For a job to end, s: less than pytest has for a test, so that a job that hangs is told of."""


def until(true: Callable[[], Any], patience: float = PATIENCE) -> None:
    deadline = time.monotonic() + patience
    while not true():
        assert time.monotonic() < deadline, "this should not take so long"
        time.sleep(0.02)


class Job:
    """A running `pup`, as a shell has it.

    Args:
      command: its arguments.
      out: the folder that it writes to.
    """

    def __init__(self, *command: object, out: Path) -> None:
        self.out = out
        self.process = subprocess.Popen(
            [sys.executable, "-m", "services.cli", *map(str, command), "--out", str(out), "--json"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env=os.environ | {"PYTHONFAULTHANDLER": "1"},
        )
        self.ray: str | None = None

    @property
    def pid(self) -> int:
        return self.process.pid

    def started_ray(self) -> str | None:
        """The folder of the job's embedded Ray, once there is one."""
        if self.ray is None:
            for child in psutil.Process(self.pid).children():
                command = command_of(child)
                if "workers.reaper" in command:
                    self.ray = command[-2]
        return self.ray

    def come_to(self, moment: str, files: int = 1) -> None:
        """Wait for a moment of the job: some files below its folder, or the start of its Ray."""
        if moment == "ray":
            until(lambda: self.process.poll() is not None or self.started_ray())
        else:
            until(
                lambda: self.process.poll() is not None or len(list(self.out.glob(moment))) >= files
            )
        assert self.process.poll() is None, self.process.communicate()
        self.started_ray()

    def end(self, patience: float = END) -> tuple[int, str, str]:
        """Wait for its end: the exit code, standard output and standard error.

        Raises:
          AssertionError: it hangs; says where, and what it and its processes have told.
        """
        try:
            out, err = self.process.communicate(timeout=patience)
        except subprocess.TimeoutExpired:
            raise AssertionError(f"hangs: {self._whereabouts()}") from None
        return self.process.returncode, out, err

    def _whereabouts(self) -> str:
        """Where a job that hangs and its processes stand, which ends them."""
        children = psutil.Process(self.pid).children(recursive=True)
        self.process.send_signal(signal.SIGSTOP)  # it would start those anew that end
        for child in children:
            with suppress(psutil.Error):
                child.send_signal(signal.SIGABRT)  # by which it tells where its threads are
        psutil.wait_procs(children, timeout=10.0)
        self.process.send_signal(signal.SIGABRT)
        self.process.send_signal(signal.SIGCONT)
        _, err = self.process.communicate()
        logs = [f"{file.name}: {_threads(file.read_text())}" for file in self.out.rglob("*.log")]
        journals = [f"{file.name}: {file.read_text()[-600:]}" for file in self.out.rglob("journal")]
        return "\n".join([_threads(err), *logs, *journals])

    def left(self) -> list[str]:
        """Processes of its Ray, and its Ray's folder."""
        if self.ray is None:
            return []
        mark = f"{reaper.SESSION}={self.ray}"
        found = [self.ray] if Path(self.ray).exists() else []
        for process in psutil.process_iter():
            try:
                environment = [f"{k}={v}" for k, v in process.environ().items()]
            except psutil.Error:
                environment = []
            if mark in environment or any(self.ray in word for word in command_of(process)):
                found.append(f"{process.pid} {' '.join(command_of(process))[:100]}")
        return found

    def assert_nothing_left(self) -> None:
        deadline = time.monotonic() + 10
        while left := self.left():
            assert time.monotonic() < deadline, left
            time.sleep(0.1)


@contextmanager
def holder(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that has a folder for itself."""
    code = "import sys; from pathlib import Path; from services.held import held\n"
    code += "with held(Path(sys.argv[1])): print(flush=True); sys.stdin.read()"
    command = [sys.executable, "-c", code, str(folder)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None and process.stdout.readline()
        yield process
        process.kill()


def _threads(told: str) -> str:
    """What a process told last, and where its threads are in our code: CI keeps few characters."""
    words, *ends = told.split("Fatal Python error")
    lines = [words[-400:]]
    for thread in "\n\n".join(end.partition("Extension modules")[0] for end in ends).split("\n\n"):
        frames = [line.strip() for line in thread.splitlines() if line.startswith("  File ")]
        ours = [line for line in frames[1:] if str(ROOT) in line and "/.venv/" not in line]
        lines += ["thread", *frames[:1], *ours]
    return "\n".join(lines).replace(f"{ROOT}/", "")


def command_of(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return []
