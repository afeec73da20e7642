"""What an agent must not do: come to life late, leave a servo holding, end for a typo."""

import json
import os
import subprocess
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from agents import Lab, bundle, children, lab, standing, wait
from far_end import Gateway
from test_agent import IDS, assign, at_work

from hardware_agent.bus import Bus
from hardware_agent.config import BusSettings
from hardware_agent.request import Request
from hardware_agent.rollout import recording_id
from hardware_agent.senses import Senses
from hardware_agent.status import LONGEST, Refused, brief
from hardware_agent.watchdog import make_limp
from pup.errors import InputError
from pup.wire import Armed, Assign, Finished, Outcome, RecordingChunk, Running, Stop

pytest.importorskip("mujoco")


def holding(made: Lab) -> int:
    return int(made.side(cmd="bus")["holding"])


def held(pid: int) -> list[str]:
    """Terminals that a process has open."""
    places = [os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir()]
    return [place for place in places if place.startswith("/dev/pts/")]


def enabled(made: Lab) -> None:
    def tried() -> bool:
        try:
            made.say("enable")
        except InputError:  # a servo's answer may come late on a busy machine
            return False
        return True

    wait(tried, 20, made.log)


def pull_port(made: Lab) -> None:
    """Take the adapter out, and wait until the agent knows."""
    made.side(cmd="fault", kind="port_pulled")
    wait(lambda: not made.health()["bus"]["works"], 20, made.log)


def plug_port(made: Lab) -> None:
    """Put it in again, and wait until the agent has found it."""
    made.side(cmd="fault", kind="port_pulled", off=True)
    wait(lambda: made.health()["bus"]["works"], 20, made.log)


def test_an_enable_that_was_refused_is_not_done_later(tmp_path: Path) -> None:
    """The port is gone, `enable` is refused, somebody presses stop; then the port comes back."""
    with lab(tmp_path) as made:
        made.start()
        pull_port(made)
        with pytest.raises(InputError, match="the control loop does not run"):
            made.say("enable")
        made.say("stop")
        plug_port(made)
        time.sleep(0.5)
        assert made.health()["state"] != "enabled"
        assert holding(made) == 0


def test_what_was_asked_before_a_stop_is_not_done_after_it(tmp_path: Path) -> None:
    """Two `enable` wait, one in the loop and one for it; somebody presses stop."""
    with lab(tmp_path) as made:
        made.start()
        pull_port(made)
        with ThreadPoolExecutor(2) as pool:
            asked = [pool.submit(made.say, "enable") for _ in range(2)]
            time.sleep(0.5)
            made.say("stop")
            told = [str(one.exception(timeout=20)) for one in asked]
        assert sorted("ask again" in words for words in told) == [False, True], told
        plug_port(made)
        time.sleep(0.5)
        assert holding(made) == 0


def test_a_stop_of_the_gateway_waits_for_nothing_that_was_asked(tmp_path: Path) -> None:
    """Two `enable` wait; the stop comes by the link, which the agent's loop does not get to."""
    with at_work(tmp_path, speed=1.0) as (made, gateway):
        pull_port(made)
        with ThreadPoolExecutor(2) as pool:
            asked = [pool.submit(made.say, "enable") for _ in range(2)]
            time.sleep(0.5)
            gateway.send(Stop("somebody saw smoke"))
            told = [str(one.exception(timeout=20)) for one in asked]
        assert sorted("ask again" in words for words in told) == [False, True], told
        plug_port(made)
        time.sleep(0.5)
        assert holding(made) == 0


def test_the_watchdog_finds_an_adapter_that_was_out_and_in_again(tmp_path: Path) -> None:
    with lab(tmp_path) as made:
        made.start()
        assert made.agent is not None
        (watchdog,) = (c for c in children(made.agent.pid) if held(c))
        pull_port(made)
        wait(lambda: not held(watchdog), 10, made.log)  # its name is free for the next
        plug_port(made)
        enabled(made)
        assert holding(made) == 20
        made.kill()
        wait(lambda: holding(made) == 0, 10, made.log)


def test_the_watchdog_waits_for_an_adapter_that_is_out_when_the_agent_is_killed(
    tmp_path: Path,
) -> None:
    """With nobody left who could tell the servos, it may be in again only after a while."""
    with lab(tmp_path) as made:
        made.start()
        enabled(made)
        pull_port(made)
        assert holding(made) == 20
        made.kill()
        time.sleep(4.0)
        made.side(cmd="fault", kind="port_pulled", off=True)
        wait(lambda: holding(made) == 0, 10, made.log)
        wait(lambda: "the agent has ended; torque is off" in made.log(), 10, made.log)


def test_the_watchdog_outlasts_a_command_that_has_the_bus_for_a_moment(tmp_path: Path) -> None:
    """Which may leave servos holding, where it was no agent."""
    settings = BusSettings(str(tmp_path / "bus"), timeout=0.05)
    with lab(tmp_path) as made:
        made.start()
        made.end()
        other, own = Bus(settings, IDS), Bus(settings, IDS)
        other.take()
        threading.Timer(1.0, other.close).start()
        assert make_limp(own, 20.0)
        own.close()
        other.take()
        before = time.monotonic()
        assert not make_limp(own, 20.0), "another agent has it"
        assert time.monotonic() - before < 15.0


def test_a_watchdog_that_finds_nobody_leaves_the_bus_to_the_next_agent(tmp_path: Path) -> None:
    with lab(tmp_path) as made:
        made.start()
        enabled(made)
        made.side(cmd="fault", kind="bus_pulled")
        made.kill()
        time.sleep(1.0)
        made.start_silent()
        made.side(cmd="fault", kind="bus_pulled", off=True)
        wait(made.ready, 20, made.log)
        wait(lambda: holding(made) == 0, 10, made.log)
        assert "owns the bus" not in made.log()


def test_servos_whose_cable_was_out_are_made_limp_when_it_is_back(tmp_path: Path) -> None:
    with lab(tmp_path) as made:
        made.start()
        enabled(made)
        made.side(cmd="fault", kind="bus_pulled")
        made.until("fault")
        assert holding(made) == 20, "they have not heard of it"
        assert made.health()["limp"] is False
        wait(lambda: "not known to be limp" in str(made.health()["problems"]), 10, made.log)
        made.side(cmd="fault", kind="bus_pulled", off=True)
        wait(lambda: holding(made) == 0, 10, made.log)
        made.say("disable")
        wait(lambda: made.health()["problems"] == [], 10, lambda: str(made.health()))
        assert made.say("stop")["limp"] is made.health()["limp"] is True


def test_a_robot_is_known_to_be_limp(tmp_path: Path) -> None:
    """By the clock on the wall, with the usual limits: servos are asked one a tick."""
    with lab(tmp_path, speed=1.0, more="[safety]\nstale = 0.02\n") as made:
        made.start()
        assert made.say("enable")["state"] == "enabled"
        made.say("stop")
        wait(lambda: made.health()["limp"], 10, made.log)
        assert holding(made) == 0


def test_a_stop_that_is_sent_again_and_again_is_confirmed_none_the_less(tmp_path: Path) -> None:
    """As a gateway does, faster than servos can be asked one after the other."""
    with lab(tmp_path, speed=1.0) as made:
        made.start()
        made.say("enable")
        with ThreadPoolExecutor(99) as askers:

            def stopped() -> bool:
                askers.submit(made.say, "stop")
                time.sleep(0.2)
                return bool(made.health()["limp"])

            wait(stopped, 15, made.log)


def test_whoever_enables_a_robot_that_walks_is_refused_and_it_walks_on(tmp_path: Path) -> None:
    policy = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path, speed=1.0) as (made, gateway):
        gateway.send(assign(policy, "a", horizon=2.0))
        gateway.wait(Running, told=made.log)
        with pytest.raises(InputError, match="a trial is under way"):
            made.say("enable")
        assert gateway.wait(Finished, told=made.log).state is Outcome.SUCCEEDED


def test_a_walk_goes_on_without_its_link_and_is_told_whole_when_that_is_back(
    tmp_path: Path,
) -> None:
    policy = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path, speed=1.0) as (made, gateway):
        gateway.send(assign(policy, "a", horizon=2.0))
        gateway.wait(Running, told=made.log)
        gateway.close()
        wait(lambda: not made.health()["trial"], 30, made.log)
        assert made.health()["state"] == "enabled", "it stands"
        back = Gateway(gateway.folder, port=gateway.port)
        wait(lambda: bool(back.of(Finished)), 30, made.log)
        ended = back.of(Finished)[0]
        assert (ended.state, ended.reason) == (Outcome.SUCCEEDED, "reached the horizon")
        data = (tmp_path / "state" / "recordings" / f"{ended.recording}.parquet").read_bytes()
        chunks = {c.number: c.data for c in back.of(RecordingChunk)}
        assert b"".join(chunks[n] for n in sorted(chunks)) == data
        back.close()


def test_a_new_attempt_takes_the_place_of_one_that_gets_ready(tmp_path: Path) -> None:
    """The first has its start pose and waits to settle, for long; nobody waits for that."""
    policy = bundle(tmp_path / "policies" / "still", standing())
    with at_work(tmp_path, speed=1.0, more="[control]\nsettle = 8.0\n") as (made, gateway):
        first = assign(policy, "a", horizon=0.4)
        gateway.send(first)
        wait(lambda: made.health()["stage"] == "settling", 20, made.log)
        gateway.send(replace(first, attempt=2))
        ended = gateway.wait(Finished, told=made.log)
        assert (ended.attempt, ended.reason) == (1, "superseded by attempt 2")
        wait(lambda: [a.attempt for a in gateway.of(Armed)] == [1, 2], 5, made.log)
        assert not gateway.of(Running)


def test_an_agent_that_starts_anew_lets_windings_cool_first(tmp_path: Path) -> None:
    """Down to 0.4 of the allowed heat: 18 s of the robot's time, which lock-step need not wait."""
    policy = bundle(tmp_path / "policies" / "still", standing())
    (tmp_path / "state").mkdir()
    told = {"share": 1.0, "at": time.time()}
    (tmp_path / "state" / "warmth").write_text(json.dumps(told))
    with at_work(tmp_path) as (made, gateway):
        gateway.send(assign(policy, "a"))
        wait(lambda: made.health()["waiting"] == "cool", 10, made.log)
        before = time.monotonic()
        gateway.wait(Running, told=made.log)
        assert time.monotonic() - before < 18


def test_a_trial_that_is_given_cold_motors_does_not_wait_for_them(tmp_path: Path) -> None:
    """All of the allowed heat is used up: without cold motors the rule of overload would strike."""
    policy = bundle(tmp_path / "policies" / "still", standing())
    (tmp_path / "state").mkdir()
    told = {"share": 1.0, "at": time.time()}
    (tmp_path / "state" / "warmth").write_text(json.dumps(told))
    with at_work(tmp_path, more="[distance]\nrenew = true\n") as (made, gateway):
        gateway.send(assign(policy, "a"))
        waits = set()
        while not gateway.of(Running):
            waits.add(made.health()["waiting"])
        assert waits <= {"", "enable"}, made.log()
        kept = tmp_path / "state" / "warmth"
        wait(lambda: json.loads(kept.read_text())["share"] < 0.1, 10, kept.read_text)


def test_nonsense_of_this_computer_does_not_end_the_agent(tmp_path: Path) -> None:
    with lab(tmp_path) as made:
        made.start()
        for distance in ("abc", [], None, True, {}):
            with pytest.raises(InputError, match="no number"):
                made.say("distance", distance=distance)
        with pytest.raises(InputError, match="no trial waits"):
            made.say("arm")
        made.say("stop", reason="x" * 20_000 + "\ud800")
        wait(lambda: made.health()["state"] == "stopped", 10, made.log)
        assert len(made.health()["reason"]) < 2 * LONGEST
        assert isinstance(made.agent, subprocess.Popen) and made.agent.poll() is None


def test_what_nobody_waits_for_any_more_is_not_done() -> None:
    done: list[Senses] = []
    request = Request(lambda senses: done.append(senses))
    assert request.wait(0.01, Refused("late")) == Refused("late")
    request.run(None)  # type: ignore[arg-type]
    assert done == []
    stopped = Request(lambda senses: done.append(senses))
    stopped.refuse(Refused("stop"))
    assert stopped.wait(1.0, Refused("late")) == Refused("stop") and done == []


def test_recordings_of_long_names_have_ids_of_their_own() -> None:
    def name(study: str, trial: str) -> str:
        return recording_id(Assign(study, trial, 1, 1, "0" * 64, (0.0,), 1.0))

    assert name("s", "s-1") == "s_s-1_1"
    names = {name("s" * 63, f"{'s' * 63}-{i}") for i in range(50)} | {
        name("a b", "c"),
        name("a-b", "c"),
    }
    assert len(names) == 52 and max(map(len, names)) <= 120


def test_a_reason_is_one_line_that_fits_everywhere() -> None:
    assert brief(" two\nlines ") == "two lines"
    assert len(brief("x" * 10_000)) == LONGEST and brief("\ud800").encode()
