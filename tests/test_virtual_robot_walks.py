"""Walks without a bus are those through it."""

import signal
import time
from pathlib import Path

import numpy as np
import pytest
from agents import wait

from hardware_agent.control import say
from hardware_agent.virtual.fleet import Fleet
from hardware_agent.virtual.walks import walk
from pup.policy.bundle import NumpyPolicy
from pup.robot import RobotDescription
from services import laboratory as laboratories
from services import transfer
from services.laboratory import Laboratory, period_of
from services.trials import Budget, follow

DARWIN = RobotDescription.load("darwin_op2")
POLICY = Path(str(DARWIN.folder)) / "policies" / "forward"
SEED = 5


def test_a_walk_without_packets_is_as_long_as_one_through_the_bus(tmp_path: Path) -> None:
    policy = NumpyPolicy.load(POLICY, DARWIN)
    with Laboratory(tmp_path, DARWIN, POLICY, SEED) as laboratory:
        budget = Budget(3, repeats=0, horizon=6.0)
        study = follow(laboratory, "walks", budget, [], tmp_path / "walks", lambda _: None)
    trials = study["trials"]
    assert [trial["state"] for trial in trials] == ["succeeded"] * 3
    eta = np.array([trial["eta"] for trial in trials])
    told = walk(Fleet(DARWIN, [SEED] * 3), policy, eta, 6.0, period_of(DARWIN))
    assert told.distance == pytest.approx([trial["distance"] for trial in trials], abs=0.05)
    assert (told.time == 6.0).all()
    assert told.distance.min() > 0.3


def test_who_falls_has_come_as_far_as_until_then() -> None:
    policy = NumpyPolicy.load(POLICY, DARWIN)
    fleet = Fleet(DARWIN, [SEED, SEED])
    middle = np.add(policy.card.eta_lower, policy.card.eta_upper) / 2
    same = np.stack([middle, middle])
    told = walk(fleet, policy, same, 2.0, period_of(DARWIN))
    assert told.distance[0] == told.distance[1]  # the same robot, the same noise
    lame = walk(Fleet(DARWIN, [SEED]), _lame(policy), same[:1], 6.0, period_of(DARWIN))
    assert 0.0 < lame.time[0] < 6.0
    assert lame.distance[0] < told.distance[0]


def _lame(policy: NumpyPolicy) -> NumpyPolicy:
    """A policy whose left knee is bent as far as it may."""
    weight, bias = policy.actor[-1]
    bins = policy.card.shape.bins
    bias = bias.copy().reshape(bins, -1)
    bias[-1, policy.card.joints.index("l_knee")] += 1000.0
    bias[-1, policy.card.joints.index("l_hip_pitch")] += 1000.0
    policy.actor[-1] = (weight, bias.reshape(-1))
    return policy


def test_a_robot_whose_servo_has_shut_down_is_mended_by_hand(tmp_path: Path) -> None:
    """Its power is switched and it is lifted, as an operator would; by itself it stays so."""
    with Laboratory(tmp_path, DARWIN, POLICY, SEED) as laboratory:
        side, agent = (laboratory._passing / name for name in ("side", "agent.sock"))

        def state() -> str:
            return str(say(agent, {"do": "health"})["state"])

        def shut_down() -> bool:
            """Whether it has: where the agent is quicker, it takes the torque off before."""
            say(side, {"cmd": "fault", "kind": "hot_motor", "id": DARWIN.joints[0].servo_id})
            wait(lambda: state() == "fault", 30)
            say(side, {"cmd": "clear"})
            say(agent, {"do": "enable"})
            time.sleep(1.0)
            return state() == "fault"

        def mended() -> bool:
            """Whether it stays so: a busy computer may hold its loop up, which is a fault too."""
            laboratory.tend()
            for _ in range(20):
                if state() != "enabled":
                    return False
                time.sleep(0.05)
            return True

        wait(shut_down, 60)
        wait(mended, 60)


@pytest.mark.parametrize("frozen", ["robot", pytest.param("gateway", marks=pytest.mark.slow)])
def test_a_laboratory_that_stands_still_is_started_anew(
    frozen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A process that neither ends nor answers is nothing that an exit would tell of."""
    monkeypatch.setattr(transfer, "TIMEOUT", 3.0)
    monkeypatch.setattr(laboratories, "GRACE", 1.0)
    lines: list[str] = []
    with Laboratory(tmp_path, DARWIN, POLICY, SEED) as laboratory:
        laboratory.standstill = 12.0
        process = laboratory._processes[frozen]

        def told(line: str) -> None:
            if "trial" in line and "anew" not in " ".join(lines):
                process.send_signal(signal.SIGSTOP)
            lines.append(line)

        study = follow(laboratory, "s", Budget(2, repeats=0, horizon=2.0), [], tmp_path / "s", told)
    assert any("started anew" in line for line in lines)
    assert process.poll() is not None
    assert [t["state"] for t in study["trials"]].count("succeeded") == 2
