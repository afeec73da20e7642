"""deploy/docker/agent.sh: process 1 of the agent's container, in a process namespace like its."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from agents import Lab, children, lab, wait
from manifests import ROOT
from test_agent import limp

CONTAINED = ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc"]
ENTRY = ["/bin/sh", str(ROOT / "deploy/docker/agent.sh")]
SEARCH = f"{Path(sys.executable).parent}:{os.environ['PATH']}"


def may_contain() -> bool:
    return bool(shutil.which(CONTAINED[0])) and not subprocess.run([*CONTAINED, "true"]).returncode


pytestmark = pytest.mark.skipif(
    not may_contain(), reason="needs the right to make a process namespace"
)


def start(made: Lab) -> tuple[int, int]:
    """Start the container; the ids of its process 1 and of the agent."""
    log = (made.folder / "agent.log").open("ab")
    command = [*CONTAINED, *ENTRY, "--config", str(made.config)]
    made.agent = subprocess.Popen(
        command, stderr=log, stdout=log, env=os.environ | {"PATH": SEARCH}
    )
    wait(made.ready, 60, made.log)
    (first,) = children(made.agent.pid)
    (agent,) = children(first)
    return first, agent


def test_a_killed_agent_leaves_the_robot_limp(tmp_path: Path) -> None:
    with lab(tmp_path) as made:
        _, agent = start(made)
        made.say("enable")
        made.until("enabled")
        os.kill(agent, signal.SIGKILL)
        assert made.agent is not None and made.agent.wait(timeout=60) == 128 + signal.SIGKILL
        assert limp(made)
        assert "watchdog: the agent has ended; torque is off" in made.log()


def test_a_stopped_container_leaves_the_robot_limp(tmp_path: Path) -> None:
    with lab(tmp_path) as made:
        first, _ = start(made)
        made.say("enable")
        made.until("enabled")
        os.kill(first, signal.SIGTERM)
        assert made.agent is not None and made.agent.wait(timeout=60) == 0, made.log()
        assert limp(made)


def test_a_mistake_in_the_configuration_ends_it_at_once(tmp_path: Path) -> None:
    (tmp_path / "agent.toml").write_text("schema = 2\n")
    told = subprocess.run(
        [*CONTAINED, *ENTRY, "--config", str(tmp_path / "agent.toml")],
        capture_output=True,
        text=True,
        env=os.environ | {"PATH": SEARCH},
        timeout=60,
    )
    assert told.returncode == 2
    assert told.stderr.count("\n") == 1 and "schema" in told.stderr
