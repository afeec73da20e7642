"""Recordings: what they keep, load and fit."""

import dataclasses
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from recordings import COLUMNS, make, write_table

from pup.errors import InputError
from pup.recording import Recording, load_recordings, write_recordings
from pup.recording_cuts import cut
from pup.recording_file import read_header
from pup.robot import RobotDescription


def same(one: Recording, other: Recording) -> bool:
    mine, its = dict(one.columns()), dict(other.columns())
    return (
        one.metadata() == other.metadata()
        and list(mine) == list(its)
        and all(np.array_equal(mine[name], its[name], equal_nan=True) for name in mine)
    )


def test_reads_what_the_contract_describes(tmp_path: Path) -> None:
    recording = Recording.read(write_table(tmp_path / "r.parquet", COLUMNS))
    assert recording.joints == ("a", "b")
    assert recording.target.shape == recording.position.shape == (4, 2)
    assert recording.setup == {"mass": 0.5}
    assert np.isnan(recording.position[1, 1]) and np.isnan(recording.target[3, 0])
    assert set(recording.extras) == {"velocity/a", "voltage", "imu/gyro_y", "torque_enabled"}


def test_missing_samples_are_null_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "r.parquet"
    make(extras={"voltage": [12.0, np.nan, 11.0]}).write(path)
    table = pq.read_table(path)
    assert table.column("position/a").to_pylist() == [0.0, 0.1, None]
    assert table.column("voltage").to_pylist() == [12.0, None, 11.0]


def test_what_is_written_keeps_the_contract(
    tmp_path: Path, check_contract: Callable[[Path], None]
) -> None:
    extras = {name: [1.0, np.nan, 0.0] for name in ("velocity/b", "imu/gyro_x", "torque_enabled")}
    make(extras=extras, setup={"mass": 1}, repeat_of="r0").write(tmp_path / "r.parquet")
    check_contract(tmp_path)


def test_samples_cannot_be_changed_behind_its_back() -> None:
    source = np.zeros((3, 2))
    recording = make(target=source)
    source[:] = 7.0
    assert not recording.target.any()
    with pytest.raises(ValueError, match="read-only"):
        recording.target[0, 0] = 1.0


def test_digest_follows_every_content_and_not_the_column_order() -> None:
    extras = {"voltage": [1.0, 2.0, 3.0], "imu/yaw": [0.0, 0.0, 0.0]}
    one = make(extras=extras)
    assert one.digest == make(extras=dict(reversed(extras.items()))).digest
    assert (
        len({one.digest, make().digest, make(notes="x").digest, make(time=[0, 1, 2]).digest}) == 4
    )


NAMES = st.lists(
    st.text(
        st.characters(categories=("L", "N"), include_characters="_./-"), min_size=1, max_size=8
    ),
    min_size=1,
    max_size=4,
    unique=True,
)
VALUES = st.floats(-1e6, 1e6) | st.just(float("nan"))


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    joints = tuple(draw(NAMES))
    gaps = draw(st.lists(st.floats(1e-4, 10.0), min_size=1, max_size=12))
    rows = len(gaps) + 1

    def values(*shape: int) -> np.ndarray:
        drawn = draw(hnp.arrays(np.float64, shape, elements=VALUES))
        drawn[0] = np.nan_to_num(drawn[0])  # every needed column has one sample
        return drawn

    extras = {}
    for kind in draw(st.sets(st.sampled_from(("velocity", "current", "load", "temperature")))):
        extras[f"{kind}/{joints[0]}"] = values(rows)
    for name in draw(st.sets(st.sampled_from(("voltage", "imu/roll", "imu/accel_z")))):
        extras[name] = values(rows)
    return make(
        id=draw(st.text(st.characters(categories=("L", "N")), min_size=1, max_size=20)),
        joints=joints,
        time=draw(st.floats(-1e3, 1e3)) + np.concatenate([[0.0], np.cumsum(gaps)]),
        target=values(rows, len(joints)),
        position=values(rows, len(joints)),
        extras=extras,
        setup=draw(st.dictionaries(st.text(max_size=5), st.floats(-1e9, 1e9), max_size=3)),
        repeat_of=draw(st.none() | st.just("other")),
        notes=draw(st.text(max_size=30)),
    )


@settings(max_examples=60)
@given(recordings())
def test_writing_and_reading_keeps_everything(tmp_path_factory: Any, recording: Recording) -> None:
    path = tmp_path_factory.mktemp("round") / "r.parquet"
    recording.write(path)
    back = Recording.read(path)
    assert same(back, recording)
    assert back.digest == recording.digest


def test_the_header_tells_what_the_samples_do(tmp_path: Path) -> None:
    recording = make(time=[0.0, 0.1, 0.4])
    recording.write(tmp_path / "r1.parquet")
    header = read_header(tmp_path / "r1.parquet")
    assert header.metadata == recording.metadata() and header.joints == recording.joints
    assert header.columns == tuple(name for name, _ in recording.columns())
    assert (header.rows, header.cells) == (3, 3 * len(header.columns))
    assert header.duration == pytest.approx(0.4) and header.rate == pytest.approx(1 / 0.2)


@pytest.mark.parametrize("time", [[0.0, 0.1, 0.1, 0.2], [0.0, None, 0.1, 0.2]])
def test_the_header_of_a_broken_clock_is_refused(tmp_path: Path, time: list[Any]) -> None:
    file = write_table(tmp_path / "broken.parquet", COLUMNS | {"time": time})
    with pytest.raises(InputError, match=r"broken\.parquet: column 'time', row"):
        read_header(file)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path, monkeypatch: Any) -> None:
    path = tmp_path / "r.parquet"
    make().write(path)

    def fail(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("pup.files.os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        make(notes="new").write(path)
    assert Recording.read(path).notes == ""
    assert list(tmp_path.iterdir()) == [path]


def test_loads_files_and_folders_sorted_by_id(tmp_path: Path) -> None:
    for name in ("b", "c", "a"):
        make(id=name).write(tmp_path / "set" / f"{name}.parquet")
    make(id="0").write(tmp_path / "z.parquet")
    found = load_recordings([tmp_path / "set", tmp_path / "z.parquet"])
    assert [recording.id for recording in found] == ["0", "a", "b", "c"]


def test_refuses_sets_that_are_empty_or_name_an_id_twice(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no \*\.parquet"):
        load_recordings([tmp_path])
    with pytest.raises(InputError, match="no recording given"):
        load_recordings([])
    for name in ("x", "y"):
        make(id="same").write(tmp_path / f"{name}.parquet")
    with pytest.raises(InputError, match=r"y\.parquet: id 'same' is also that of .*x\.parquet"):
        load_recordings([tmp_path])


def test_no_recording_takes_the_place_of_another_of_its_id(tmp_path: Path) -> None:
    """Two cuts that begin together are called alike."""
    whole = make(time=np.arange(3.0))
    with pytest.raises(InputError, match="two recordings have the id 'r1_0s'"):
        write_recordings([cut(whole, 0, 2), cut(whole, 0, 3)], tmp_path)
    assert not list(tmp_path.iterdir())


def test_hidden_files_are_no_recordings(tmp_path: Path) -> None:
    """A write that was killed leaves `.new-...`, and macOS a `._r1.parquet` beside each file."""
    make().write(tmp_path / "r1.parquet")
    make().write(tmp_path / ".new-x1y2" / "r1.parquet")
    (tmp_path / "._r1.parquet").write_bytes(b"\0\5\x16\7")
    assert [recording.id for recording in load_recordings([tmp_path])] == ["r1"]
    (tmp_path / "r1.parquet").unlink()
    with pytest.raises(InputError, match=r"no \*\.parquet in this folder; see"):
        load_recordings([tmp_path])


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_what_may_not_be_read_is_told_so(tmp_path: Path) -> None:
    make().write(tmp_path / "set" / "r1.parquet")
    for path, told in ((tmp_path / "set", "rights"), (tmp_path / "set" / "r1.parquet", "Permiss")):
        rights = path.stat().st_mode
        path.chmod(0)
        with pytest.raises(InputError, match=f"cannot be read.*{told}"):
            load_recordings([path])
        path.chmod(rights)


def test_a_folder_s_name_need_not_be_utf_8(tmp_path: Path) -> None:
    path = tmp_path / "log_\udcff" / "r1.parquet"
    make().write(path)
    assert Recording.read(path).digest == make().digest
    assert read_header(path).rows == 3


def test_a_file_that_is_given_twice_is_told(tmp_path: Path) -> None:
    make().write(tmp_path / "r1.parquet")
    with pytest.raises(InputError, match=r"r1\.parquet: is given twice; name it once"):
        load_recordings([tmp_path, tmp_path / "r1.parquet"])


SERVO = make(
    robot="servo_bench", joints=("servo",), target=np.zeros((3, 1)), position=np.zeros((3, 1))
)


def test_validate_wants_exactly_the_robots_joints_and_knobs() -> None:
    robot = RobotDescription.load("servo_bench")
    fitting = dataclasses.replace(SERVO, setup={"kp": 32})
    fitting.validate(robot)
    with pytest.raises(InputError, match="unknown joints a, b and joints servo not recorded"):
        make().validate(robot)
    with pytest.raises(InputError, match=r"recording 'r1': setup: 'colour' is no knob"):
        dataclasses.replace(fitting, setup={"colour": 1.0}).validate(robot)
    with pytest.raises(InputError, match="'r1' is of robot 'arm', not of 'servo_bench'"):
        dataclasses.replace(fitting, robot="arm").validate(robot)
    late = dataclasses.replace(fitting, target=[[np.nan], [np.nan], [1.0]])
    with pytest.raises(InputError, match="'target/servo' has no value before row 2"):
        late.validate(robot)


def test_validate_refuses_other_units_and_lets_a_robot_fall() -> None:
    """The servo may go from -3.14 to 3.14 rad, and may be turned a few times as far."""
    robot = RobotDescription.load("servo_bench")
    turned = np.array([[0.0], [np.nan], [12.0]])
    dataclasses.replace(SERVO, position=turned, time=[0.0, 0.4, 0.8]).validate(robot)
    for kind in ("target", "position"):
        far = dataclasses.replace(SERVO, **{kind: np.array([[0.0], [np.nan], [-57.3]])})
        with pytest.raises(InputError, match=rf"'{kind}/servo', row 2: -57\.3, .* degrees"):
            far.validate(robot)
    with pytest.raises(InputError, match=r"'r1': column 'time': rows are 30 s apart; .* in ms"):
        dataclasses.replace(SERVO, time=[0.0, 30.0, 60.0]).validate(robot)


@pytest.mark.parametrize("row", [1, 7, 19])
def test_validate_refuses_a_clock_that_jumped(row: int) -> None:
    """By an hour, as one that is set on the way; a bus that is silent for a while is none."""
    robot = RobotDescription.load("servo_bench")
    still = {"target": np.zeros((20, 1)), "position": np.zeros((20, 1))}

    def with_gap(gap: float) -> Recording:
        time = 0.02 * np.arange(20) + np.where(np.arange(20) < row, 0.0, gap)
        return dataclasses.replace(SERVO, **still, time=time)

    with_gap(5.0).validate(robot)
    with pytest.raises(InputError, match=rf"'time', row {row}: 3600\.02 s after .* clock jump"):
        with_gap(3600.0).validate(robot)


def test_validate_refuses_angles_that_begin_anew_after_a_turn() -> None:
    """A servo that passes the end of its encoder's turn, with a missing sample there."""
    robot = RobotDescription.load("servo_bench")
    angles = np.array([3.0, 3.08, np.nan, 3.24, 3.3])
    time = 0.02 * np.arange(5)
    told = {"time": time, "target": np.full((5, 1), 3.1)}
    dataclasses.replace(SERVO, **told, position=angles[:, None]).validate(robot)
    wrapped = (angles[:, None] + np.pi) % (2 * np.pi) - np.pi
    said = r"'position/servo', row 3: -3\.04, but 3\.08 only 0\.04 s before; .* unwrap"
    with pytest.raises(InputError, match=said):
        dataclasses.replace(SERVO, **told, position=wrapped).validate(robot)


@pytest.mark.parametrize(
    ("name", "values", "said"),
    [
        ("imu/pitch", [0.0, 12.5, 3.0], r"'imu/pitch', row 1: 12\.5, beyond 1\.67 rad; .* degrees"),
        ("imu/roll", [0.0, np.nan, -30.0], r"'imu/roll', row 2: -30, beyond 6\.28 rad; .* degrees"),
        ("velocity/servo", np.degrees([1.0, 1.0, 1.0]), "57 times what its positions .* deg/s"),
    ],
)
def test_validate_refuses_degrees_in_what_is_recorded_besides(
    name: str, values: list[float], said: str
) -> None:
    robot = RobotDescription.load("servo_bench")
    moving = dataclasses.replace(
        SERVO, position=np.array([[0.0], [0.1], [0.2]]), time=[0, 0.1, 0.2]
    )
    dataclasses.replace(moving, extras={name: np.radians(values)}).validate(robot)
    with pytest.raises(InputError, match=said):
        dataclasses.replace(moving, extras={name: values}).validate(robot)
