"""Rerun: an `.rrd` that the Rerun viewer opens, real against simulated over time.

Column `position/l_knee` is the entity `/position/l_knee/real`, beside it its command in
`/position/l_knee/target` and its replay in `/position/l_knee/simulated`. With a robot its
bodies are drawn too, below `/robot/real` and `/robot/simulated`. The viewer is told to show one
plot per joint.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from pup.exporters.common import Array, Take
from pup.exporters.rerun_bodies import TIMELINE, draw_bodies
from pup.robot import RobotDescription

APPLICATION = "pup"
COLOURS = {"target": (150, 150, 150), "real": (31, 119, 180), "simulated": (255, 127, 14)}
FILLS = {"real": "solid", "simulated": "majorwireframe"}
KINDS = ("velocity", "current", "load", "temperature", "imu")


def write(take: Take, path: Path, robot: RobotDescription | None = None) -> None:
    """Write one recording.

    Args:
      take: the recording and its replay.
      path: of the file.
      robot: whose bodies are drawn; None for plots only.
    """
    recording = take.recording
    stream = rr.RecordingStream(APPLICATION, recording_id=recording.digest, send_properties=True)
    with stream:
        stream.save(path, default_blueprint=_layout(take, robot is not None))
        stream.send_recording_name(recording.id)
        told = {key: str(value) for key, value in recording.metadata().items()}
        stream.send_property("recording", rr.AnyValues(**told))
        time = recording.time - recording.time[0]
        for name, source, values in _series(take):
            _send(stream, name, source, time, values)
        if robot is not None:
            for source, columns in _sources(take):
                look = {"colors": [COLOURS[source]], "fill_mode": FILLS[source]}
                above = ("robot", source)
                draw_bodies(stream, robot, recording.support, columns, above, look)


def _series(take: Take) -> Iterator[tuple[str, str, Array]]:
    """Name, source and values of every curve."""
    for name, values in take.recording.columns():
        kind, _, joint = name.partition("/")
        if kind == "target":
            yield f"position/{joint}", "target", values
        elif kind != "time":
            yield name, "real", values
    for name, values in take.simulated.items():
        yield name, "simulated", values


def _send(stream: rr.RecordingStream, name: str, source: str, time: Array, values: Array) -> None:
    path = rr.new_entity_path([*name.split("/", 1), source])
    joined = "StepAfter" if source == "target" else None  # commands are held
    look = rr.SeriesLines(colors=COLOURS[source], names=source, interpolation_mode=joined)
    stream.log(path, look, static=True)
    known = ~np.isnan(values)
    stream.send_columns(
        path,
        indexes=[rr.TimeColumn(TIMELINE, duration=time[known])],
        columns=rr.Scalars.columns(scalars=values[known]),
    )


def _sources(take: Take) -> Iterator[tuple[str, dict[str, Array]]]:
    yield "real", dict(take.recording.columns())
    if take.simulated:
        yield "simulated", {"time": take.recording.time, **take.simulated}


def _layout(take: Take, bodies: bool) -> rrb.Blueprint:
    """A plot per joint, the other columns in tabs, the bodies beside them."""
    names = [name for name, _ in take.recording.columns()]
    joints = [_view(f"position/{joint}") for joint in take.recording.joints]
    tabs: list[rrb.Container | rrb.View] = [rrb.Grid(*joints, name="joints")]
    for kind in KINDS:
        parts = [name for name in names if name.startswith(f"{kind}/")]
        if parts:
            tabs.append(rrb.Grid(*(_view(name) for name in parts), name=kind))
    tabs += [_view(name) for name in ("voltage", "torque_enabled") if name in names]
    plots = rrb.Tabs(*tabs)
    if not bodies:
        return rrb.Blueprint(plots)
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/robot", name="robot"), plots, column_shares=[1, 2]
        )
    )


def _view(name: str) -> rrb.TimeSeriesView:
    path = rr.new_entity_path(name.split("/", 1))
    return rrb.TimeSeriesView(origin=path, name=name.rpartition("/")[2])
