"""When a robot is on its own feet, so that a large tilt is a fall."""

import copy
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from agents import CONFIG, DARWIN, bundle, standing, wait

from hardware_agent.activities import WATCHED, Activity, Event, Hold, Settle, Walk
from hardware_agent.body import Body
from hardware_agent.config import ControlSettings, ImuSettings, Settings
from hardware_agent.imu import IMU_MODE, MODE, Bno055, Orientation
from hardware_agent.motion import Motion
from hardware_agent.policies import Shelf
from hardware_agent.recordings import Recordings
from hardware_agent.rollout import Rollout, row_names
from hardware_agent.senses import Senses
from pup.errors import InputError
from pup.policy.bundle import CARD
from pup.wire import Assign

PERIOD = 1 / 33


def senses(time: float, pose: np.ndarray) -> Senses:
    n = len(pose)
    unknown = np.full(n, np.nan)
    sample = Orientation(0.0, 0.0, 0.0, np.zeros(3), np.array([0.0, 0.0, 9.81]))
    return Senses(
        time=time,
        names=DARWIN.joint_names,
        position=pose,
        velocity=unknown,
        load=unknown,
        voltage=np.full(n, 12.0),
        temperature=np.full(n, 30.0),
        alarms={},
        seen=np.full(n, time),
        imu=sample,
        imu_seen=time,
        has_imu=True,
        goal=pose,
        written=time,
        walking=True,
        alone=True,
    )


STANDS = replace(DARWIN, gait=standing())


@pytest.fixture
def rollout(tmp_path: Path) -> Rollout:
    bundle(tmp_path / "policies" / "still", standing())
    shelf = Shelf(tmp_path / "policies", STANDS)
    return Rollout(shelf.load(shelf.policies()[0].sha256), (0.0, 0.0, 0.0), 33)


def test_a_bundle_that_cannot_be_read_is_left_out(tmp_path: Path) -> None:
    bundle(tmp_path / "policies" / "still", standing())
    (tmp_path / "policies" / "broken" / CARD).mkdir(parents=True)
    shelf = Shelf(tmp_path / "policies", STANDS)
    (told,) = shelf.policies()
    assert told.name == "still" and shelf.load(told.sha256)


def test_a_folder_of_bundles_that_cannot_be_looked_into_is_empty(tmp_path: Path) -> None:
    """Of another user, or with a name beyond what the file system knows: no robot falls for it."""
    shelf = Shelf(tmp_path / ("p" * 300), STANDS)
    assert shelf.policies() == ()
    with pytest.raises(InputError, match="no policy with digest"):
        shelf.load("0" * 64)


def test_a_policy_of_another_description_is_refused_or_told_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Refused where the numbers of its joints may mean something else."""
    caplog.set_level("INFO", "pup-agent")
    bundle(tmp_path / "still", standing())
    shelf = Shelf(tmp_path, DARWIN)
    (told,) = shelf.policies()
    with pytest.raises(InputError, match=r"trained on .* other gait\.joints; "):
        shelf.load(told.sha256)
    assert Shelf(tmp_path, STANDS).load(told.sha256) and not caplog.messages
    corrected = Shelf(tmp_path, replace(STANDS, digest="0" * 64))
    assert corrected.load(told.sha256) is corrected.load(told.sha256)
    (line,) = caplog.messages
    assert line.startswith("policy still: trained on another description of darwin_op2")


def test_a_recording_that_cannot_be_made_ends_nothing(tmp_path: Path) -> None:
    """Of a walk whose file a power cut has left full of zeros, say."""
    recordings = Recordings(tmp_path, DARWIN, "hardware")
    walk = Assign("study", "t", 1, 1, "p" * 64, (0.0,) * 3, 14.0)
    assert recordings.keep(walk, np.zeros((3, len(row_names(DARWIN.joint_names)))), "") is None


def test_an_imu_that_was_reset_tells_nothing() -> None:
    """All its registers are zero then, as if the robot stood upright and quiet."""

    class Registers:
        mode = 0

        def write(self, register: int, value: int) -> bool:
            self.mode = value if register == MODE else self.mode
            return True

        def ask(self, register: int, length: int) -> None:
            pass

        def take(self, length: int) -> bytes:
            gravity = bytes(4) + (981).to_bytes(2, "little") + bytes(18)
            turn = (1 << 14).to_bytes(2, "little") + bytes(6)
            return gravity + turn if self.mode == IMU_MODE else bytes(32)

    imu = Bno055(ImuSettings(), Registers())
    assert imu.take(None, 0.0) is None
    assert imu.configure()
    told = imu.take(None, 0.0)
    assert told is not None and np.linalg.norm(told.accel) == pytest.approx(9.81)


def test_a_walk_is_timed_the_same_whenever_its_agent_started(rollout: Rollout) -> None:
    """Lock-step adds periods up: what that leaves in the last bits must not be told."""

    def times(idle: int) -> list[float]:
        again = copy.deepcopy(rollout)
        ticks = np.cumsum(np.full(idle + 50, 0.031))[idle:]
        told = []
        for now in ticks:
            again.target(senses(float(now), rollout.pose))
            told.append(again.time(float(now)))
        return told

    assert times(7) == times(1000) == [round(0.031 * k, 9) for k in range(50)]


def test_it_is_from_when_it_stands_ready_until_it_is_taken(rollout: Rollout) -> None:
    assign = Assign("study", "t", 1, 1, "0" * 64, (0.0, 0.0, 0.0), 1.0)
    told: list[Event] = []
    settle = Settle(assign, rollout, np.zeros(2), ControlSettings(settle=0.5), told.append)
    doing: Activity = settle
    phases: list[tuple[str, bool]] = []
    for k in range(round((0.5 + 1.0 + 0.5 + WATCHED + 1.0) / PERIOD) + 5):
        settle.placed = k > 3
        settle.go = settle.told
        _, doing = doing.step(senses(k * PERIOD, rollout.pose))
        phases.append((type(doing).__name__, doing.alone))
    distinct = [p for p, before in zip(phases, [None, *phases], strict=False) if p != before]
    assert distinct == [
        ("Settle", False),
        ("Settle", True),
        ("Walk", True),
        ("Ramp", True),
        ("Hold", False),
    ]
    assert phases.count(("Ramp", True)) == pytest.approx((0.5 + WATCHED) / PERIOD, abs=4)
    assert isinstance(doing, Hold) and not isinstance(doing, Walk)


def test_a_trial_that_may_run_runs_however_long_the_loop_was_held_up(
    rollout: Rollout, tmp_path: Path
) -> None:
    """It is told so once; a robot that never heard of it would stand for good."""
    held = threading.Event()

    class HeldUp(Motion):
        def _tick(self, now: float) -> None:
            held.wait()
            self._serve(senses(now, rollout.pose))

    (tmp_path / "agent.toml").write_text(CONFIG.format(folder=tmp_path, protocol=1, clock="wall"))
    body = Body(Settings.read(tmp_path / "agent.toml"), DARWIN)
    motion = HeldUp(body, None, lambda event: None)
    assign = Assign("study", "t", 1, 1, "0" * 64, (0.0, 0.0, 0.0), 1.0)
    settle = Settle(assign, rollout, None, ControlSettings(), lambda event: None)
    motion._become(settle)
    motion.start()
    motion.placed(assign)
    motion.go(assign)
    refused = motion.disable()  # whoever waits for an answer is told that there is none
    assert refused is not None
    held.set()
    wait(lambda: settle.go, 10)
    motion.close()
    assert settle.placed and motion.state is settle.state
