"""Real against simulated motion: the panels of the report and the plots of `pup replay`."""

from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pup.files import write_atomic
from pup.physics.simulator import Trajectories
from pup.recording import Recording
from pup.robot import RobotDescription
from pup.sysid.accuracy import Accuracy, JointUnits, accuracy
from pup.sysid.figures import INK, SOFT, as_png, as_svg, drawing_style, line_style, new_figure
from pup.sysid.html import Drawing
from pup.sysid.loss import ReplayLoss
from pup.sysid.wording import counted, thousandths

Array = NDArray[np.float64]

ANGLES = ("torso roll", "torso pitch")
DOTTED = 120
"""Up to this many samples a measurement is drawn with a dot at each."""
LINE_WIDTH = 1.3
ROUND = (1, 2, 5, 10)
"""Steps between the numbers at an axis: others have a digit more than there is room for."""
MOVED = 0.1
"""Joints commanded over at least this share of the widest command count as moved."""


@dataclass(frozen=True)
class Panel:
    """One signal of one recording, measured and simulated.

    Attributes:
      rank: why it is shown: `worst`, `median` or `best`; nothing where it is the only one.
      recording: its recording.
      signal: a joint's name or one of ANGLES.
      time: from the recording's start, shape (n_ticks,), s.
      target: commands, shape (n_ticks,); None for the torso.
      measured: shape (n_ticks,).
      simulated: label to trajectory, shape (n_ticks,).
      errors: label to RMSE.
    """

    rank: str
    recording: Recording
    signal: str
    time: Array
    target: Array | None
    measured: Array
    simulated: dict[str, Array]
    errors: dict[str, float]


def by_motion(recordings: Sequence[Recording], position_unit: str) -> dict[str, list[int]]:
    """Recordings by motion type and support, steps also by their size.

    Args:
      recordings: whose indices are returned.
      position_unit: of a step's size, for the heading.

    Returns:
      Heading to indices, sorted.
    """
    groups: dict[tuple[str, float, str], list[int]] = defaultdict(list)
    for i, recording in enumerate(recordings):
        size = _step_size(recording) if recording.motion == "step" else 0.0
        groups[recording.motion, size, recording.support].append(i)
    headings = {}
    for (motion, size, support), members in sorted(groups.items()):
        of = f" of up to {size:g} {position_unit}" if size else ""
        headings[f"{motion}{of}, {support} ({counted(len(members), 'recording')})"] = members
    return headings


def _step_size(recording: Recording) -> float:
    """The largest jump of a command, to one digit."""
    sent = [column[~np.isnan(column)] for column in recording.target.T]
    jumps = np.concatenate([np.abs(np.diff(column)) for column in sent])
    return float(f"{jumps.max(initial=0.0):.1g}")


class Overlays:
    """Picks and draws panels of a set of replays.

    Args:
      robot: the robot.
      loss: the measurements.
      replays: label to the trajectories of one candidate.
      accuracies: label to their accuracy.
      units: of the joint positions.
    """

    def __init__(
        self,
        robot: RobotDescription,
        loss: ReplayLoss,
        replays: Mapping[str, Trajectories],
        accuracies: Mapping[str, Accuracy],
        units: JointUnits,
    ) -> None:
        self.robot = robot
        self.loss = loss
        self.replays = replays
        self.accuracies = accuracies
        self.units = units

    def joint_panels(self, members: Sequence[int], label: str) -> list[Panel]:
        """The worst, the median and the best joint of some recordings.

        Joints are ranked by their error over all of the recordings; each is shown in the recording
        where its error is the median one. Joints told to stay where they are would always be the
        best, so they rank only as the worst. A joint that ranks alone is shown in the recordings
        with its largest, median and smallest error.

        Args:
          members: indices of the recordings.
          label: of the replay that ranks them.
        """
        cells = self.accuracies[label].cells[list(members)]
        error = np.sqrt((cells**2).mean(axis=0))
        moved = np.max([self._commanded(i) for i in members], axis=0)
        ranked = np.flatnonzero((error == error.max()) | (moved >= MOVED * moved.max()))
        panels = []
        if len(ranked) == 1:
            only = int(ranked[0])
            for rank, at in _worst_median_best(cells[:, only]):
                panels.append(self.joint_panel(members[at], only, rank))
            return panels
        for rank, at in _worst_median_best(error[ranked]):
            joint = int(ranked[at])
            shown = np.argsort(cells[:, joint], kind="stable")[len(members) // 2]
            panels.append(self.joint_panel(members[shown], joint, rank))
        return panels

    def _commanded(self, i: int) -> Array:
        """How far each joint is told to move in a recording, shape (n_joints,)."""
        recording = self.loss.recordings[i]
        order = [recording.joints.index(name) for name in self.robot.joint_names]
        target = recording.target[:, order]
        return np.asarray(np.nanmax(target, axis=0) - np.nanmin(target, axis=0))

    def joint_panel(self, i: int, joint: int, rank: str = "") -> Panel:
        """One joint in one recording."""
        recording, part = self.loss.recordings[i], self.loss.ticks[i]
        name = self.robot.joint_names[joint]
        return Panel(
            rank,
            recording,
            name,
            recording.time - recording.time[0],
            recording.target[:, recording.joints.index(name)],
            self.loss.position[part, joint],
            {label: t.position[0, part, joint] for label, t in self.replays.items()},
            {label: float(a.cells[i, joint]) for label, a in self.accuracies.items()},
        )

    def tilt_panels(self, members: Sequence[int], label: str) -> list[Panel]:
        """Torso angles of the recordings with the worst, the median and the best tilt.

        Args:
          members: indices of the recordings; those without an angle are passed over.
          label: of the replay that ranks them.
        """
        panels = []
        for angle in range(len(ANGLES)):
            error = self.accuracies[label].tilt[list(members), angle]
            read = np.flatnonzero(~np.isnan(error))
            for rank, at in _worst_median_best(error[read]):
                panels.append(self.tilt_panel(members[int(read[at])], angle, rank))
        return panels

    def tilt_panel(self, i: int, angle: int, rank: str = "") -> Panel:
        """One torso angle in one recording."""
        recording, part = self.loss.recordings[i], self.loss.ticks[i]
        return Panel(
            rank,
            recording,
            ANGLES[angle],
            recording.time - recording.time[0],
            None,
            self.loss.tilt[part, angle],
            {label: t.tilt[0, part, angle] for label, t in self.replays.items()},
            {label: float(a.tilt[i, angle]) for label, a in self.accuracies.items()},
        )

    def draw(self, panels: Sequence[Panel]) -> Iterator[tuple[Panel, Drawing]]:
        """Draw panels side by side: the same height of the axis stands for the same angle."""
        height = max(_span(panel)[1] for panel in panels)
        for panel in panels:
            unit = "rad" if panel.signal in ANGLES else self.units.position
            yield panel, as_svg(_small(panel, list(self.replays), height, unit))


def _worst_median_best(error: Array) -> list[tuple[str, int]]:
    """Which entries to show, largest error first; each at most once."""
    order = [int(i) for i in np.argsort(-error, kind="stable")]
    if len(order) < 2:
        return [("", at) for at in order]
    picks = {"worst": 0, "median": len(order) // 2, "best": len(order) - 1}
    if len(order) == 2:
        del picks["median"]
    return [(rank, order[at]) for rank, at in picks.items()]


def _span(panel: Panel) -> tuple[float, float]:
    """Middle and height of what a panel shows."""
    shown = [panel.measured, *panel.simulated.values()]
    if panel.target is not None:
        shown.append(panel.target)
    values = np.concatenate(shown)
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 0.01
    return float(values.max() + values.min()) / 2, max(float(np.ptp(values)), 0.01)


def _small(panel: Panel, labels: Sequence[str], height: float, unit: str) -> Any:
    """The figure of a panel; its axes have a fixed place, so that panels line up."""
    figure = new_figure(3.0, 2.0, fixed=True)
    axes = figure.add_axes((0.255, 0.21, 0.7, 0.76))
    draw_panel(axes, panel, labels)
    middle = _span(panel)[0]
    axes.set_ylim(middle - 0.55 * height, middle + 0.55 * height)
    axes.set_xlabel("time [s]")
    axes.set_ylabel(f"{'position' if unit != 'rad' else 'angle'} [{unit}]")
    return figure


def draw_panel(axes: Any, panel: Panel, labels: Sequence[str]) -> None:
    """Draw command, measurement and simulations into axes."""
    if panel.target is not None:
        sent = ~np.isnan(panel.target)
        axes.plot(
            panel.time[sent], panel.target[sent], color=SOFT, linewidth=0.8, drawstyle="steps-post"
        )
    read = ~np.isnan(panel.measured)
    marker = "." if read.sum() <= DOTTED else ""
    axes.plot(
        panel.time[read], panel.measured[read], color=INK, linewidth=LINE_WIDTH, marker=marker,
        markersize=4,
    )  # fmt: skip
    for label, values in panel.simulated.items():
        colour, dash = line_style(label, labels)
        axes.plot(panel.time, values, color=colour, linestyle=dash, linewidth=LINE_WIDTH)
    axes.locator_params(axis="y", nbins=5, steps=ROUND)
    axes.grid()


def write_overlays(
    folder: Path,
    robot: RobotDescription,
    recordings: Sequence[Recording],
    trajectories: Trajectories,
    loss: ReplayLoss,
    label: str = "simulated",
) -> tuple[Path, ...]:
    """Write one picture per recording: every joint, real against simulated.

    Args:
      folder: gets `<recording id>.png`.
      robot: the robot.
      recordings: what was replayed.
      trajectories: the replay of one candidate.
      loss: the same recordings' measurements.
      label: what the pictures call the simulation.

    Returns:
      The files, in the order of the recordings.
    """
    measures = accuracy(loss, trajectories)
    units = JointUnits.of(robot, recordings)
    overlays = Overlays(robot, loss, {label: trajectories}, {label: measures}, units)
    paths = []
    with drawing_style():
        for i, recording in enumerate(recordings):
            path = folder / f"{recording.id}.png"
            write_atomic(path, _picture(overlays, i, label))
            paths.append(path)
    return tuple(paths)


def _picture(overlays: Overlays, i: int, label: str) -> bytes:
    """All joints of one recording, and the torso where it was measured, as PNG."""
    measures, units = overlays.accuracies[label], overlays.units
    panels = [overlays.joint_panel(i, joint) for joint in range(len(overlays.robot.joints))]
    panels += [overlays.tilt_panel(i, a) for a in (0, 1) if not np.isnan(measures.tilt[i, a])]
    columns = min(len(panels), 5)
    rows = -(-len(panels) // columns)
    width, height = max(2.4 * columns, 6.0), 1.8 * rows + 1.0
    figure = new_figure(width, height, fixed=True)
    grid = figure.subplots(rows, columns, squeeze=False)
    figure.subplots_adjust(
        0.75 / width, 0.5 / height, 1 - 0.1 / width, 1 - 0.75 / height, wspace=0.3, hspace=0.35
    )
    for axes, panel in zip(grid.flat, panels, strict=False):
        draw_panel(axes, panel, [label])
        axes.set_title(
            f"{panel.signal}  {thousandths(panel.errors[label])}", fontsize=9, loc="left"
        )
        axes.tick_params(labelsize=8)
    for axes in grid.flat[len(panels) :]:
        axes.set_visible(False)
    recording = overlays.loss.recordings[i]
    diverged = "; the simulation broke down" if measures.diverged[i] else ""
    total = units.words(float(measures.per_recording[i]))
    figure.suptitle(
        f"{recording.id}: RMSE {total}{diverged}\n"
        f"per joint in {units.small}; grey: command, black: measured, colour: {label}",
        fontsize=10, ha="left", x=0.01, y=1 - 0.1 / height,
    )  # fmt: skip
    figure.supxlabel("time [s]", fontsize=9)
    figure.supylabel(f"position [{units.position}]", fontsize=9)
    return as_png(figure)
