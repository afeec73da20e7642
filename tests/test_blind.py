"""A blind set conceals what it says it conceals, and a tampered one is found out."""

import hashlib
import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from commandline import files, pup, pup_process
from scipy.integrate import solve_ivp

from pup.blind.cases import strata
from pup.blind.catalogue import CLASS_OF
from pup.blind.make import make_set
from pup.blind.origin import generator
from pup.blind.seal import COMMITMENT, verify
from pup.blind.sensors import Noise, measure, see
from pup.blind.setting import NULLS, STRATA
from pup.blind.simulate import simulate
from pup.blind.world import Nominal, Plan, World
from pup.errors import InputError
from pup.files import read_json, write_json
from pup.recording import KEY, load_recordings
from pup.robot import RobotDescription
from services.held import held

CASES, NULL_CASES = {"servo_bench": 1}, {"servo_bench": 1, "darwin_leg": 1}
SEED = "open sesame, and shut again"


NULLS_ALONE, LONG = {"servo_bench": 2}, "again and again and again"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small set under `set`, its key beside it; leave it as it is."""
    folder = tmp_path_factory.mktemp("blind")
    make_set(CASES, NULL_CASES, SEED, folder / "set", folder / "key.json")
    return folder


@pytest.fixture
def bench() -> RobotDescription:
    return RobotDescription.load("servo_bench")


def nominal(robot: RobotDescription) -> Nominal:
    return Nominal.of(robot, {spec.name: spec.nominal for spec in robot.parameters})


def test_recordings_of_a_set_are_valid_and_follow_the_contract(made: Path, check_contract) -> None:
    check_contract(made / "set")
    folders = sorted((made / "set").glob("case_*"))
    assert len(folders) == 3
    for folder in folders:
        kept = load_recordings([folder / "recordings"])
        robot = RobotDescription.load(kept[0].robot)
        for recording in load_recordings([folder / "recordings"], robot):
            assert recording.time[-1] > 5
            assert recording.source == "unknown" and recording.notes == ""


def test_nothing_in_a_set_gives_the_truth_away(made: Path) -> None:
    words = [*CLASS_OF, *STRATA, *NULLS, "null", "unlisted", "truth", "effect", SEED]
    loud = re.compile("|".join(words), re.IGNORECASE)
    for file in sorted((made / "set").rglob("*.parquet")):
        schema = pq.read_schema(file)
        told = json.loads(schema.metadata[KEY])
        motion = told.pop("motion")
        assert told.pop("repeat_of") in (None, *(f.stem for f in file.parent.iterdir()))
        assert motion in ("step", "chirp", "triangle", "hold", "multisine", "drop")
        assert not loud.search(file.relative_to(made / "set").as_posix())
        assert not loud.search(" ".join([json.dumps(told), *schema.names]))
        assert set(schema.metadata) <= {KEY, b"ARROW:schema"}
    commitment = (made / "set" / COMMITMENT).read_text()
    assert json.loads(commitment)["cases"] == {"darwin_leg": 1, "servo_bench": 2}
    assert "null" not in commitment.replace('"engine_git_sha": null', "")


def test_commitment_is_the_hash_of_salt_and_key(made: Path) -> None:
    raw = (made / "key.json").read_bytes()
    salt = json.loads(raw)["salt"]
    committed = json.loads((made / "set" / COMMITMENT).read_text())["key_sha256"]
    assert committed == hashlib.sha256(salt.encode() + raw).hexdigest()
    assert len(verify(made / "set", made / "key.json")["cases"]) == 3


def copied(made: Path, to: Path) -> Path:
    for name, content in files(made).items():
        target = to / name
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
    return to


def test_a_changed_key_is_found_out(made: Path, tmp_path: Path) -> None:
    copy = copied(made, tmp_path)
    key = json.loads((copy / "key.json").read_text())
    key["cases"][0]["stratum"] = "null:noise"
    (copy / "key.json").write_text(json.dumps(key))
    with pytest.raises(InputError, match="not the key"):
        verify(copy / "set", copy / "key.json")


def test_other_counts_than_those_of_the_key_are_found_out(made: Path, tmp_path: Path) -> None:
    copy = copied(made, tmp_path)
    told = read_json(copy / "set" / COMMITMENT)
    write_json(copy / "set" / COMMITMENT, told | {"cases": {"servo_bench": 3}})
    with pytest.raises(InputError, match="its cases are not those of the key"):
        verify(copy / "set", copy / "key.json")


def test_the_key_names_the_generator(made: Path) -> None:
    assert read_json(made / "key.json")["generator"] == generator()


def test_a_changed_recording_is_found_out(made: Path, tmp_path: Path) -> None:
    copy = copied(made, tmp_path)
    first, second = sorted((copy / "set").glob("case_*/recordings/*.parquet"))[:2]
    first.write_bytes(second.read_bytes())
    with pytest.raises(InputError, match="not those"):
        verify(copy / "set", copy / "key.json")


def test_the_same_seed_makes_the_same_bytes_and_a_stopped_set_goes_on(tmp_path: Path) -> None:
    def make(folder: Path, stop_after: int = 9) -> dict[str, bytes]:
        def report(id: str, done: int, total: int) -> None:
            if done == stop_after:
                raise KeyboardInterrupt

        make_set({}, NULLS_ALONE, LONG, folder / "set", folder / "key", report)
        return files(folder)

    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "a", stop_after=1)
    (part,) = (p for p in (tmp_path / "a" / "key.parts").iterdir() if p.name != "set.json")
    assert oct(part.stat().st_mode & 0o777) == "0o600"
    part.unlink()  # as if killed while it was writing this case
    case = tmp_path / "a" / "set" / f"case_{part.stem}"
    (case / "recordings" / "r99.parquet").touch()
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "a", stop_after=1)
    next(case.glob("recordings/*.parquet")).unlink()  # its truth is there, a recording is not
    whole = make(tmp_path / "b")
    assert make(tmp_path / "a") == whole
    assert oct((tmp_path / "b" / "key").stat().st_mode & 0o777) == "0o600"


def test_files_of_a_set_are_begun_anew_when_all_are_made(tmp_path: Path) -> None:
    """When a file was begun, which nobody can set, would tell how long a case took."""
    begun: dict[str, int] = {}

    def report(id: str, done: int, total: int) -> None:
        for path in (tmp_path / "set" / f"case_{id}", *(tmp_path / "set").rglob("*.parquet")):
            begun[path.relative_to(tmp_path).as_posix()] = path.stat().st_ino

    make_set({}, NULLS_ALONE, LONG, tmp_path / "set", tmp_path / "key", report)
    assert len(begun) > 8
    assert all((tmp_path / name).stat().st_ino != inode for name, inode in begun.items())
    assert not list((tmp_path / "set").glob(".*"))


def test_a_set_that_is_being_made_is_nobody_elses(tmp_path: Path) -> None:
    order = ("--nulls", "servo_bench=2", "--seed", LONG, "--local")
    where = ("--out", tmp_path / "set", "--key", tmp_path / "key")
    with held(stopped(tmp_path)):
        before = files(tmp_path)
        done = pup("blind", "make", *order, *where)
        assert done.code == 1 and "another process works in this folder" in done.err
        assert files(tmp_path) == before
    assert pup("blind", "make", *order, *where).code == 0
    assert not (tmp_path / "key.parts").exists()


def stopped(folder: Path) -> Path:
    """What a set leaves that is stopped after its first case: the folder of its parts."""

    def report(id: str, done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        make_set({}, NULLS_ALONE, LONG, folder / "set", folder / "key", report)
    return folder / "key.parts"


def test_another_generator_does_not_go_on(tmp_path: Path) -> None:
    plan = stopped(tmp_path) / "set.json"
    told = read_json(plan)
    told["generator"]["source_sha256"] = "0"
    write_json(plan, told)
    with pytest.raises(InputError, match="another version of the generator"):
        make_set({}, NULLS_ALONE, LONG, tmp_path / "set", tmp_path / "key")


def test_a_folder_of_no_case_is_not_committed_to(tmp_path: Path) -> None:
    stopped(tmp_path)
    (tmp_path / "set" / "case_0").mkdir()
    with pytest.raises(InputError, match="case_0 in it or in its key"):
        make_set({}, NULLS_ALONE, LONG, tmp_path / "set", tmp_path / "key")
    assert not (tmp_path / "set" / COMMITMENT).exists()


def test_short_seeds_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="16 characters"):
        make_set({}, NULLS_ALONE, "guess me", tmp_path / "set", tmp_path / "key")
    assert not files(tmp_path)


@pytest.mark.ray
def test_cases_made_at_once_are_those_made_one_by_one(tmp_path: Path) -> None:
    for name, how in (("one", ("--local",)), ("two", ("--cores", 2))):
        where = ("--out", tmp_path / name / "set", "--key", tmp_path / name / "key")
        order = ("--nulls", "servo_bench=2", "--seed", LONG)
        done = pup_process("blind", "make", *order, *where, *how)
        assert done.code == 0, done.err
        assert "2/2 cases" in done.err
    assert files(tmp_path / "one") == files(tmp_path / "two")


def test_strata_come_in_their_shares() -> None:
    drawn = strata(100, STRATA)
    assert {name: drawn.count(name) / 100 for name in STRATA} == pytest.approx(STRATA)
    assert len(strata(7, NULLS)) == 7


def test_a_null_without_noise_is_the_nominal_model(bench: RobotDescription) -> None:
    """Against an integration of the pendulum by a method of its own."""
    time = 0.033 * np.arange(60)
    target = np.where(time < 0.9, 0.0, 0.6)[:, None]
    plan = Plan("a", "step", "bench", time, target, setup={"mass": 0.25, "length": 0.12})
    world = World(bench, nominal(bench))
    seen = see(world, [plan], simulate(world, [plan]))[0]
    quiet = Noise(position=0.0, quantum=0.0)
    told = measure(world, plan, seen, quiet, np.random.default_rng(0)).position[:, 0]
    kp, kd, most = (float(v[0]) for v in vars(world.nominal).values() if np.ndim(v))
    inertia = 0.25 * 0.12**2 + 1e-6 + 1e-7 + world.nominal.armature

    def rate(_: float, state: np.ndarray, goal: float) -> list[float]:
        torque = np.clip(kp * (goal - state[0]) - kd * state[1], -most, most)
        return [state[1], (torque - 0.25 * 9.81 * 0.12 * np.sin(state[0])) / inertia]

    state, angles = np.zeros(2), []
    for start, end, goal in zip(time[:-1], time[1:], target[:-1, 0], strict=True):
        angles.append(state[0])
        state = solve_ivp(rate, (start, end), state, rtol=1e-9, atol=1e-11, args=(goal,)).y[:, -1]
    assert np.abs(told[:-1] - angles).max() < 1e-4


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--robot", "emps=1"), "blind sets are of"),
        (("--robot", "some/folder=1"), "not known of another robot"),
        ((), "no case asked for"),
        (("--robot", "servo_bench"), "NAME=COUNT"),
        (("--nulls", "servo_bench=-1"), "NAME=COUNT"),
        (("--nulls", "servo_bench=1", "servo_bench=2"), "--nulls: a robot is named twice"),
    ],
)
def test_a_wrong_order_is_refused(options: tuple[str, ...], told: str, tmp_path: Path) -> None:
    where = ("--seed", LONG, "--out", tmp_path / "set", "--key", tmp_path / "key")
    done = pup("blind", "make", *options, *where)
    assert done.code == 2 and told in done.err
    assert not list(tmp_path.iterdir())


def test_a_key_inside_the_set_is_refused(tmp_path: Path) -> None:
    where = ("--out", tmp_path / "set", "--key", tmp_path / "set" / "key")
    done = pup("blind", "make", "--nulls", "servo_bench=1", "--seed", LONG, *where)
    assert done.code == 2 and "outside" in done.err
