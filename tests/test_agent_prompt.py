"""Whoever stands at the robot: lets trials start, stops it by any key, tells distances."""

import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import pytest
from agents import Lab, bundle, lab, standing, wait
from test_agent import assign, at_work

from hardware_agent.prompt import MOVING
from pup.errors import InputError
from pup.wire import Armed, Finished, Outcome

pytest.importorskip("mujoco")

BY_HAND = '[control]\ngate = "operator"\n[distance]\nkind = "operator"\n'


@contextmanager
def operating(made: Lab) -> Iterator[tuple["subprocess.Popen[bytes]", IO[bytes], int]]:
    """The prompt, what it prints, and the operator's end of its terminal; that is the test's."""
    keys, theirs = pty.openpty()
    command = [sys.executable, "-m", "hardware_agent.cli", "operate", "--config", str(made.config)]
    prompt = subprocess.Popen(command, stdin=theirs, stdout=subprocess.PIPE, start_new_session=True)
    os.close(theirs)
    assert prompt.stdout is not None and b"STOPS" in prompt.stdout.readline()
    try:
        yield prompt, prompt.stdout, keys
    finally:
        prompt.kill()
        prompt.wait()
        prompt.stdout.close()


@pytest.mark.slow
def test_the_operator_lets_trials_start_and_tells_distances(tmp_path: Path) -> None:
    policy = bundle(tmp_path / "policies" / "still")
    with at_work(tmp_path, more=BY_HAND) as (made, gateway):
        gateway.send(assign(policy, "a"))
        wait(lambda: made.health()["waiting"] == "arm", 20, made.log)
        assert not gateway.of(Armed)
        made.say("arm")
        wait(lambda: made.health()["waiting"] == "distance", 20, made.log)
        for wrong in ({"distance": 62.0}, {"distance": 0.3, "trial": "b"}):  # cm; another's
            with pytest.raises(InputError, match=r"cannot be|is asked for"):
                made.say("distance", **wrong)
        made.say("distance", distance=0.31)
        wait(lambda: bool(gateway.of(Finished)), 20, made.log)
        (ended,) = {f.distance for f in gateway.of(Finished)}
        assert ended == 0.31
        gateway.send(assign(policy, "b"))
        wait(lambda: made.health()["waiting"] == "arm", 20, made.log)
        made.say("skip")
        wait(lambda: gateway.of(Finished)[-1].trial == "b", 20, made.log)
        assert gateway.of(Finished)[-1].state is Outcome.ABORTED


@pytest.mark.slow
def test_at_the_prompt_a_key_enables_and_any_other_stops(tmp_path: Path) -> None:
    with lab(tmp_path, speed=1.0) as made:
        made.start()
        with operating(made) as (prompt, _, keys):
            for key in (b" ", b"\x03", b"\x1a"):  # Ctrl-C and Ctrl-Z too
                os.write(keys, b"e")
                made.until("enabled")
                os.write(keys, key)
                assert made.until("stopped")["reason"] == "stop: by the operator"
            os.write(keys, b"q")
            assert prompt.wait(timeout=20) == 0
            os.close(keys)


@pytest.mark.slow
def test_keys_stop_while_a_distance_is_typed_and_so_does_a_terminal_that_is_lost(
    tmp_path: Path,
) -> None:
    policy = bundle(tmp_path / "policies" / "still", standing())
    with (
        at_work(tmp_path, speed=1.0, more=BY_HAND) as (made, gateway),
        operating(made) as (prompt, printed, keys),
    ):
        gateway.send(assign(policy, "a"))
        assert any(b"ENTER starts" in line for line in printed)  # another key would stop
        os.write(keys, b"\r")
        wait(lambda: made.health()["waiting"] == "distance", 40, made.log)
        os.write(keys, b"0.7\x7f6 ")
        made.until("stopped")
        os.write(keys, b"2\r")  # 0.62 m in 0.4 s: is that so?
        assert any(b"0.62 m in a walk of 0.4 s is far" in line for line in printed)
        os.write(keys, b"0.6.2\r")
        assert any(b"'0.6.2' is no number of metres" in line for line in printed)
        os.write(keys, b"0.62\r")
        wait(lambda: bool(gateway.of(Finished)), 20, made.log)
        assert gateway.of(Finished)[0].distance == 0.62
        made.say("enable")
        gateway.send(assign(policy, "b", horizon=20.0))
        assert any(b"ENTER starts" in line for line in printed)
        os.write(keys, b"\r")
        wait(lambda: made.health()["stage"] in MOVING, 40, made.log)
        os.close(keys)
        assert "terminal is gone" in made.until("stopped")["reason"]
        assert prompt.wait(timeout=20) == 1
