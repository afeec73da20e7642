"""What a policy from scratch begins with: patterns, their search and their imitation."""

import io
import json
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from walking import BOUNDS, DARWIN, walking

pytest.importorskip("torch")
pytest.importorskip("gymnasium")

import torch
from biped import biped, biped_bounds

from pup.errors import InputError
from pup.files import write_json
from pup.locomotion import demonstration
from pup.locomotion.demonstration import PatternSearch, imitate, taught
from pup.locomotion.evaluation import evaluate
from pup.locomotion.pattern import TURN, Patterns, PatternSpace
from pup.locomotion.sampling import ParameterSampler
from pup.locomotion.settings import Direction, TaskSettings
from pup.locomotion.task import WalkingTask
from pup.policy.network import ProjectedPolicy, bell, expected
from pup.policy.shape import Method, PolicyShape
from services import first_gait, training
from services.training_options import Options
from workers.cluster import connected
from workers.learner import Learning

BINS = 11
LEG = ["hip_roll", "hip_pitch", "knee", "ank_pitch", "ank_roll"]


def space(direction: Direction = Direction.FORWARD) -> PatternSpace:
    return PatternSpace(DARWIN, direction)


def moved(patterns: Patterns, phase: float, turned: tuple[float, float]) -> np.ndarray:
    """The action of the only pattern, from -1 to 1."""
    where = np.array([[np.cos(phase), np.sin(phase)]])
    return patterns.bins(where, np.array([turned]), BINS)[0] / (BINS - 1) * 2 - 1


@given(
    seed=st.integers(0, 1000),
    phase=st.floats(0, 6.3),
    roll=st.floats(-0.4, 0.4),
    pitch=st.floats(-0.4, 0.4),
)
@settings(max_examples=40, deadline=None)
def test_a_mirrored_robot_does_the_mirror_image_half_a_period_later(
    seed: int, phase: float, roll: float, pitch: float
) -> None:
    unit = np.random.default_rng(seed).uniform(0.3, 0.7, (1, space().dimension))
    patterns = space().patterns(unit)
    permutation, sign = DARWIN.mirror()
    here = moved(patterns, phase, (roll, pitch))
    there = moved(patterns, phase + np.pi, (-roll, pitch))
    np.testing.assert_allclose(there, (sign * here[permutation]), atol=1e-9)


def test_legs_alone_take_part_and_sideways_each_has_a_pattern_of_its_own() -> None:
    """5 joints of a leg, 5 waves and 2 gains each."""
    assert space().dimension == 5 * 5 + 5 * 2
    sideways = space(Direction.SIDEWAYS)
    assert sideways.dimension == 10 * 5 + 5 * 2
    unit = np.random.default_rng(0).uniform(0, 1, (1, sideways.dimension))
    patterns = sideways.patterns(unit)
    still = {n for n, w in zip(DARWIN.joint_names, patterns.waves[0], strict=True) if not w.any()}
    assert still == set(DARWIN.joint_names) - {f"{s}_{joint}" for s in "lr" for joint in LEG}
    left, right = (DARWIN.joint_names.index(f"{s}_hip_roll") for s in "lr")
    assert not np.allclose(np.abs(patterns.waves[0, left]), np.abs(patterns.waves[0, right]))
    assert np.allclose(np.abs(patterns.gains[0, left]), np.abs(patterns.gains[0, right]))


def test_the_middle_of_the_cube_is_no_pattern_and_actions_end_with_the_bins() -> None:
    nothing = space().patterns(np.full((1, space().dimension), 0.5))
    np.testing.assert_allclose(moved(nothing, 1.0, (0.1, 0.1)), 0.0, atol=1e-12)
    most = space().patterns(np.ones((1, space().dimension)))
    assert np.abs(moved(most, 0.0, (9.0, -9.0))).max() == 1.0


def test_a_robot_without_a_mirror_map_moves_each_joint_by_itself() -> None:
    joints = tuple(replace(joint, mirror=None) for joint in DARWIN.joints)
    alone = PatternSpace(replace(DARWIN, joints=joints), Direction.FORWARD)
    assert alone.dimension == 10 * 5 + 10 * 2


def test_a_reflex_answers_to_how_the_torso_turned_between_two_readings() -> None:
    gains = np.zeros((3, len(DARWIN.joints), 2))
    gains[:, 12, 1] = 0.5
    patterns = Patterns(np.zeros((3, len(DARWIN.joints), 5)), gains)
    task = walking(n=3)
    seen = task.reset().proprioception.copy()
    names = task.observation_names
    seen[:, names.index("imu/pitch")] = seen[:, names.index("imu_before/pitch")] + TURN / 2
    told = taught(patterns, task, seen)
    assert told[0, 12] == pytest.approx(5 + 0.5 / 2 * 5, abs=1e-5)
    assert np.delete(told, 12, axis=1) == pytest.approx(5.0)


def test_a_bell_has_its_mean_where_the_action_is() -> None:
    actions = torch.tensor([[3.3, 5.0], [7.8, 6.5]])
    probabilities = torch.softmax(bell(actions, BINS), dim=-2)
    mean = (probabilities * torch.arange(BINS)[:, None]).sum(dim=1)
    torch.testing.assert_close(mean, actions, atol=0.01, rtol=0)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """A search and an imitation of seconds."""
    for name, value in {
        "POPULATION": 6,
        "ROBOTS": 2,
        "JUDGES": 2,
        "FINALISTS": 3,
        "ROUNDS": 2,
        "STEPS": 30,
    }.items():
        monkeypatch.setattr(demonstration, name, value)
    monkeypatch.setattr(demonstration, "HORIZON", 0.8)
    monkeypatch.setattr(first_gait, "PUPILS", 32)
    monkeypatch.setattr(first_gait, "ROUNDS", 2)


@pytest.fixture(scope="module")
def ray_here() -> Iterator[None]:
    with connected(cores=2):
        yield


def make(n: int, seed: int, horizon: float) -> WalkingTask:
    told = replace(TaskSettings().evaluation(), horizon=horizon)
    return walking(told, n, seed, sampler=ParameterSampler(BOUNDS))


@pytest.mark.usefixtures("small")
def test_a_search_goes_on_where_another_was_stopped() -> None:
    whole, first = (PatternSearch(space(), make, 3) for _ in range(2))
    expected_generations = [whole.generation() for _ in range(4)]
    told = [first.generation() for _ in range(2)]
    second = PatternSearch(space(), make, 3)
    second.resume(np.stack(first.losses))
    told += [second.generation() for _ in range(2)]
    assert told == expected_generations
    np.testing.assert_array_equal(second.chosen()[0].waves, whole.chosen()[0].waves)
    other = PatternSearch(space(), make, 4)
    assert other.generation() != told[0]


def test_a_pupil_does_what_it_was_shown() -> None:
    """A pattern that is large and has no reflex, from the joints' readings alone."""
    waves = np.zeros((1, len(DARWIN.joints), 5))
    arm = DARWIN.joint_names.index("l_sho_pitch")
    waves[0, arm, :2] = 0.2, 0.6
    pattern = Patterns(waves, np.zeros((1, len(DARWIN.joints), 2)))
    task = walking(TaskSettings(), 32, sampler=ParameterSampler(BOUNDS))
    names = len(task.observation_names), len(task.parameter_names), len(task.privileged_names)
    torch.manual_seed(0)
    policy = ProjectedPolicy(PolicyShape.of(Method.PUP, *names, len(task.joints)))
    rounds: list[int] = []
    imitate(policy, pattern, task, 0, rounds.append)
    assert rounds == list(range(1, demonstration.ROUNDS + 1))
    errors, sizes = [], []

    def watched(seen: np.ndarray, parameters: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            bins = expected(policy(torch.from_numpy(seen), torch.from_numpy(parameters))).numpy()
        wanted = taught(pattern.repeated(len(seen)), fresh, seen)
        errors.append(np.abs(bins - wanted)[:, arm].mean())
        sizes.append(np.abs(wanted - 5)[:, arm].mean())
        return bins

    fresh = walking(replace(TaskSettings(), horizon=2.0), 32, 9, sampler=ParameterSampler(BOUNDS))
    evaluate(watched, fresh)
    assert np.mean(errors[10:]) < 0.2 * np.mean(sizes[10:])


# --- The job --------------------------------------------------------------------------------------

SMALL = Options(
    steps=128,
    simulations=4,
    length=8,
    learning=Learning(epochs=1, minibatch=16),
    pattern=3,
)


def job(out: Path, said: Callable[[str, float], None], options: Options = SMALL) -> dict:
    cluster = lambda: nullcontext(2)  # noqa: E731
    return training.train(DARWIN, None, options, out, cluster, lambda row, steps: None, said)


@pytest.mark.ray
@pytest.mark.usefixtures("small", "ray_here")
def test_an_interrupted_search_ends_alike(tmp_path: Path) -> None:
    """Told before anything is learnt, and kept: the same command gives the same weights."""
    told: list[tuple[str, float]] = []
    document = job(tmp_path / "whole", lambda words, share: told.append((words, share)))
    assert [share for _, share in told] == pytest.approx([1 / 3, 2 / 3, 1, 0.5, 1])
    assert "gait pattern" in told[0][0] and told[-1][0] == "imitation"
    gait = json.loads((tmp_path / "whole" / "pattern.json").read_text())
    assert document["provenance"]["pattern"] == gait
    assert gait["generations"] == 3 and np.shape(gait["waves"]) == (20, 5)

    def stop(words: str, share: float) -> None:
        if share > 0.6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        job(tmp_path / "part", stop)
    after: list[tuple[str, float]] = []
    job(tmp_path / "part", lambda words, share: after.append((words, share)))
    assert after == told[2:]
    one, two = (np.load(tmp_path / n / "policy" / "weights.npz") for n in ("whole", "part"))
    assert all(np.array_equal(one[name], two[name]) for name in one.files)


@pytest.mark.ray
@pytest.mark.usefixtures("small", "ray_here")
def test_a_search_serves_other_trainings_of_the_same_task(tmp_path: Path) -> None:
    """Of another method or length, and is gone on with where it shall be longer."""
    told: list[str] = []
    job(tmp_path, lambda words, share: None)
    (tmp_path / "checkpoint.npz").unlink()
    longer = replace(SMALL, method=Method.ROBUST, steps=64, pattern=4)
    job(tmp_path, lambda words, share: told.append(words), longer)
    assert [words.split(",")[0] for words in told] == ["gait pattern", "imitation", "imitation"]
    for other in (replace(SMALL, seed=1), replace(SMALL, direction=Direction.BACKWARD)):
        (tmp_path / "checkpoint.npz").unlink(missing_ok=True)
        with pytest.raises(InputError, match=r"pattern\.npz: the search for another robot"):
            job(tmp_path, lambda words, share: None, other)


@pytest.mark.ray
@pytest.mark.usefixtures("small", "ray_here")
def test_a_robot_without_a_mirror_map_is_trained(tmp_path: Path) -> None:
    """By usual settings, which ask for the mirror loss where a robot has such a map."""
    robot = biped(tmp_path)
    assert not robot.mirrored and PatternSpace(robot, Direction.FORWARD).dimension == 5 + 2
    known = biped_bounds(robot)
    box = zip(known.names, known.lower, known.upper, strict=True)
    write_json(
        tmp_path / "bounds.json",
        {
            "schema": 1,
            "robot": "biped",
            "actuator": {"kind": "pd", "weights": []},
            "parameters": [
                {"name": name, "nominal": (low + high) / 2, "lower": low, "upper": high}
                for name, low, high in box
            ],
        },
    )
    quiet = lambda *_: None  # noqa: E731
    told = (SMALL, tmp_path / "out", lambda: nullcontext(2), quiet, quiet)
    assert SMALL.learning.weights.mirror
    document = training.train(robot, tmp_path / "bounds.json", *told)
    assert document["done"] and (tmp_path / "out" / "policy" / "weights.npz").exists()


def packed_strangely() -> bytes:
    """A search whose first array is packed in a way that nobody knows."""
    content = io.BytesIO()
    np.savez(content, losses=np.zeros((1, 20)))
    raw = bytearray(content.getvalue())
    raw[raw.index(b"PK\x01\x02") + 10] = 99
    return bytes(raw)


@pytest.mark.parametrize("content", [b"", b"PK", b"\x93NUMPY no", packed_strangely()])
def test_a_broken_search_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "pattern.npz").write_bytes(content)
    with pytest.raises(InputError, match=r"pattern\.npz: not a search for a gait"):
        job(tmp_path, lambda words, share: None)


@pytest.mark.slow
def test_a_search_finds_a_gait_that_walks() -> None:
    """A fifth of the usual one: 0.3 m in 7 s, on robots it has not seen, and up."""
    search = PatternSearch(space(), make, 0)
    for _ in range(25):
        search.generation()
    _, walks = search.chosen()
    assert np.median(walks.distance) > 0.3
    assert (~walks.fell).mean() > 0.8
