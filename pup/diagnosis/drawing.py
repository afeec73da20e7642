"""A robot drawn from its MJCF, with the places of the findings in colour.

The outlines of its geoms are projected onto a plane; nothing is rendered.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from matplotlib.colors import LogNorm, to_rgb
from matplotlib.patches import Polygon
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from pup.diagnosis.figures import MAP, misfit_bar
from pup.physics.model import FLOOR, compile_model
from pup.physics.terms import Place
from pup.robot import RobotDescription
from pup.sysid.figures import BLUE, GREEN, INK, PURPLE, SOFT, WIDTH, as_svg, new_figure
from pup.sysid.html import Drawing

Array = NDArray[np.float64]

MARKS = (BLUE, GREEN, PURPLE, "#56B4E9", INK, "#882255")
"""Colours of the findings, in their order; the misfit's colours are others."""
READABLE = 4.5
"""Contrast of small text that everybody can read (WCAG 2, level AA)."""
VIEWS = {"from the front": (1, 2), "from the side": (0, 2), "from above": (0, 1)}
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
DIRECTIONS = np.array(
    [
        [np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)]
        for a in np.linspace(0, 2 * np.pi, 24, endpoint=False)
        for b in np.linspace(-np.pi / 2, np.pi / 2, 9)
    ]
)


class Pose:
    """A robot standing still: where its joints, bodies and geoms are.

    Args:
      robot: the robot.
      support: what holds it.
    """

    def __init__(self, robot: RobotDescription, support: str) -> None:
        self.robot = robot
        compiled = compile_model(robot, support)
        self.model = compiled.compiled
        data = mujoco.MjData(self.model)
        pose = robot.poses.get("stand") or next(iter(robot.poses.values()), None)
        if pose is not None:
            data.qpos[compiled.qpos] = pose
        mujoco.mj_forward(self.model, data)
        ids = [self.model.joint(name).id for name in robot.joint_names]
        self.anchors = np.array(data.xanchor[ids])
        self.axes = np.array(data.xaxis[ids])
        self.parents = [int(b) for b in self.model.body_parentid]
        self.bodies = [int(self.model.jnt_bodyid[i]) for i in ids]
        self.shapes: list[tuple[str, Array]] = []
        for geom in range(self.model.ngeom):
            points = _points(self.model, geom)
            if points is None or self.model.geom(geom).name == FLOOR:
                continue
            turn = data.geom_xmat[geom].reshape(3, 3)
            body = self.model.body(self.model.geom_bodyid[geom]).name
            self.shapes.append((body, points @ turn.T + data.geom_xpos[geom]))
        self.imu = None
        if robot.imu_site:
            self.imu = np.array(data.site_xpos[self.model.site(robot.imu_site).id])

    def links(self) -> list[tuple[Array, Array]]:
        """Lines from each joint to the one that carries it, and from the last to what it moves."""
        lines = []
        carrying = {self.mover(self.parents[body]) for body in self.bodies}
        for name, points in self.shapes:
            mover = self.mover(self.model.body(name).id)
            if mover and mover not in carrying:
                anchor = self.anchors[self.bodies.index(mover)]
                lines.append((anchor, points.mean(axis=0)))
        for i, body in enumerate(self.bodies):
            above = self.mover(self.parents[body])
            if above:
                lines.append((self.anchors[self.bodies.index(above)], self.anchors[i]))
        return lines

    def mover(self, body: int) -> int:
        """The body with a joint that carries a body, 0 for none."""
        while body and body not in self.bodies:
            body = self.parents[body]
        return body

    def corners(self) -> Array:
        """All points that a view has to hold."""
        return np.vstack([self.anchors, *(points for _, points in self.shapes)])

    def views(self) -> dict[str, tuple[int, int]]:
        """Views that show something: a robot that moves in one plane is seen across it."""
        turning = [
            self.model.joint(name).type[0] == mujoco.mjtJoint.mjJNT_HINGE
            for name in self.robot.joint_names
        ]
        if all(turning) and np.abs(self.axes).min(axis=0).max() > 0.99:
            across = int(np.argmax(np.abs(self.axes).min(axis=0)))
            return {n: plane for n, plane in VIEWS.items() if across not in plane}
        if not any(turning):
            return {"from the side": VIEWS["from the side"]}
        return {n: VIEWS[n] for n in ("from the front", "from the side")}

    def where(self, place: Place) -> Array | None:
        """The points of a place, shape (n, 3); None for what has no point of its own."""
        names = self.robot.joint_names
        if place.kind == "joint":
            return np.asarray(self.anchors[[names.index(place.name)]])
        if place.kind == "group":
            members = [joint.group == place.name for joint in self.robot.joints]
            return np.asarray(self.anchors[members])
        if place.kind in ("body", "foot"):
            body = self.model.body(place.name).id
            points = [p for b, p in self.shapes if b == place.name]
            if points:
                return np.asarray(np.mean(np.vstack(points), axis=0, keepdims=True))
            if body in self.bodies:
                return np.asarray(self.anchors[[self.bodies.index(body)]])
        if place.kind == "sensor":
            return None if self.imu is None else self.imu[None]
        return None


def draw_robot(
    robot: RobotDescription,
    support: str,
    places: Sequence[Place],
    misfits: Mapping[str, float],
) -> Drawing:
    """The robot's outline from one or two sides.

    Args:
      robot: the robot.
      support: what held it in the recordings.
      places: of the findings, in their order.
      misfits: errors of the nominal fit by joint, in units of the noise.
    """
    pose = Pose(robot, support)
    views = pose.views()
    spans = [np.ptp(pose.corners()[:, list(plane)], axis=0) for plane in views.values()]
    shares = [max(span[0], 0.35 * span[1]) for span in spans]
    scale = (WIDTH - 0.5) / max(sum(shares), 1e-6)
    tallest = 3.6 if len(views) > 1 else 2.4
    height = float(np.clip(scale * max(span[1] for span in spans), 1.2, tallest))
    figure = new_figure(WIDTH, height + 1.05)
    axes = figure.subplots(1, len(views), squeeze=False, width_ratios=shares)[0]
    norm = LogNorm(1.0, max(5.0, *misfits.values())) if misfits else LogNorm(1.0, 5.0)
    for one, (name, plane) in zip(axes, views.items(), strict=True):
        _draw_view(one, pose, plane, places, misfits, norm)
        one.set_xlabel(name, fontsize=8, color=SOFT)
    misfit_bar(figure, axes, norm, height)
    return as_svg(figure)


def ink_on(colour: str) -> str:
    """The colour of text on another: white where that can be read, else ink."""
    parts = np.array(to_rgb(colour))
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    luminance = float(linear @ (0.2126, 0.7152, 0.0722))
    return "white" if 1.05 / (luminance + 0.05) >= READABLE else INK


def _draw_view(
    axes: Any,
    pose: Pose,
    plane: tuple[int, int],
    places: Sequence[Place],
    misfits: Mapping[str, float],
    norm: LogNorm,
) -> None:
    flat = list(plane)
    marked = [(place, MARKS[i % len(MARKS)]) for i, place in enumerate(places)]
    whole = next((c for p, c in marked if p.kind in ("bus", "robot")), None)
    for body, points in pose.shapes:
        hull = _hull(points[:, flat])
        own = next((c for p, c in marked if p.kind in ("body", "foot") and p.name == body), None)
        axes.add_patch(
            Polygon(
                hull, facecolor=own or "#e1e5e9", edgecolor=own or whole or "#858f98",
                linewidth=1.6 if own or whole else 0.7, alpha=0.55,
            )
        )  # fmt: skip
    for start, end in pose.links():
        axes.plot(*np.array([start, end])[:, flat].T, color="#7d868f", linewidth=2.4, zorder=3)
    for anchor, name in zip(pose.anchors, pose.robot.joint_names, strict=True):
        value = misfits.get(name, np.nan)
        face = MAP(norm(max(value, 1.0))) if np.isfinite(value) else "white"
        axes.plot(
            *anchor[flat], "o", markersize=6.5, color=face, markeredgecolor=INK,
            markeredgewidth=0.7, zorder=4,
        )  # fmt: skip
    _mark(axes, pose, plane, marked)
    corners = pose.corners()
    low, high = corners[:, flat].min(axis=0), corners[:, flat].max(axis=0)
    pad = 0.07 * float(np.ptp(corners, axis=0).max())
    axes.set_xlim(low[0] - pad, high[0] + pad)
    axes.set_ylim(low[1] - pad, high[1] + pad)
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    axes.spines[:].set_visible(False)


def _mark(
    axes: Any,
    pose: Pose,
    plane: tuple[int, int],
    marked: Sequence[tuple[Place, str]],
) -> None:
    """A ring and a number at each place; the floor gets a line."""
    flat = list(plane)
    bottom = float(pose.corners()[:, 2].min())
    used: list[Array] = []
    for number, (place, colour) in enumerate(marked, start=1):
        points = pose.where(place)
        label = f"{number}"
        if place.kind == "ground" and 2 in plane:
            axes.axhline(bottom, color=colour, linewidth=4, zorder=2)
        if points is None:
            at = (0.03, 0.95 - 0.1 * (number - 1)) if place.kind != "ground" else (0.03, 0.08)
            axes.text(
                *at, label, transform=axes.transAxes, color=ink_on(colour), weight="bold",
                fontsize=8,
                bbox={"boxstyle": "circle,pad=0.25", "facecolor": colour, "edgecolor": "none"},
            )  # fmt: skip
            continue
        seen = points[:, flat]
        taken = sum(bool(np.allclose(seen[0], other, atol=0.01)) for other in used)
        used.append(seen[0])
        axes.plot(
            *seen.T, "o", markersize=15 + 7 * taken, markerfacecolor="none",
            markeredgecolor=colour, markeredgewidth=2.6, zorder=5,
        )  # fmt: skip
        axes.annotate(
            label, seen[0], xytext=(17 + 18 * taken, 11), textcoords="offset points",
            color=ink_on(colour), weight="bold", fontsize=8, zorder=6,
            bbox={"boxstyle": "circle,pad=0.25", "facecolor": colour, "edgecolor": "none"},
        )  # fmt: skip


def _points(model: mujoco.MjModel, geom: int) -> Array | None:
    """Points around a geom in its own frame; None for what has no outline, such as a plane."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return np.asarray(CORNERS * size)
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        radii = np.where(size > 0, size, size[0])
        return np.asarray(DIRECTIONS * radii)
    if kind in (mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER):
        ball = DIRECTIONS * size[0]
        if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
            ball = ball * [1.0, 1.0, 0.0]
        along = [0.0, 0.0, size[1]]
        return np.vstack([ball + along, ball - along])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        return np.asarray(model.mesh_vert[first : first + count], dtype=float)
    return None


def _hull(points: Array) -> Array:
    """The outline of some points in the plane."""
    try:
        return np.asarray(points[ConvexHull(points).vertices])
    except QhullError:
        return points[[np.argmin(points.sum(axis=1)), np.argmax(points.sum(axis=1))]]
