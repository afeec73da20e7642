"""A virtual robot records what its concealed parameters make it do, and nothing else."""

import json
import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pup.errors import InputError
from pup.physics.mujoco_batch import MujocoSimulator
from pup.physics.parameters import NETWORK_NAMES, robot_space
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription, built_in_robots
from pup.robot_parts import TermSpec
from pup.robot_writer import write_corrected
from pup.sysid.excitation import script
from pup.sysid.loss import ReplayLoss
from pup.sysid.virtual import (
    SensorNoise,
    concealed_parameters,
    nominal_space,
    record,
    record_virtual,
)

ROOT = Path(__file__).parents[1]
KINDS = ("step:0.6", "standup:1.75", "fall:forward", "fall:right")
QUIET = SensorNoise(position=0.0, quantum=0.0, imu=0.0, tick=0.0)
# Sensor noise and rounding leave 1.1 mrad; a start off by as much as that adds to it on the ground.
WITHIN = {"suspended": 0.0013, "bench": 0.0013, "ground": 0.002}


@pytest.fixture(scope="module")
def op2() -> RobotDescription:
    return RobotDescription.load("darwin_op2")


@pytest.fixture(scope="module")
def truth(op2: RobotDescription) -> dict[str, float]:
    return concealed_parameters(op2, "nn_pd", np.random.default_rng(3))


@pytest.fixture(scope="module")
def recordings(op2: RobotDescription, truth: dict[str, float]) -> tuple[Recording, ...]:
    rng = np.random.default_rng(1)
    motions = script(op2, KINDS, rng, jitter=True)
    return record_virtual(op2, motions, "nn_pd", truth, rng)


def replayed(
    robot: RobotDescription, recordings: tuple[Recording, ...], actuator: str, **values: float
) -> np.ndarray:
    """RMS error per recording of a replay under given parameters, rad."""
    space = robot_space(robot, actuator).at(values)
    seen = MujocoSimulator(robot, recordings, actuator).replay(space.candidates())
    error = ReplayLoss(robot, recordings).rmse(seen)[0]
    return np.sqrt((error**2).mean(axis=1))


def test_recordings_replay_to_themselves_under_the_truth(
    op2: RobotDescription, truth: dict[str, float], recordings: tuple[Recording, ...]
) -> None:
    found = replayed(op2, recordings, "nn_pd", **truth)
    assert (found < [WITHIN[r.support] for r in recordings]).all(), found
    assert (replayed(op2, recordings, "nn_pd") > 2 * found).all()


@pytest.mark.parametrize(
    ("effect", "values"),
    [
        ("clock_skew", {"share": 0.02}),
        ("thermal_drift", {"rate": 0.05}),
        ("thermal_drift", {"rate": 0.5, "load": 1.0}),
    ],
)
def test_what_grows_with_time_begins_with_the_recording(
    effect: str, values: dict[str, float], tmp_path: Path
) -> None:
    """Not with the time to settle before it, of which a replay knows nothing."""
    leg = RobotDescription.load("darwin_leg")
    robot = write_corrected(leg, tmp_path, {}, [TermSpec(effect, "robot", "", values)])
    rng = np.random.default_rng(0)
    seen = record_virtual(robot, script(robot, ["step:0.6"], rng), "pd", {}, rng, QUIET)
    assert replayed(robot, seen, "pd").max() < 2e-4
    assert replayed(leg, seen, "pd").max() > 2e-3


def test_torso_and_feet_replay_to_themselves_too(
    op2: RobotDescription, truth: dict[str, float], recordings: tuple[Recording, ...]
) -> None:
    space = robot_space(op2, "nn_pd").at(truth)
    seen = MujocoSimulator(op2, recordings).replay(space.candidates())
    for recording, part in zip(recordings, seen.ticks, strict=True):
        if recording.support == "ground":
            felt = np.stack([recording.extras[f"imu/{a}"] for a in ("roll", "pitch")], axis=1)
            assert np.sqrt(np.mean((felt - seen.tilt[0, part]) ** 2)) < 0.006, recording.id
        if recording.motion == "standup":
            feet = seen.feet[0, part]
            assert np.linalg.norm(feet - feet[0], axis=-1).max() < 0.01


def test_recordings_begin_at_rest(op2: RobotDescription, truth: dict[str, float]) -> None:
    motions = script(op2, ("step:0.3", "standup:1.75"), np.random.default_rng(0))
    for recording in record_virtual(op2, motions, "nn_pd", truth, np.random.default_rng(0), QUIET):
        assert (recording.target[2] == recording.target[0]).all()
        moved = np.abs(recording.position[2] - recording.position[0])
        assert moved.max() < 1e-3, recording.id


def test_the_robot_stands_up_and_falls_as_told(recordings: tuple[Recording, ...]) -> None:
    _, standup, forward, right = recordings
    for name in ("roll", "pitch"):
        assert np.abs(standup.extras[f"imu/{name}"]).max() < 0.35
    assert forward.extras["imu/pitch"][-1] > 0.95
    assert right.extras["imu/roll"][-1] > 0.95
    for fall in (forward, right):
        assert np.abs(fall.extras["imu/pitch"][:-1]).max() < 1.05, "recorded after the fall"


def test_only_what_the_robot_has_sensors_for_is_recorded(
    recordings: tuple[Recording, ...],
) -> None:
    for recording in recordings:
        on_ground = recording.support == "ground"
        assert set(recording.extras) == ({"imu/roll", "imu/pitch"} if on_ground else set())
        assert recording.source == "simulation"


def test_positions_are_on_the_ticks_of_a_12_bit_encoder(
    recordings: tuple[Recording, ...],
) -> None:
    for recording in recordings:
        ticks = recording.position * 4096 / (2 * np.pi)
        assert ticks == pytest.approx(np.round(ticks), abs=1e-6)


def test_noise_has_the_spread_asked_for(op2: RobotDescription, truth: dict[str, float]) -> None:
    motions = script(op2, ("standup:1.75",), np.random.default_rng(0))
    noise = SensorNoise(position=0.01, quantum=0.0, imu=0.02, tick=0.0)
    (quiet,) = record_virtual(op2, motions, "nn_pd", truth, np.random.default_rng(0), QUIET)
    (noisy,) = record_virtual(op2, motions, "nn_pd", truth, np.random.default_rng(0), noise)
    assert np.std(noisy.position - quiet.position) == pytest.approx(0.01, rel=0.1)
    added = [noisy.extras[n] - quiet.extras[n] for n in ("imu/roll", "imu/pitch")]
    assert np.std(added) == pytest.approx(0.02, rel=0.2)
    assert np.array_equal(noisy.time, motions[0].time)


def test_ticks_are_late_by_chance_and_never_out_of_order(
    op2: RobotDescription, truth: dict[str, float]
) -> None:
    motions = script(op2, ("step:0.1",), np.random.default_rng(0))
    wild = SensorNoise(tick=0.1)
    (recording,) = record_virtual(op2, motions, "nn_pd", truth, np.random.default_rng(0), wild)
    gaps = np.diff(recording.time)
    assert gaps.min() > 0
    assert np.ptp(gaps) > 0.01


def test_repeats_share_the_script_and_not_the_noise(
    op2: RobotDescription, truth: dict[str, float]
) -> None:
    motions = script(op2, ("step:0.3",), np.random.default_rng(0))
    first, second = record_virtual(
        op2, motions, "nn_pd", truth, np.random.default_rng(0), repeats=2
    )
    assert (first.repeat_of, second.repeat_of) == (None, first.id)
    assert np.array_equal(first.target, second.target)
    assert not np.array_equal(first.time, second.time)
    assert np.abs(first.position - second.position).max() < 0.03


@pytest.mark.parametrize(
    ("name", "actuator"),
    [("darwin_leg", "nn_pd"), ("servo_bench", "pd"), ("emps", "pd"), ("darwin_op2", "pd")],
)
def test_every_robot_and_actuator_records_itself(name: str, actuator: str) -> None:
    robot = RobotDescription.load(name)
    rng = np.random.default_rng(0)
    values = concealed_parameters(robot, actuator, rng)
    motions = script(robot, ("step:0.3", "chirp"), rng, jitter=True)
    made = record_virtual(robot, motions, actuator, values, rng)
    lower = np.array([joint.lower for joint in robot.joints])
    upper = np.array([joint.upper for joint in robot.joints])
    for recording in made:
        assert recording.support == ("suspended" if robot.floating else "bench")
        assert (recording.position > lower - 0.5).all()
        assert (recording.position < upper + 0.5).all()
    assert (replayed(robot, made, actuator, **values) < 0.0013).all()


@pytest.mark.parametrize("name", built_in_robots())
@pytest.mark.parametrize("actuator", ["nn_pd", "pd"])
def test_concealed_parameters_are_inside_the_search_ranges(name: str, actuator: str) -> None:
    robot = RobotDescription.load(name)
    if actuator == "nn_pd" and robot.network is None:
        pytest.skip(f"{name} has no network")
    space = robot_space(robot, actuator)
    drawn = np.array(
        [
            list(concealed_parameters(robot, actuator, np.random.default_rng(s)).values())
            for s in range(200)
        ]
    )
    assert (drawn >= space.lower).all()
    assert (drawn <= space.upper).all()
    free = [n not in NETWORK_NAMES for n in space.names]
    assert (np.ptp(drawn, axis=0)[free] > 0).all()
    assert (np.ptp(drawn, axis=0)[~np.array(free)] == 0).all()


def test_concealed_parameters_of_the_op2_are_drawn_where_they_may_well_be(
    op2: RobotDescription,
) -> None:
    space = nominal_space(op2, "nn_pd")
    nominal = space.candidates().named()
    draws = [concealed_parameters(op2, "nn_pd", np.random.default_rng(s)) for s in range(200)]
    expected = {
        "rho/hip": (0.7 * nominal["rho/hip"], 1.4 * nominal["rho/hip"]),
        "torque_limit": (0.52 * nominal["torque_limit"], 1.22 * nominal["torque_limit"]),
        "torso_com/x": (nominal["torso_com/x"] - 0.02, nominal["torso_com/x"] + 0.02),
        "ground_friction": (0.5, 1.2),
    }
    for name, (low, high) in expected.items():
        low = max(low, space.select([name]).lower[0])
        seen = [draw[name] for draw in draws]
        near = 0.03 * (high - low)
        assert (min(seen), max(seen)) == pytest.approx((low, high), abs=near), name


def test_concealed_parameters_may_be_drawn_around_other_values(op2: RobotDescription) -> None:
    draws = [
        concealed_parameters(op2, "nn_pd", np.random.default_rng(seed), {"rho/hip": 2.9})
        for seed in range(50)
    ]
    hip = sorted(draw["rho/hip"] for draw in draws)
    assert 0.7 * 2.9 <= hip[0] < hip[-1] < 3.0
    assert len(set(hip)) == 50, "draws pile up at the end of the search range"


def test_an_unknown_parameter_is_refused(op2: RobotDescription) -> None:
    motions = script(op2, ("step:0.1",), np.random.default_rng(0))
    with pytest.raises(InputError, match="'rho/tail'"):
        record_virtual(op2, motions, "nn_pd", {"rho/tail": 1.0}, np.random.default_rng(0))


def test_impossible_parameters_are_refused(op2: RobotDescription) -> None:
    motions = script(op2, ("step:0.1",), np.random.default_rng(0))
    worse = {f"rho/{g}": 1e12 for g in op2.groups} | {"torque_limit": 1e12}
    with pytest.raises(InputError, match="breaks down"):
        record_virtual(op2, motions, "nn_pd", worse, np.random.default_rng(0))


def test_record_writes_files_that_keep_the_contract(
    op2: RobotDescription, tmp_path: Path, check_contract: Callable[[Path], None]
) -> None:
    record(op2, KINDS, tmp_path, seed=4)
    check_contract(tmp_path)


def test_record_writes_what_it_returns_and_tells_no_truth(
    op2: RobotDescription, tmp_path: Path
) -> None:
    made = record(op2, ("step:0.1", "fall:left"), tmp_path, seed=4)
    read = load_recordings([tmp_path])
    assert {r.id: r.digest for r in read} == {r.id: r.digest for r in made}
    assert {path.suffix for path in tmp_path.iterdir()} == {".parquet"}


def test_one_seed_makes_one_robot_whatever_it_plays(op2: RobotDescription, tmp_path: Path) -> None:
    one = record(op2, ("step:0.1",), tmp_path / "a", seed=7, truth=tmp_path / "a.json")
    same = record(op2, ("step:0.1",), tmp_path / "b", seed=7, truth=tmp_path / "b.json")
    record(op2, ("chirp",), tmp_path / "c", seed=7, truth=tmp_path / "c.json")
    record(op2, ("step:0.1",), tmp_path / "d", seed=8, truth=tmp_path / "d.json")
    told = [json.loads((tmp_path / f"{n}.json").read_text())["parameters"] for n in "abcd"]
    assert told[0] == told[1] == told[2] != told[3]
    assert one[0].digest == same[0].digest
    assert set(told[0]) == set(robot_space(op2, "nn_pd").names)


def test_what_is_changed_on_the_robot_acts_and_is_told(tmp_path: Path) -> None:
    bench, setup = RobotDescription.load("servo_bench"), {"mass": 0.6}
    own = concealed_parameters(bench, "pd", np.random.default_rng(1))
    (usual,), (heavy,) = (
        record(bench, ["hold"], tmp_path / name, 1, "pd", own, QUIET, jitter=False, setup=changed)
        for name, changed in (("usual", None), ("heavy", setup))
    )
    assert (usual.setup, heavy.setup) == ({}, setup)
    sag = [float(np.abs(r.target - r.position).max()) for r in (usual, heavy)]
    assert sag[1] > 1.3 * sag[0]
    space = nominal_space(bench, "pd").at(own)
    replayed = MujocoSimulator(bench, [heavy], "pd", lead=2.0).replay(space.candidates())
    assert replayed.position[0, -1] == pytest.approx(heavy.position[-1], abs=1e-3)


def test_record_does_not_mix_with_other_recordings(op2: RobotDescription, tmp_path: Path) -> None:
    record(op2, ("step:0.1",), tmp_path, seed=1)
    record(op2, ("step:0.1",), tmp_path, seed=2)
    with pytest.raises(InputError, match=r"step_0\.1\.parquet"):
        record(op2, ("step:0.3",), tmp_path, seed=1)


def test_a_real_recording_is_never_written_over(tmp_path: Path) -> None:
    """Motions have the same names on a real robot and on a virtual one."""
    bench = RobotDescription.load("servo_bench")
    (made,) = record(bench, ["hold"], tmp_path, seed=1)
    real = replace(made, source="hardware", notes="the only one")
    file = tmp_path / "hold.parquet"
    real.write(file)
    with pytest.raises(InputError, match=r"holds other recordings \(hold\.parquet\)"):
        record(bench, ["hold"], tmp_path, seed=2)
    assert Recording.read(file).notes == "the only one"
    made.write(file)
    record(bench, ["hold"], tmp_path, seed=2)
    assert Recording.read(file).digest != made.digest


class TestShipped:
    """The recordings that come with the package."""

    @pytest.fixture(scope="class")
    def shipped(self, op2: RobotDescription) -> tuple[Recording, ...]:
        return load_recordings([op2.folder / "recordings"])

    def test_they_are_few_small_and_of_all_kinds(
        self, op2: RobotDescription, shipped: tuple[Recording, ...]
    ) -> None:
        motions = [recording.motion for recording in shipped]
        assert [motions.count(m) for m in ("step", "standup", "fall")] == [9, 2, 2]
        files = list((op2.folder / "recordings").glob("*"))
        assert len(files) == len(shipped) == 13
        assert sum(file.stat().st_size for file in files) < 1e6

    def test_they_keep_the_contract(
        self, op2: RobotDescription, check_contract: Callable[[Path], None]
    ) -> None:
        check_contract(op2.folder / "recordings")

    def test_the_robot_stands_up_and_falls(self, shipped: tuple[Recording, ...]) -> None:
        for recording in shipped:
            if recording.support == "ground":
                tilt = np.abs([recording.extras[f"imu/{a}"] for a in ("roll", "pitch")]).max(axis=0)
                assert tilt[0] < 0.35
                assert (tilt[-1] > 0.95) == (recording.motion == "fall")
                assert recording.motion == "fall" or tilt.max() < 0.35

    def test_they_are_of_the_robot_that_walks_in_a_job(
        self, shipped: tuple[Recording, ...], tmp_path: Path
    ) -> None:
        """Through its bus; up to two steps of the encoder, for processors differ in last bits."""
        example = runpy.run_path(str(ROOT / "examples/make_recordings.py"))
        example["main"](tmp_path)
        for made, kept in zip(load_recordings([tmp_path]), shipped, strict=True):
            assert made.id == kept.id
            if kept.motion != "fall":  # in which last bits grow
                assert made.target == pytest.approx(kept.target, abs=1e-9)
                assert made.position == pytest.approx(kept.position, abs=0.0031)
