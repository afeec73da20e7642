"""Each rule of safety stops the robot for its own reason, and only for that."""

import json
import math
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from agents import CONFIG, DARWIN, changed
from hypothesis import given
from hypothesis import strategies as st

from hardware_agent.body import Body
from hardware_agent.config import SafetySettings, Settings
from hardware_agent.imu import Board, Orientation
from hardware_agent.limits import Applied, Limiter
from hardware_agent.metronome import Metronome
from hardware_agent.mounting import Mounting
from hardware_agent.plausible import Plausible
from hardware_agent.registers import REGISTERS
from hardware_agent.safety import Guard
from hardware_agent.senses import Response, Senses, Trip
from hardware_agent.warmth import Warmth

NAMES = ("hip", "knee", "ankle")
PERIOD = 1 / 33
LIMITS = SafetySettings()
POSE = np.array([0.1, -0.4, 0.2])


def imu(
    roll: float = 0.0, pitch: float = 0.1, rate: float = 0.0, noise: float = 0.0
) -> Orientation:
    gyro, accel = np.array([rate, rate, 0.0]), np.array([noise, 0.0, 9.81])
    return Orientation(roll, pitch, 0.0, gyro, accel)


def senses(time: float = 10.0, **changes: Any) -> Senses:
    """A robot that is well and stands."""
    n = len(NAMES)
    well = Senses(
        time=time,
        names=NAMES,
        position=POSE.copy(),
        velocity=np.zeros(n),
        load=np.zeros(n),
        voltage=np.full(n, 11.8),
        temperature=np.full(n, 40.0),
        alarms={},
        seen=np.full(n, time),
        imu=imu(noise=time),
        imu_seen=time,
        has_imu=True,
        goal=POSE.copy(),
        written=time - PERIOD,
        walking=True,
        alone=True,
    )
    return replace(well, **changes)


def run(changes: Any, seconds: float = 30.0) -> Trip | None:
    """The first trip of a guard that is shown ticks; `changes` gives those of a time."""
    guard = Guard(LIMITS, 1.0)
    for k in range(int(seconds / PERIOD)):
        now = 10.0 + k * PERIOD
        trip = guard.check(senses(now, **changes(k * PERIOD)))
        if trip is not None:
            return trip
    return None


def at(joint: int, value: float, base: float) -> np.ndarray:
    values = np.full(len(NAMES), base)
    values[joint] = value
    return values


def test_a_robot_that_is_well_is_left_alone() -> None:
    assert run(lambda t: {}) is None


def swinging(t: float) -> dict[str, Any]:
    """Joints that follow a gait with the lag of a healthy servo, and a torso that sways."""
    phase = 2 * math.pi * t / 0.56
    goal = POSE + 0.3 * math.sin(phase) * np.array([1.0, -1.0, 0.5])
    position = POSE + 0.26 * math.sin(phase - 0.5) * np.array([1.0, -1.0, 0.5])
    swayed = imu(0.2 * math.sin(phase), 0.1 + 0.1 * math.cos(phase), 2.0 * math.cos(phase), t)
    return {"goal": goal, "position": position, "imu": swayed}


def test_a_robot_that_walks_is_left_alone() -> None:
    assert run(swinging) is None


TRIPS: dict[str, tuple[str, Any, str]] = {
    "a dead servo": (
        "stale servo",
        lambda t: {"seen": at(1, 10.0, 10.0 + t)} if t else {},
        "knee did not answer for 30 ms",
    ),
    "a silent IMU": (
        "stale IMU",
        lambda t: {"imu_seen": 10.0},
        "no reading for 30 ms",
    ),
    "an IMU that hangs": (
        "frozen IMU",
        lambda t: {"imu": imu(noise=1.0)},
        "the same reading for 0.5",
    ),
    "a loop that is late": (
        "stale command",
        lambda t: {"written": 10.0 + t - (0.2 if t > 1 else PERIOD)},
        "no command for 200 ms",
    ),
    "a servo that complains": (
        "servo alarm",
        lambda t: {"alarms": {"knee": "overload"}},
        "knee tells of overload",
    ),
    "an empty battery": (
        "voltage",
        lambda t: {"voltage": np.full(3, 11.0 - t)},
        "V is outside 9.5 to 15 V",
    ),
    "a hot case": (
        "over-temperature",
        lambda t: {"temperature": at(2, 71.0, 40.0)},
        "ankle has 71 °C, limit 70",
    ),
    "a case that warms fast": (
        "heating",
        lambda t: {"temperature": at(0, 40.0 + math.floor(0.8 * t), 40.0)},
        "hip warmed by 6 °C in",
    ),
    "a joint that pushes against a stop": (
        "overload",
        lambda t: {"goal": POSE + at(1, 0.3, 0.0), "position": POSE + 0.001 * (t % 0.06 > 0.03)},
        "knee draws 0.65",
    ),
    "an encoder that sticks": (
        "stuck encoder",
        lambda t: swinging(t) | {"position": swinging(t)["position"] * [1, 0, 1]},
        "0.0000 rad for 0.18 s while it should have moved",
    ),
    "a fall": (
        "fall",
        lambda t: {"imu": imu(pitch=0.4 * t, rate=0.4, noise=t)},
        "pitch",
    ),
}


@pytest.mark.parametrize(("rule", "changes", "told"), TRIPS.values(), ids=TRIPS)
def test_it_stops_the_robot(rule: str, changes: Any, told: str) -> None:
    trip = run(changes)
    assert trip is not None
    assert trip.rule == rule
    assert told in trip.reason
    assert trip.response is (Response.SOFT if rule == "fall" else Response.LIMP)


def pushed(t: float) -> dict[str, Any]:
    """A knee that stands against something at full power."""
    return {"goal": POSE + at(1, 0.3, 0.0), "position": POSE + 0.001 * (t % 0.06 > 0.03)}


def given_up(guard: Guard, begin: float) -> float:
    """Time for which a stalled motor is pushed before it is given up, s."""
    times = np.arange(0.0, 30.0, PERIOD)
    return next(t for t in times if guard.check(senses(begin + t, **pushed(t))) is not None)


def test_a_motor_may_give_much_for_a_moment_but_not_for_long() -> None:
    """0.65 of the stall current for 20 s is the limit: the full one takes 11 s to it."""
    guard = Guard(LIMITS, 1.0)
    assert given_up(guard, 10.0) == pytest.approx(-20 * math.log(1 - 0.65**2), rel=0.05)
    assert guard.heat == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(("protocol", "gain"), [(1, 64), (2, 1024), (1, 254)])
def test_a_motor_with_another_gain_is_given_up_for_its_current_too(
    tmp_path: Path, protocol: int, gain: int
) -> None:
    """A blocked joint at full duty, for which a servo of twice the gain needs half the error."""
    paper = REGISTERS[protocol].paper[0]
    text = CONFIG.format(folder=tmp_path, protocol=protocol, clock="wall")
    file = tmp_path / "agent.toml"

    def blocked(more: str) -> Trip | None:
        file.write_text(changed(text, f"[bus]\ngains = [{gain}, 0, 0]\n{more}"))
        guard = Body(Settings.read(file), DARWIN).guard
        error = 1.05 / 6.28 * paper / gain
        shown = {"goal": POSE + at(1, error, 0.0), "imu": None, "has_imu": False}
        for t in np.arange(0.0, 20.0, PERIOD):
            trip = guard.check(senses(10.0 + t, **shown))
            if trip is not None:
                return trip
        return None

    told = blocked("")
    assert told is not None and told.rule == "overload"
    assert blocked("[safety]\nduty_per_radian = 0.5\n") is None, "set by hand"


@pytest.mark.parametrize("rest", [0.0, 20.0, 200.0])
def test_a_winding_cools_while_torque_is_off_and_no_faster(rest: float) -> None:
    guard = Guard(LIMITS, 1.0)
    on = 10.0 + given_up(guard, 10.0) + rest
    guard.rest(senses(on))
    guard.reset()
    left = 0.65**2 * math.exp(-rest / 20)
    expected = 20 * math.log((1 - left) / (1 - 0.65**2))
    assert given_up(guard, on) == pytest.approx(expected, abs=0.2)


def test_one_servo_that_lies_about_the_voltage_stops_nobody() -> None:
    assert run(lambda t: {"voltage": at(0, 0.0, 11.8)}) is None


def test_a_robot_that_is_lifted_may_lie() -> None:
    lying = {"walking": False, "alone": False}
    assert run(lambda t: lying | {"imu": imu(pitch=1.5, noise=t)}) is None


def test_a_robot_that_stands_on_its_own_may_fall_too() -> None:
    """Before the walk's first tick and after its last."""
    tripped = run(lambda t: {"walking": False, "imu": imu(pitch=1.5, noise=t)})
    assert tripped is not None and (tripped.rule, tripped.response) == ("fall", Response.SOFT)


def test_heat_outlives_the_agent(tmp_path: Path) -> None:
    """A stalled motor, the agent is killed; the next one gives the motor what is left."""
    guard = Guard(LIMITS, 1.0)
    given_up(guard, 10.0)
    assert Warmth(tmp_path / "warmth", 20.0).left() == 0.0, "none was known"
    Warmth(tmp_path / "warmth", 20.0).keep(guard.heat)
    told = json.loads((tmp_path / "warmth").read_text())
    (tmp_path / "warmth").write_text(json.dumps(told | {"at": told["at"] - 20.0}))
    again = Guard(LIMITS, 1.0)
    again.warm(Warmth(tmp_path / "warmth", 20.0).left())
    assert again.heat == pytest.approx(math.exp(-1.0), abs=0.02)
    assert given_up(again, 500.0) < 0.8 * -20 * math.log(1 - 0.65**2)
    for damaged in ("", "{}", '{"share": 7, "at": 0}', '{"share": null, "at": 0}', "[]"):
        (tmp_path / "warmth").write_text(damaged)
        assert Warmth(tmp_path / "warmth", 20.0).left() == 1.0, "who does not know waits"


def test_a_reading_that_cannot_be_is_believed_only_when_it_is_repeated() -> None:
    told = Plausible()
    assert told.believes(7, 0.5, 0.0)
    assert not told.believes(7, 55.2, 0.03), "no servo is there"
    assert not told.believes(7, 1.3, 0.03), "nor can it be there already"
    assert told.believes(7, 0.55, 0.04)
    assert not told.believes(7, 1.3, 0.05), "what was doubted before is forgotten"
    assert told.believes(7, 1.32, 0.06), "it was struck"
    assert told.believes(7, -1.3, 0.6), "half a second is time enough"
    assert told.believes(8, -1.3, 0.6), "another servo"


@given(st.lists(st.floats(-1, 1), min_size=2, max_size=30))
def test_a_servo_that_moves_as_servos_can_is_always_believed(moves: list[float]) -> None:
    """Ticks of 30 ms at up to the free speed, 5.76 rad/s."""
    told, position = Plausible(), 0.0
    for k, move in enumerate(moves):
        position = min(3.1, max(-3.1, position + 0.03 * 5.76 * move))
        assert told.believes(1, position, 0.03 * k)


def test_a_fast_fall_is_foreseen() -> None:
    falling = Guard(LIMITS, 1.0).check(senses(imu=imu(pitch=0.75, rate=4.0)))
    assert falling is not None and falling.rule == "fall"
    assert Guard(LIMITS, 1.0).check(senses(imu=imu(pitch=0.75, rate=-4.0))) is None


LOWER, UPPER = np.full(3, -1.0), np.full(3, 1.0)
ANY = st.lists(st.floats(width=32) | st.sampled_from([math.nan, math.inf]), min_size=3, max_size=3)


@given(ANY, st.lists(st.floats(-1, 1), min_size=3, max_size=3))
def test_whatever_is_wanted_what_is_sent_is_within_range_and_speed(
    target: list[float], last: list[float]
) -> None:
    limiter = Limiter(NAMES, LOWER, UPPER, LIMITS)
    applied = limiter.apply(np.array(target), np.array(last), PERIOD)
    if not np.isfinite(target).all():
        assert isinstance(applied, Trip) and applied.rule == "bad target"
        return
    assert isinstance(applied, Applied)
    assert (np.abs(applied.goal) <= 1.0).all()
    assert (np.abs(applied.goal - last) <= LIMITS.speed * PERIOD + 1e-12).all()
    untouched = [name for name in NAMES if name not in applied.limited]
    for name in untouched:
        assert applied.goal[NAMES.index(name)] == target[NAMES.index(name)]


def test_a_pose_beyond_the_range_is_come_back_from_at_the_speed_limit() -> None:
    """A joint may stand beyond its limit when torque comes on; it must not snap."""
    limiter = Limiter(NAMES, LOWER, UPPER, LIMITS)
    applied = limiter.apply(np.zeros(3), np.full(3, 1.5), PERIOD)
    assert isinstance(applied, Applied)
    assert applied.goal == pytest.approx(np.full(3, 1.5 - LIMITS.speed * PERIOD))


def test_a_pose_beyond_the_range_may_stay_and_goes_no_further() -> None:
    limiter = Limiter(NAMES, LOWER, UPPER, LIMITS)
    outside = np.full(3, 1.5)
    for target in (outside, outside + 0.2):
        applied = limiter.apply(target, outside, PERIOD)
        assert isinstance(applied, Applied) and applied.goal == pytest.approx(outside)
    assert limiter.within(outside) == pytest.approx(np.ones(3))


def test_the_blocks_of_both_protocols_are_read_alike() -> None:
    one = REGISTERS[1].status(bytes([0, 8, 100, 4, 50, 0, 118, 45]), 0x24, True, Mounting())
    assert (one.position, one.voltage, one.temperature) == (0.0, 11.8, 45.0)
    assert one.velocity == pytest.approx(-100 * 0.114 * 2 * math.pi / 60)
    assert one.load == pytest.approx(50 / 1023) and one.alarm == "overheating, overload"
    block = bytearray(21)
    block[0:2] = (-200).to_bytes(2, "little", signed=True)
    block[2:6] = (-50).to_bytes(4, "little", signed=True)
    block[6:10] = (2048).to_bytes(4, "little")
    block[18:20], block[20] = (118).to_bytes(2, "little"), 45
    two = REGISTERS[2].status(bytes(block), 0x80, True, Mounting())
    assert (two.position, two.voltage, two.temperature, two.load) == (0.0, 11.8, 45.0, -0.2)
    assert two.velocity == pytest.approx(-50 * 0.229 * 2 * math.pi / 60)
    assert two.alarm == "hardware error"


def test_the_boards_own_sensors_find_the_tilt() -> None:
    """Leaning forward by 0.3 rad, after a start upright that the filter has to forget."""
    filtered = Board()
    for k in range(300):
        pitch = 0.0 if k == 0 else 0.3
        x, z = -math.sin(pitch) * 512 / 4, math.cos(pitch) * 512 / 4
        values = [512, 512, 512, 512, round(512 + x), round(512 + z)]
        data = b"".join(v.to_bytes(2, "little") for v in values) + bytes([118])
        told = filtered.take(data, k * PERIOD)
    assert told is not None
    assert told.pitch == pytest.approx(0.3, abs=0.01) and told.roll == pytest.approx(0, abs=0.01)


def test_ticks_that_were_missed_are_left_out_and_counted() -> None:
    metronome, never = Metronome(0.1), threading.Event()
    origin = metronome.wait(never)
    time.sleep(0.35)
    times = [metronome.wait(never) for _ in range(3)]
    beats = [(t - origin) / 0.1 for t in times]
    assert beats[0] == pytest.approx(4, abs=0.5), "the next beat, not those gone by"
    assert np.diff(times).min() > 0.05, "no burst"
    assert metronome.timing().missed == 3


def test_a_stop_does_not_wait_for_the_next_tick() -> None:
    metronome, wake = Metronome(5.0), threading.Event()
    threading.Timer(0.05, wake.set).start()
    before = time.monotonic()
    metronome.wait(wake)
    assert time.monotonic() - before < 1.0


def test_in_lock_step_time_counts_ticks() -> None:
    metronome, never = Metronome(0.5, lockstep=True), threading.Event()
    metronome.pace(False)
    assert [metronome.wait(never) for _ in range(3)] == [0.5, 1.0, 1.5]
