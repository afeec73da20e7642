"""Pictures of a walk: a row of stick figures, and a video.

A video is rendered by MuJoCo where EGL is there, drawn as stick figures elsewhere.
"""

import io
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from pup.files import write_atomic
from pup.locomotion.evaluation import Policy
from pup.locomotion.task import WalkingTask
from pup.physics.model import FLOOR, compile_model
from pup.robot import RobotDescription
from pup.sysid.figures import BLUE, INK, SOFT, VERMILLION, as_png, drawing_style, new_figure
from services import stopping

Array = NDArray[np.float64]
Frames = Iterator[NDArray[np.uint8]]

SIZE = 480, 640
"""Height and width of a video, pixels; MuJoCo's largest without being told."""
FIGURES = 12
"""Stick figures in a row, over two periods of the gait from the middle of the walk."""


@dataclass(frozen=True)
class Footage:
    """A walk as it can be drawn.

    Attributes:
      states: of the simulation, mjSTATE_INTEGRATION, shape (n_frames, n_state).
      time: of the frames, s.
      axis: direction of the walk on the floor, shape (2,).
      distance: in that direction, m.
      fell: whether it ended otherwise than by time.
    """

    states: Array
    time: Array
    axis: Array
    distance: float
    fell: bool

    @classmethod
    def of(cls, task: WalkingTask, policy: Policy) -> "Footage":
        """Let a policy walk one episode of a task with one simulation."""
        seen, states, time = task.reset(), [_physics(task)], [0.0]
        while True:
            step = task.step(policy(seen.proprioception, seen.parameters))
            seen = step.observation
            states.append(_physics(task))
            time.append(float(step.time[0]))
            if step.terminated[0] or step.truncated[0]:
                axis = np.array(task.settings.direction.axis)
                distance, fell = float(step.distance[0]), bool(step.terminated[0])
                return cls(np.array(states), np.array(time), axis, distance, fell)


def _physics(task: WalkingTask) -> Array:
    return np.asarray(task.state()["simulations/physics"][0], dtype=np.float64)


class _Scene:
    """Puts a model into the states of a walk."""

    def __init__(self, robot: RobotDescription, footage: Footage) -> None:
        self.model = compile_model(robot, "ground", _decorated).compiled
        self.data, self.footage = mujoco.MjData(self.model), footage
        self.left = [j.name.startswith("l") for j in robot.joints]

    def show(self, frame: int) -> Any:
        """The data of a frame."""
        state = self.footage.states[frame]
        mujoco.mj_setState(self.model, self.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        return self.data

    def sticks(self, frame: int) -> list[tuple[Array, Array, str]]:
        """Ends of each link, along the walk and up, and its colour."""
        data, across = self.show(frame), np.array([-self.footage.axis[1], self.footage.axis[0]])
        along = np.stack([data.xpos[:, :2] @ self.footage.axis, data.xpos[:, 2]], axis=1)
        side = data.xpos[:, :2] @ across - data.xpos[1, :2] @ across
        names = [self.model.body(i).name for i in range(self.model.nbody)]
        sticks = []
        for body in range(2, self.model.nbody):
            parent = int(self.model.body_parentid[body])
            left = names[body].startswith("l") or (names[body][0] not in "lr" and side[body] > 0)
            sticks.append((along[parent], along[body], VERMILLION if left else BLUE))
        return sticks


def _decorated(robot: RobotDescription, spec: Any) -> None:
    """A chequered floor and a light, so that the walk can be seen against something."""
    spec.add_texture(
        name="squares",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.92, 0.93, 0.94],
        rgb2=[0.80, 0.82, 0.85],
        width=256,
        height=256,
    )
    material = spec.add_material(name="squares", texrepeat=[10, 10], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "squares"
    for geom in spec.geoms:
        if geom.name == FLOOR:
            geom.material = "squares"
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.5] * 3
    sky = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtBuiltin.mjBUILTIN_FLAT
    spec.add_texture(name="sky", type=sky[0], builtin=sky[1], rgb1=[1, 1, 1], width=8, height=48)


def draw_gait(file: Path, robot: RobotDescription, footage: Footage) -> None:
    """Draw stick figures over two periods of the gait.

    Args:
      file: PNG to write.
      robot: the robot.
      footage: the walk.
    """
    assert robot.gait is not None
    scene, last = _Scene(robot, footage), footage.time[-1]
    span = min(2 * robot.gait.period, last)
    times = np.linspace(0.0, span, FIGURES) + max(0.0, last / 2 - span / 2)
    frames = np.clip(np.searchsorted(footage.time, times), 0, len(footage.time) - 1)
    height = float(scene.show(0).xpos[:, 2].max())
    places = [end[0] for a, b, _ in scene.sticks(0) for end in (a, b)]
    apart = max(0.7 * height, 1.3 * float(np.ptp(places)))
    with drawing_style():
        figure = new_figure(11.0, 3.2)
        axes = figure.subplots()
        for i, frame in enumerate(frames):
            _draw_sticks(axes, scene.sticks(int(frame)), shift=apart * i)
            axes.text(apart * i, 1.25 * height, f"{footage.time[frame]:.2f} s", ha="center")
        axes.axhline(0.0, color=SOFT, linewidth=0.8)
        axes.set_aspect("equal")
        axes.set_axis_off()
        figure.suptitle(
            f"{robot.name}: {footage.distance:.2f} m in {last:.1f} s"
            + (", then a fall" if footage.fell else "")
            + "; left limbs red, each figure moved to the right of the one before"
        )
        write_atomic(file, as_png(figure))


def _draw_sticks(axes: Any, sticks: list[tuple[Array, Array, str]], shift: float) -> None:
    middle = np.mean([a[0] for a, _, _ in sticks])
    for a, b, colour in sticks:
        axes.plot(
            [a[0] - middle + shift, b[0] - middle + shift], [a[1], b[1]], color=colour, linewidth=2
        )


def film(stem: Path, robot: RobotDescription, footage: Footage) -> tuple[Path, str]:
    """Write a video.

    Args:
      stem: its path without an ending: .mp4 where imageio-ffmpeg is installed, else .gif.
      robot: the robot.
      footage: the walk.

    Returns:
      The file, and what drew it: `mujoco` or `matplotlib`.
    """
    scene = _Scene(robot, footage)
    rate = 1 / float(np.median(np.diff(footage.time)))
    write, ending = (_mp4, ".mp4") if find_spec("imageio_ffmpeg") else (_gif, ".gif")
    file = stem.with_suffix(ending)
    with suppress(ImportError, AttributeError, RuntimeError, mujoco.FatalError):  # no EGL here
        write(file, _watched(_rendered(scene)), rate)
        return file, "mujoco"
    write(file, _watched(_drawn(scene)), rate)
    return file, "matplotlib"


def _watched(frames: Frames) -> Frames:
    """Frames until the job shall stop, also where it is another thread that was told so."""
    for frame in frames:
        stopping.check()
        yield frame


def _rendered(scene: _Scene) -> Frames:
    """Frames by MuJoCo, the camera beside the robot."""
    from mujoco.egl import GLContext

    height, width = SIZE
    quality = scene.model.vis.quality
    quality.offsamples = 0  # without a graphics card, smooth edges take half of the time
    if not scene.model.nlight:
        quality.shadowsize = 0  # what lights the scene throws none
    context = GLContext(width, height)
    context.make_current()
    try:
        renderer = mujoco.MjrContext(scene.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, renderer)
        shown, whole = mujoco.MjvScene(scene.model, 2000), mujoco.MjrRect(0, 0, width, height)
        camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
        axis = scene.footage.axis
        camera.azimuth = float(np.degrees(np.arctan2(axis[1], axis[0]))) + 120
        camera.elevation, camera.distance = -12.0, 0.95
        lamp = scene.model.vis.headlight  # robots are dark, and models come without lights
        lamp.ambient[:], lamp.diffuse[:] = 0.5, 0.7
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        for frame in range(len(scene.footage.time)):
            data = scene.show(frame)
            camera.lookat[:] = (*data.xpos[1, :2], 0.2)
            mujoco.mjv_updateScene(
                scene.model, data, option, None, camera, mujoco.mjtCatBit.mjCAT_ALL, shown
            )
            mujoco.mjr_render(whole, shown, renderer)
            mujoco.mjr_readPixels(pixels, None, whole, renderer)
            yield pixels[::-1]
    finally:
        context.free()


def _drawn(scene: _Scene) -> Frames:
    """Frames of stick figures."""
    height = float(scene.show(0).xpos[:, 2].max())
    with drawing_style():
        figure = new_figure(SIZE[1] / 100, SIZE[0] / 100, fixed=True)
        for frame, time in enumerate(scene.footage.time):
            figure.clear()
            axes = figure.add_axes((0, 0, 1, 1))
            sticks = scene.sticks(frame)
            for a, b, colour in sticks:
                axes.plot([a[0], b[0]], [a[1], b[1]], color=colour, linewidth=3)
            middle = float(np.mean([a[0] for a, _, _ in sticks]))
            axes.axhline(0.0, color=SOFT)
            marks = np.arange(np.floor(middle * 10) - 10, np.ceil(middle * 10) + 11) / 10
            axes.vlines(marks, -0.02, 0.0, color=SOFT, linewidth=0.8)
            axes.text(middle - 0.9 * height, 1.4 * height, f"{time:.2f} s", color=INK)
            axes.set_xlim(middle - height, middle + height)
            axes.set_ylim(-0.1 * height, 1.4 * height + 0.1)
            axes.set_aspect("equal", adjustable="datalim")
            axes.set_axis_off()
            figure.canvas.draw()
            yield np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


def _mp4(file: Path, frames: Frames, rate: float) -> None:
    import imageio_ffmpeg

    part = file.with_suffix(".part.mp4")
    writer = imageio_ffmpeg.write_frames(str(part), (SIZE[1], SIZE[0]), fps=rate, quality=7)
    try:
        writer.send(None)
        for pixels in frames:
            writer.send(np.ascontiguousarray(pixels))
        writer.close()
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)


def _gif(file: Path, frames: Frames, rate: float) -> None:
    from PIL import Image

    first, *others = (Image.fromarray(pixels.copy()).convert("P") for pixels in frames)
    packed = io.BytesIO()
    first.save(
        packed, "GIF", save_all=True, append_images=others, duration=round(1e3 / rate), loop=0
    )
    write_atomic(file, packed.getvalue())
