"""A disk that takes nothing, and a second agent at it: nothing is lost, no robot falls for it."""

import os
import resource
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from agents import CONFIG, DARWIN, bundle, standing, wait
from test_agent import assign, at_work

from hardware_agent.cli import main
from hardware_agent.flight import FlightRecorder
from hardware_agent.journal import own
from hardware_agent.rollout import row_names
from pup.errors import InputError
from pup.recording import Recording
from pup.wire import Cancel, Finished, Outcome

RUN = (sys.executable, "-m", "hardware_agent.cli", "run", "--config")


@contextmanager
def full(pid: int, size: int = 0) -> Iterator[None]:
    """Files of a process do not grow beyond a size, as on a disk that is full."""
    before = resource.prlimit(pid, resource.RLIMIT_FSIZE)
    resource.prlimit(pid, resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.prlimit(pid, resource.RLIMIT_FSIZE, before)


def test_a_full_disk_keeps_a_robot_standing_and_its_trials_waiting(tmp_path: Path) -> None:
    """It takes no trial, then not the end of one; with room again each is told, once."""
    pytest.importorskip("mujoco")
    policy = bundle(tmp_path / "policies" / "standing", standing())
    with at_work(tmp_path) as (made, gateway):
        assert made.agent is not None
        with full(made.agent.pid):
            gateway.send(assign(policy, "a", 0.5))
            wait(lambda: bool(made.health()["problems"]), 10, made.log)
            told = made.health()
            assert "state/journal: cannot be written" in told["problems"][0]
            assert (told["state"], told["trial"]) == ("enabled", None)
        assert gateway.run(assign(policy, "a", 0.5), told=made.log).state is Outcome.SUCCEEDED
        assert not made.health()["problems"]

        gateway.send(assign(policy, "b", 10.0))
        wait(lambda: made.health()["stage"] == "running", 60, made.log)
        with full(made.agent.pid):
            wait(lambda: made.health()["stage"] == "ending", 60, made.log)
            assert not [f for f in gateway.of(Finished) if f.trial == "b"]
        wait(lambda: made.health()["stage"] == "none", 20, made.log)
        wait(lambda: any(f.trial == "b" for f in gateway.of(Finished)), 20, made.log)
        (end,) = {f for f in gateway.of(Finished) if f.trial == "b"}
        assert end.state is Outcome.SUCCEEDED and end.distance is not None
        assert end.recording is not None
        kept = Recording.read(tmp_path / "state" / "recordings" / f"{end.recording}.parquet")
        assert kept.time[-1] > 9.0 and kept.notes.endswith("reached the horizon")
        assert made.health()["state"] == "enabled"


def test_a_trial_that_cannot_be_written_down_does_not_walk(tmp_path: Path) -> None:
    """And one that walks stops when it is cancelled, though that cannot be written down either."""
    pytest.importorskip("mujoco")
    policy = bundle(tmp_path / "policies" / "standing", standing())
    with at_work(tmp_path) as (made, gateway):
        assert made.agent is not None
        gateway.send(assign(policy, "a", 600.0))
        wait(lambda: made.health()["stage"] in ("posing", "placing", "settling"), 60, made.log)
        with full(made.agent.pid):
            wait(lambda: made.health()["stage"] == "ending", 60, made.log)
        end = gateway.wait(Finished)
        assert end.state is Outcome.ABORTED and "journal: cannot be written" in end.reason
        assert made.health()["state"] == "enabled"

        gateway.send(assign(policy, "b", 600.0))
        wait(lambda: made.health()["stage"] == "running", 60, made.log)
        with full(made.agent.pid):
            gateway.send(Cancel("b", 1, 2))
            wait(lambda: made.health()["stage"] == "ending", 60, made.log)
        end = gateway.wait(Finished)
        assert (end.trial, end.state) == ("b", Outcome.ABORTED)


def test_at_the_start_it_is_told_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "agent.toml"
    file.write_text(CONFIG.format(folder=tmp_path, protocol=1, clock="lockstep"))
    done = subprocess.run(
        ["sh", "-c", 'ulimit -f 0; exec "$@"', "sh", *RUN, str(file)],
        capture_output=True,
        text=True,
        timeout=60,
    )
    (line,) = done.stderr.splitlines()
    assert line.startswith("pup-agent run: ") and "journal: cannot be written" in line
    assert done.returncode == 1, "it may pass: systemd tries again"


def test_a_second_agent_leaves_the_journal_of_the_first_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Whatever the first one walks is no motion that a power cut has interrupted."""
    pytest.importorskip("mujoco")
    policy = bundle(tmp_path / "policies" / "standing", standing())
    with at_work(tmp_path) as (made, gateway):
        gateway.send(assign(policy, "a", 600.0))
        wait(lambda: made.health()["stage"] == "running", 60, made.log)
        journal = tmp_path / "state" / "journal"
        before, text = journal.read_bytes(), made.config.read_text()
        other = tmp_path / "other.toml"
        other.write_text(text.replace('"agent.sock"', '"other.sock"'))
        for config in (made.config, other):
            assert main(["run", "--config", str(config)]) == 2
            told = capsys.readouterr().err
            assert "state: another agent's journal is there" in told and told.count("\n") == 1
        assert journal.read_bytes() == before
        assert made.health()["stage"] == "running"


def test_a_folder_is_free_again_when_its_agent_is_gone(tmp_path: Path) -> None:
    holds = "import sys; from pathlib import Path; from hardware_agent.journal import own; "
    holds += "own(Path(sys.argv[1])); print(flush=True); sys.stdin.read()"
    pipe = subprocess.PIPE
    with subprocess.Popen(
        [sys.executable, "-c", holds, str(tmp_path / "state")], stdin=pipe, stdout=pipe
    ) as first:
        assert first.stdout is not None
        first.stdout.readline()
        with pytest.raises(InputError, match="another agent's journal"):
            own(tmp_path / "state")
        first.kill()
    own(tmp_path / "state")
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="file: cannot be written"):
        own(tmp_path / "file")


def test_half_a_row_of_a_flight_is_never_read_as_part_of_others(tmp_path: Path) -> None:
    """The disk is full for a moment; whatever came after it would be shifted by half a row."""
    joints, width = DARWIN.joint_names, len(row_names(DARWIN.joint_names))
    rows: list[Any] = [SimpleNamespace(values=np.full(width, float(n))) for n in range(30)]
    recorder = FlightRecorder(tmp_path / "walk", joints)
    told = assign(bundle(tmp_path / "policy"), "a", 14.0)
    recorder.begin(told)
    recorder.keep(rows[:2])
    with full(os.getpid(), (tmp_path / "walk").stat().st_size + 8 * width // 2):
        recorder.keep(rows[:4])
    recorder.keep(rows)
    left = recorder.left()
    assert left is not None and left.assign == told
    assert (left.rows == np.arange(len(left.rows))[:, None]).all() and len(left.rows) >= 2
