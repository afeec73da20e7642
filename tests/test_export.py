"""Exports, each read back by a reader of its format that is not ours."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from commandline import files, pup
from foreign_logs import ARM, write_ros
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer
from recordings import make
from rerun.chunk import McapReader, RrdReader
from rerun.experimental import LeRobotReader

from pup import exporters
from pup.errors import InputError
from pup.exporters import Take, export_takes, lerobot
from pup.importers import ImportOptions, import_recordings
from pup.physics.model import compile_model
from pup.recording import Recording, load_recordings
from pup.robot import RobotDescription

FULL = make(
    id="full",
    setup={"mass": 0.5},
    notes="é",
    repeat_of="r0",
    time=[-0.3, 0.1, 0.13, 0.4],
    target=[[0.0, 1.0], [np.nan, 0.5], [1.0, 0.5], [1.0, 0.0]],
    position=[[np.nan, 1.0], [0.1, 0.9], [0.2, np.nan], [0.4, 0.2]],
    extras={
        "velocity/b": [np.nan, 8.0, 6.0, 4.0],
        "voltage": [np.nan] * 4,
        "imu/gyro_y": [0.0, 0.1, 0.2, 0.3],
        "torque_enabled": [1.0, np.nan, 0.0, 0.0],
    },
)
"""What a recording can have: uneven time, missing samples, a column without any."""


def export(format: str, folder: Path, *recordings: Recording, **options: Any) -> Any:
    return export_takes(format, [Take(r) for r in recordings], folder, **options)


def curve(path: Path, entity: str, component: str = "Scalars:scalars") -> tuple[Any, Any]:
    """Times, s, and values of an entity in a Rerun file."""
    chunks = [
        chunk.to_record_batch()
        for chunk in RrdReader(path).stream().filter(content=entity).to_chunks()
        if not chunk.is_static
    ]
    time = np.concatenate([c.column("time").cast(pa.int64()).to_numpy() for c in chunks])
    values = [row[0] for c in chunks for row in c.column(component).to_pylist()]
    return time * 1e-9, np.array(values)


def test_mcap_comes_back_bit_by_bit(tmp_path: Path) -> None:
    export("mcap", tmp_path, FULL, make(id="other"))
    read = import_recordings("mcap", [tmp_path])
    assert [r.digest for r in read] == [FULL.digest, make(id="other").digest]
    assert read[0].joints == FULL.joints


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(*[st.none() | st.floats(allow_nan=False, allow_infinity=False)] * 5),
        min_size=2,
        max_size=6,
    ),
    st.floats(-1e6, 1e6),
)
def test_any_recording_comes_back_by_mcap(
    tmp_path_factory: pytest.TempPathFactory, rows: list[Any], start: float
) -> None:
    values = np.array(rows, dtype=np.float64)
    values[0, :4] = np.nan_to_num(values[0, :4])  # every joint has a sample
    recording = make(
        time=start + 0.1 * np.arange(len(rows)),
        target=values[:, :2],
        position=values[:, 2:4],
        extras={"voltage": values[:, 4]},
    )
    folder = tmp_path_factory.mktemp("any")
    export("mcap", folder, recording)
    (read,) = import_recordings("mcap", [folder])
    assert read.digest == recording.digest


def test_options_win_over_what_a_log_tells(tmp_path: Path) -> None:
    export("mcap", tmp_path, FULL)
    options = ImportOptions(robot="mine", motion="chirp", setup={"length": 2.0})
    (read,) = import_recordings("mcap", [tmp_path], options=options)
    assert (read.robot, read.motion) == ("mine", "chirp")
    assert read.setup == {"mass": 0.5, "length": 2.0}


def test_mcap_in_its_own_reader(tmp_path: Path) -> None:
    """Foxglove reads the schema: it knows `number`, and no list of types."""
    simulated = {"position/a": np.array([0.0, 1.0, 2.0, np.nan])}
    export_takes("mcap", [Take(FULL, simulated)], tmp_path)
    with (tmp_path / "full.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        found = [(s, c.topic, m, json.loads(m.data)) for s, c, m in reader.iter_messages()]
        (told,) = reader.iter_metadata()
    assert json.loads(told.metadata["json"])["id"] == "full"
    rows = [row for _, topic, _, row in found if topic == "/recording"]
    assert rows[0]["position"] == {"a": None, "b": 1.0}
    assert [m.log_time for _, t, m, _ in found if t == "/recording"] == [0, 4e8, 43e7, 7e8]
    replay = [row["position"]["a"] for _, topic, _, row in found if topic == "/simulated"]
    assert replay == [0.0, 1.0, 2.0, None]
    schema = json.loads(found[0][0].data)
    assert schema["properties"]["imu"]["properties"] == {"gyro_y": {"type": "number"}}
    assert McapReader(tmp_path / "full.mcap").info().message_count == 8
    (read,) = import_recordings("mcap", [tmp_path])
    assert read.digest == FULL.digest  # the replay is not taken for it


def test_refuses_metadata_that_is_none_of_ours(tmp_path: Path) -> None:
    for told in ("[]", '{"schema": 2}', "nonsense"):
        with (tmp_path / "log.mcap").open("wb") as file:
            writer = Writer(file)
            writer.start()
            writer.add_metadata("pup.recording", {"json": told})
            writer.finish()
        with pytest.raises(InputError, match=r"log\.mcap: .*(schema|JSON)"):
            import_recordings("mcap", [tmp_path])


def test_lerobot_in_rerun_s_reader(tmp_path: Path, leg_recordings: Path) -> None:
    recordings = load_recordings([leg_recordings])
    told = export("lerobot", tmp_path, *recordings, rate=50)
    assert (told["fps"], told["left_out"]) == (50, ())
    reader = LeRobotReader(tmp_path)
    assert (reader.version, reader.episodes()) == ("v3", [0, 1])
    first = recordings[0]
    elapsed = first.time - first.time[0]
    frames = np.arange(int(elapsed[-1] * 50) + 1) / 50
    (state,) = (
        c
        for c in reader.stream(0).to_chunks()
        if c.entity_path == "/observation.state" and not c.is_static
    )
    batch = state.to_record_batch()
    (values,) = (batch.column(n).to_pylist() for n in batch.schema.names if "scalars" in n)
    expected = [np.interp(frames, elapsed, column) for column in first.position.T]
    np.testing.assert_allclose(np.array(values), np.transpose(expected), atol=1e-6)


def test_lerobot_follows_its_layout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Version 3.0: what info.json promises is in the tables, episodes lie end to end."""
    monkeypatch.setattr(lerobot, "FILE_SIZE", 1e-6)  # a file for each
    others = [make(id=f"r{i}", motion=word) for i, word in enumerate(("walk", "step"))]
    told = export("lerobot", tmp_path, FULL, *others)
    assert told["left_out"] == ("velocity/b", "imu/gyro_y", "torque_enabled")
    info = json.loads((tmp_path / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["robot_type"], info["fps"]) == ("v3.0", "arm", 5)
    episodes = pd.read_parquet(tmp_path / "meta" / "episodes")
    tasks = pd.read_parquet(tmp_path / "meta" / "tasks.parquet")
    assert tasks.index.tolist() == ["step", "walk"]
    start = 0
    for number, episode in episodes.iterrows():
        place = {name: episode[f"data/{name}"] for name in ("chunk_index", "file_index")}
        table = pq.read_table(tmp_path / info["data_path"].format(**place))
        assert set(table.column_names) == set(info["features"])
        for name, feature in info["features"].items():
            value = pa.type_for_alias(feature["dtype"].replace("float32", "float"))
            width = feature["shape"][0]
            assert table.schema.field(name).type == (
                value if width == 1 else pa.list_(value, width)
            )
            assert feature["names"] is None or len(feature["names"]) == width
        assert len(table) == episode["length"]
        assert table["index"].to_pylist() == list(range(start, start + len(table)))
        assert episode["dataset_from_index"] == start
        assert set(table["episode_index"].to_pylist()) == {number}
        assert [tasks.index[i] for i in set(table["task_index"].to_pylist())] == [*episode["tasks"]]
        start = episode["dataset_to_index"]
        state = np.stack(table["observation.state"].to_numpy())
        np.testing.assert_allclose(episode["stats/observation.state/mean"], state.mean(axis=0))
    assert (info["total_frames"], info["total_episodes"], info["total_tasks"]) == (start, 3, 2)
    statistics = json.loads((tmp_path / "meta" / "stats.json").read_text())
    assert set(statistics) == set(info["features"])
    assert statistics["action"]["count"] == [start]


def test_lerobot_holds_commands_and_interpolates_readings(tmp_path: Path) -> None:
    export("lerobot", tmp_path, FULL, rate=10)
    table = pq.read_table(tmp_path / "data")
    action = np.stack(table["action"].to_numpy())
    state = np.stack(table["observation.state"].to_numpy())
    assert action[:, 0].tolist() == [0, 0, 0, 0, 0, 1, 1, 1]  # unknown at 0.4 s, 1 from 0.43 s
    assert table["observation.torque_enabled"].to_pylist() == [1, 1, 1, 1, 1, 0, 0, 0]
    elapsed = FULL.time - FULL.time[0]
    frames = np.arange(8) / 10
    np.testing.assert_allclose(
        state[:, 0], np.interp(frames, elapsed[1:], FULL.position[1:, 0]), atol=1e-6
    )
    assert "observation.voltage" not in table.column_names


def test_lerobot_turns_on_through_half_a_turn(tmp_path: Path) -> None:
    """What lies between 3.1 rad and -3.1 is half a turn, not 0."""
    yaw, unwrapped = [3.1, 3.14, -3.06], [3.1, 3.2, 3.6]
    rows = {"time": [0.0, 0.2, 0.4], "extras": {"imu/yaw": yaw, "imu/roll": unwrapped}}
    export("lerobot", tmp_path, make(**rows), rate=10)
    told = np.stack(pq.read_table(tmp_path / "data")["observation.imu"].to_numpy())
    between = (3.14 - 3.06 + 2 * np.pi) / 2 - 2 * np.pi
    np.testing.assert_allclose(told[:, 0], [3.1, 3.12, 3.14, between, -3.06], atol=1e-6)
    np.testing.assert_allclose(told[:, 1], [3.1, 3.15, 3.2, 3.4, 3.6], atol=1e-6)


def test_rerun_file_has_the_recording_and_its_replay(tmp_path: Path) -> None:
    simulated = {"position/a": np.array([0.0, 1.0, 2.0, np.nan])}
    export_takes("rrd", [Take(FULL, simulated)], tmp_path)
    path = tmp_path / "full.rrd"
    reader = RrdReader(path)
    (recording,) = reader.recordings()
    assert (recording.application_id, recording.recording_id) == ("pup", FULL.digest)
    assert len(reader.blueprints()) == 1
    elapsed = FULL.time - FULL.time[0]
    for entity, values in (
        ("/position/a/target", FULL.target[:, 0]),
        ("/position/a/real", FULL.position[:, 0]),
        ("/position/a/simulated", simulated["position/a"]),
        ("/velocity/b/real", FULL.extras["velocity/b"]),
        ("/imu/gyro_y/real", FULL.extras["imu/gyro_y"]),
    ):
        time, seen = curve(path, entity)
        known = ~np.isnan(values)
        np.testing.assert_allclose(time, elapsed[known], atol=1e-9)
        np.testing.assert_array_equal(seen, values[known])


def test_rerun_bodies_stand_where_mujoco_puts_them(tmp_path: Path, leg_recordings: Path) -> None:
    robot = RobotDescription.load("darwin_leg")
    (recording, _) = load_recordings([leg_recordings], robot)
    export("rrd", tmp_path, recording, robot=robot)
    model = compile_model(robot, recording.support).compiled
    from mujoco import MjData, mj_kinematics

    data = MjData(model)
    data.qpos[:] = recording.position[-1]
    mj_kinematics(model, data)
    foot = model.nbody - 1
    entity = f"/robot/real/{model.body(foot).name}"
    path = tmp_path / f"{recording.id}.rrd"
    _, place = curve(path, entity, "Transform3D:translation")
    _, turn = curve(path, entity, "Transform3D:quaternion")
    np.testing.assert_allclose(place[-1], data.xpos[foot], atol=1e-6)
    np.testing.assert_allclose(turn[-1], np.roll(data.xquat[foot], -1), atol=1e-6)


@pytest.mark.parametrize("format", exporters.FORMATS)
def test_the_verb_replays_beside(tmp_path: Path, leg_recordings: Path, format: str) -> None:
    out = tmp_path / "out"
    done = pup(
        *("export", format, leg_recordings, "--out", out, "--json"),
        *("--robot", "darwin_leg", "--cores", 1),
    )
    assert done.code == 0, done.err
    made = done.json()["files"]
    if format == "lerobot":
        assert made == [str(out)]
        assert "observation.simulated_state" in (out / "meta" / "info.json").read_text()
        return
    assert made == [str(out / f"step_{size}.{format}") for size in ("0.1", "0.3")]
    if format == "rrd":
        time, values = curve(Path(made[0]), "/position/l_knee/simulated")
        recording = Recording.read(leg_recordings / "step_0.1.parquet")
        real = recording.position[:, recording.joints.index("l_knee")]
        assert len(time) == len(real)
        assert np.abs(values - real).max() < 0.1  # another servo, the same commands


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("pickle",), "lerobot, mcap, rrd"),
        (("rrd", "--fps", 30), "keeps the times"),
        (("lerobot", "--fps", 0), "--fps"),
        (("mcap", "--bounds", "bounds.json"), "needs --robot"),
        (("mcap", "--robot", "servo_bench"), "unknown joints"),
    ],
)
def test_what_cannot_be_exported_is_told_and_leaves_nothing(
    tmp_path: Path, leg_recordings: Path, options: tuple[object, ...], told: str
) -> None:
    format, *rest = options
    out = tmp_path / "new" / "out"
    done = pup("export", format, leg_recordings, "--out", out, *rest)
    assert done.code == 2
    assert told in done.err.splitlines()[-1]
    assert not out.parent.exists()


def test_a_data_set_is_of_one_robot_and_never_written_over(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="arm, other"):
        export("lerobot", tmp_path / "a", make(), make(id="r2", robot="other"))
    with pytest.raises(InputError, match="one frame"):
        export("lerobot", tmp_path / "a", make(), rate=1)
    assert files(tmp_path) == {}
    export("lerobot", tmp_path / "a", make())
    before = files(tmp_path)
    with pytest.raises(InputError, match="data/ already"):
        export("lerobot", tmp_path / "a", make(id="r2"))
    assert files(tmp_path) == before


@pytest.mark.parametrize("format", exporters.FORMATS)
def test_two_recordings_of_one_id_are_refused(tmp_path: Path, format: str) -> None:
    """Of robots of their own, as a notebook may hold them: one file would hold but one of them."""
    folder = tmp_path / "new"
    with pytest.raises(InputError, match="two recordings have the id 'full'; each needs its own"):
        export(format, folder, FULL, make(), replace(FULL, robot="leg"))
    assert not folder.exists()


def test_somebody_s_own_log_is_never_written_over(tmp_path: Path) -> None:
    """The log that a recording was imported from has its name."""
    log = write_ros(tmp_path / "walk.mcap")
    before = log.read_bytes()
    (recording,) = import_recordings("mcap", [log], options=ARM)
    with pytest.raises(InputError, match=r"walk\.mcap: is not of `pup export`; use another"):
        export("mcap", tmp_path, recording)
    assert files(tmp_path) == {"walk.mcap": before}
    for notes in ("", "again"):
        export("mcap", tmp_path / "out", replace(recording, notes=notes))
    assert import_recordings("mcap", [tmp_path / "out"])[0].notes == "again"


def test_the_usual_rate_is_that_of_the_readings(tmp_path: Path) -> None:
    """Commands that are sent 2 ms before each reading stand in rows of their own."""
    read = np.arange(20) * 0.02 + 0.002
    time = np.sort(np.append(read - 0.002, read))
    position = np.where(np.isin(time, read), 0.5, np.nan)
    both = {"target": np.zeros((40, 2)), "position": np.stack([position, position], axis=1)}
    assert export("lerobot", tmp_path, make(time=time, **both))["fps"] == 50


def test_a_replay_that_broke_down_is_left_out_of_a_data_set(tmp_path: Path) -> None:
    """The format knows no missing samples, and its last pose held on would be none of it."""
    replay = {f"position/{name}": np.zeros(4) for name in FULL.joints}
    for name, end in (("whole", 0.0), ("broken", np.nan)):
        simulated = replay | {"position/b": np.array([0.0, 0.0, end, end])}
        told = export_takes("lerobot", [Take(FULL, simulated)], tmp_path / name)
        info = json.loads((tmp_path / name / "meta" / "info.json").read_text())
        assert ("observation.simulated_state" in info["features"]) == (name == "whole")
        assert ("observation.simulated_state" in told["left_out"]) == (name == "broken")


def test_a_robot_of_which_no_row_is_whole_is_not_drawn(tmp_path: Path) -> None:
    """Joints that are read in turn; a replay may break down as soon."""
    robot = RobotDescription.load("darwin_leg")
    count = len(robot.joints)
    turns = np.where(np.arange(12)[:, None] % count == np.arange(count), 0.1, np.nan)
    recording = make(
        robot="darwin_leg",
        joints=robot.joint_names,
        time=np.arange(12) * 0.02,
        target=np.zeros((12, count)),
        position=turns,
    )
    export("rrd", tmp_path, recording, robot=robot)
    time, _ = curve(tmp_path / "r1.rrd", f"/position/{robot.joint_names[1]}/real")
    np.testing.assert_allclose(time, np.arange(1, 12, count) * 0.02)


@pytest.mark.parametrize("format", exporters.FORMATS)
def test_a_folder_s_name_that_is_not_utf_8_is_told_or_taken(tmp_path: Path, format: str) -> None:
    out = tmp_path / "\udcff"
    if format == "mcap":
        assert len(export(format, out, make())["files"]) == 1
        return
    with pytest.raises(InputError, match="its name is not UTF-8; use another folder"):
        export(format, out, make())
    assert not out.exists()


def test_an_error_in_the_middle_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All files or none: the first is done when the second fails."""
    broken = make(id="broken")
    object.__setattr__(broken, "time", None)
    with pytest.raises(TypeError):
        export("mcap", tmp_path, make(), broken)
    assert files(tmp_path) == {}


def test_without_rerun_a_line_says_what_to_install(
    tmp_path: Path, leg_recordings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporters, "find_spec", lambda name: None)
    done = pup("export", "rrd", leg_recordings, "--out", tmp_path / "out")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert "constraints.txt '.[export]'" in done.err
    assert pup("export", "mcap", leg_recordings, "--out", tmp_path / "out").code == 0
