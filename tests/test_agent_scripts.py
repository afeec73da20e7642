"""Scripts that the agent plays and records, over the bus of a virtual robot."""

import os
import pty
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from agents import Lab, lab, wait

from pup.errors import InputError
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.script import Script
from pup.sysid.scripts import scripts

pytest.importorskip("mujoco")

OP2 = RobotDescription.load("darwin_op2")


def written(folder: Path, *kinds: str) -> list[Path]:
    """Files of scripts."""
    files = []
    for script in scripts(OP2, kinds, np.random.default_rng(1)):
        files.append(folder / f"{script.id}.json")
        script.write(files[-1])
    return files


def command(made: Lab, *words: object) -> list[str]:
    told = [sys.executable, "-m", "hardware_agent.cli", "play", "--config", str(made.config)]
    return [*told, *map(str, words)]


@contextmanager
def at_the_keys(made: Lab, *words: object) -> Iterator[tuple["subprocess.Popen[bytes]", int]]:
    """`pup-agent play` at a terminal, and the operator's end of it; that is the test's."""
    keys, theirs = pty.openpty()
    process = subprocess.Popen(
        command(made, *words), stdin=theirs, stdout=subprocess.PIPE, start_new_session=True
    )
    os.close(theirs)
    assert process.stdout is not None and b"STOPS" in process.stdout.readline()
    try:
        yield process, keys
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def test_a_script_is_played_recorded_and_repeated(
    tmp_path: Path, check_contract: Callable[[Path], None]
) -> None:
    (file,) = written(tmp_path, "step:0.1")
    script = Script.read(file)
    with lab(tmp_path, speed=0.0) as made:
        made.side(cmd="reset", hold="rope")
        made.start()
        with pytest.raises(InputError, match="enable it first"):
            made.say("pose", script=script.document())
        made.say("enable")
        changed = ("--setup", "payload=0.5", "--setup", "p_gain=24")
        done = subprocess.run(
            command(made, file, "--auto", "--repeats", 2, *changed), capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        assert made.health()["state"] == "enabled"
        with pytest.raises(InputError, match="no script waits"):
            made.say("play")
    files = [Path(line) for line in done.stdout.splitlines() if line.endswith(".parquet")]
    assert [f.stem for f in files] == [script.name, f"{script.name}_2"]
    first, again = map(Recording.read, files)
    for recording in (first, again):
        assert (recording.motion, recording.support) == ("step", "suspended")
        assert recording.source == "simulation"
        assert recording.setup == {"payload": 0.5, "p_gain": 24.0}
        recording.validate(OP2)
        assert recording.time[0] == 0 and recording.time[-1] >= script.duration - 1 / 33
        told = np.array([script.at(t) for t in recording.time])
        np.testing.assert_allclose(recording.target, told, atol=1e-9)
        np.testing.assert_allclose(recording.position[0], script.target[0], atol=0.15)
    assert first.repeat_of is None and again.repeat_of == first.id
    check_contract(files[0].parent)


def test_nothing_moves_without_asking_where_the_gate_is_the_operators(tmp_path: Path) -> None:
    """The agent itself refuses, whoever asks: a command that tells of no agreement has none."""
    (file,) = written(tmp_path, "step:0.1")
    script = Script.read(file).document()
    with lab(tmp_path, speed=0.0, more='[control]\ngate = "operator"\n') as made:
        made.side(cmd="reset", hold="rope")
        made.start()
        made.say("enable")
        before = made.health()["position"]
        done = subprocess.run(command(made, file, "--auto"), capture_output=True, text=True)
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1, done.stderr
        assert '--auto needs gate = "auto"' in done.stderr
        for agreed in ({}, {"agreed": False}, {"agreed": 1}, {"agreed": "yes"}):
            for do in ("pose", "play"):
                with pytest.raises(InputError, match="has to agree"):
                    made.say(do, script=script, **agreed)
        assert made.health()["script"] == {"name": None, "stage": "", "result": {}}
        assert made.health()["position"] == pytest.approx(before, abs=0.1)  # it hangs
        made.say("pose", script=script, agreed=True)
        wait(lambda: made.health()["script"]["stage"] == "ready", 60, made.log)
        with pytest.raises(InputError, match="has to agree"):
            made.say("play")
        made.say("play", agreed=True)
        wait(lambda: made.health()["script"]["stage"] == "", 120, made.log)
        assert "recording" in made.health()["script"]["result"]


SETUPS = {
    "no knob": ({"payload": 0.1, "wind": 3.0}, "knobs: payload, supply_voltage, p_gain"),
    "beyond its limits": ({"payload": 9.0}, "payload = 9 kg is outside"),
    "a text": ({"payload": "0.5"}, "use a finite number"),
    "true": ({"payload": True}, "use a finite number"),
    "no number": ({"payload": float("nan")}, "use a finite number"),
    "infinite": ({"payload": float("inf")}, "use a finite number"),
    "beyond any float": ({"payload": 10**400}, "use a finite number"),
    "a list": (["payload"], "no object of knobs"),
    "null": (None, "no object of knobs"),
}


def test_a_setup_that_the_robot_does_not_have_is_refused(tmp_path: Path) -> None:
    (file,) = written(tmp_path, "step:0.1")
    with lab(tmp_path, speed=0.0) as made:
        made.side(cmd="reset", hold="rope")
        made.start()
        for setup, told in SETUPS.values():
            with pytest.raises(InputError, match=told):
                made.say("pose", script=Script.read(file).document(), setup=setup)
        for words, expected in (
            (("wind=3", "payload=0.1"), "is no knob of robot"),
            (("payload",), "--setup: 'payload' is not KNOB=NUMBER"),
            (("payload=much",), "is not KNOB=NUMBER"),
            (("payload=nan",), "is not KNOB=NUMBER"),
            (("=1",), "is not KNOB=NUMBER"),
            (("payload=0.1", "payload=0.2"), "payload is told twice"),
        ):
            done = subprocess.run(
                command(made, file, "--auto", "--setup", *words), capture_output=True, text=True
            )
            assert done.returncode == 2, done.stderr
            assert expected in done.stderr and len(done.stderr.splitlines()) == 1
        assert made.health()["script"]["stage"] == ""


@pytest.mark.slow
def test_any_key_stops_a_script_and_nothing_is_recorded(tmp_path: Path) -> None:
    step, hold = written(tmp_path, "step:0.1", "hold")
    with lab(tmp_path, speed=1.0, more='[control]\ngate = "operator"\n') as made:
        made.side(cmd="reset", hold="rope")
        made.start()
        made.say("enable")
        with at_the_keys(made, step, hold) as (process, keys):
            os.write(keys, b"s\r")  # the first is skipped
            wait(lambda: made.health()["script"]["stage"] == "playing", 40, made.log)
            assert made.health()["state"] == "running"
            with pytest.raises(InputError, match="a script is under way"):
                made.say("enable")
            os.write(keys, b"x")
            assert process.wait(timeout=20) == 1
            assert made.until("stopped")["reason"] == "stop: by the operator"
            assert "stop" in made.health()["script"]["result"]["reason"]
        assert not list((tmp_path / "state").rglob("*.parquet"))


@pytest.mark.slow
def test_a_terminal_that_is_lost_stops_the_robot(tmp_path: Path) -> None:
    (hold,) = written(tmp_path, "hold")
    with lab(tmp_path, speed=1.0) as made:
        made.side(cmd="reset", hold="rope")
        made.start()
        made.say("enable")
        with at_the_keys(made, hold) as (process, keys):
            os.write(keys, b"\r")
            wait(lambda: made.health()["state"] == "running", 40, made.log)
            os.close(keys)
            assert "terminal is gone" in made.until("stopped")["reason"]
            assert process.wait(timeout=20) == 1


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_a_prompt_that_is_killed_or_hangs_stops_the_robot(tmp_path: Path, end: int) -> None:
    """It can tell nobody; with the robot at rest it may be gone."""
    (hold,) = written(tmp_path, "hold")
    with lab(tmp_path, speed=1.0) as made:
        made.side(cmd="reset", hold="rope")
        made.start()
        made.say("enable")
        with at_the_keys(made, hold) as (process, _):
            process.kill()
            process.wait()
        time.sleep(0.3)
        assert made.health()["state"] == "enabled"
        with at_the_keys(made, hold) as (process, keys):
            os.write(keys, b"\r")
            wait(lambda: made.health()["state"] == "running", 40, made.log)
            process.send_signal(end)
            assert "terminal is gone" in made.until("stopped")["reason"]


@pytest.mark.slow
def test_a_robot_that_falls_as_it_should_yields_and_is_taken_up_again(tmp_path: Path) -> None:
    fall, step = written(tmp_path, "fall:left", "step:0.1")
    with lab(tmp_path, speed=0.0) as made:
        made.side(cmd="reset", hold="hand")
        made.start()
        made.say("enable")
        made.say("pose", script=Script.read(fall).document())
        wait(lambda: made.health()["script"]["stage"] == "ready", 60, made.log)
        made.side(cmd="release")
        made.say("play")
        wait(lambda: made.health()["script"]["stage"] == "", 120, made.log)
        told = made.health()
        assert told["state"] == "enabled" and made.side(cmd="bus")["power"] < 0.5  # it yields
        recording = Recording.read(Path(told["script"]["result"]["recording"]))
        assert recording.support == "ground"
        assert np.nanmax(np.abs(recording.extras["imu/roll"])) > 0.5
        lying = Script.read(fall)
        made.say("pose", script=lying.document(), repeat_of=lying.name)
        wait(lambda: made.health()["script"]["stage"] == "ready", 60, made.log)
        with pytest.raises(InputError, match="the robot lies"):
            made.say("play")
        made.say("stop")
        made.until("stopped")
        made.side(cmd="reset", hold="rope")
        made.say("enable")
        made.say("pose", script=Script.read(step).document())
        wait(lambda: made.health()["script"]["stage"] == "ready", 60, made.log)


def test_a_script_of_another_robot_is_refused(tmp_path: Path) -> None:
    leg = RobotDescription.load("darwin_leg")
    (script,) = scripts(leg, ("step:0.1",), np.random.default_rng(1))
    script.write(tmp_path / "leg.json")
    with lab(tmp_path, speed=0.0) as made:
        made.start()
        for words, expected in (
            ((tmp_path / "leg.json", "--auto"), "is for 'darwin_leg'"),
            ((tmp_path / "none.json", "--auto"), "none.json"),
            ((tmp_path / "state", "--auto"), "no *.json in this folder"),
            ((tmp_path / "leg.json",), "this is no terminal"),
            ((tmp_path / "leg.json", "--auto", "--repeats", 0), "is not 1 to 100"),
        ):
            done = subprocess.run(
                command(made, *words), capture_output=True, text=True, stdin=subprocess.DEVNULL
            )
            assert done.returncode == 2, done.stderr
            assert expected in done.stderr and len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_a_robot_that_falls_over_in_a_stand_up_yields_and_nothing_is_recorded(
    tmp_path: Path,
) -> None:
    (standup,) = written(tmp_path, "standup:2")
    script = Script.read(standup)
    with lab(tmp_path, speed=0.0) as made:
        made.start()
        made.say("enable")
        for falls in (False, True):
            made.side(cmd="reset", hold="hand")  # on its own it may fall on the way to the pose
            made.say("pose", script=told(script, falls))
            wait(lambda: made.health()["script"]["stage"] == "ready", 60, made.log)
            made.side(cmd="release")
            made.say("play")
            wait(lambda: made.health()["script"]["stage"] == "", 120, made.log)
            result = made.health()["script"]["result"]
            assert ("recording" in result) != falls, result
        assert result["reason"].startswith("fall")
        assert made.health()["state"] == "enabled" and made.side(cmd="bus")["power"] < 0.5


def told(script: Script, falls: bool) -> dict[str, object]:
    """A stand-up, or one that throws the robot over: its ankles bend back on the way."""
    document = script.document()
    if falls:
        ankles = [j for j, name in enumerate(script.joints) if "ank_pitch" in name]
        for row in document["target"][len(script.time) // 2 :]:
            for j in ankles:
                joint = OP2.joints[j]
                row[j] = joint.lower if script.joints[j].startswith("l") else joint.upper
    return document


def test_a_script_beyond_the_joints_ranges_is_refused(tmp_path: Path) -> None:
    (file,) = written(tmp_path, "step:0.1")
    document = Script.read(file).document()
    document["target"] = (np.degrees(document["target"])).tolist()
    with lab(tmp_path, speed=0.0) as made:
        made.side(cmd="reset", hold="rope")
        made.start()
        made.say("enable")
        with pytest.raises(InputError, match="are these radians"):
            made.say("pose", script=document)
        with pytest.raises(InputError, match="is no recording of"):
            made.say("pose", script=Script.read(file).document(), repeat_of="other")
