"""Draw states of an episode.

MuJoCo draws locomotion, and Matplotlib the point mass. Any other environment must have
a function ``draw(state, size)``. It gets the environment's `pipeline_state`, as NumPy
arrays, and the width and height of a picture in pixels, and returns the picture, uint8
(height, width, 3).
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from gasil_envs import user_code
from gasil_envs.base import Env
from gasil_envs.locomotion import Locomotion
from gasil_envs.point_mass import PointMass

#: Distance to which metres are marked on both sides, in metres.
_METRES = 5


class NoOpenGL(RuntimeError):
    """There is no OpenGL for MuJoCo to draw with."""


class LocomotionPainter:
    """Draws states of locomotion off screen; close it after use.

    `size` is the width and height of a picture in pixels, here and below.
    """

    def __init__(self, env: Locomotion, size: tuple[int, int]):
        self._model = model = env.model
        self.seconds_per_step = env.dt
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, size[0])
        model.vis.global_.offheight = max(model.vis.global_.offheight, size[1])
        self._data = mujoco.MjData(model)
        task = env.task
        self._walks = task.forward_reward != 0.0 or task.paid_beyond is not None
        self._camera: int | mujoco.MjvCamera = 0
        if not model.ncam:
            self._camera = mujoco.MjvCamera()
            mujoco.mjv_defaultFreeCamera(model, self._camera)
            if self._walks:
                self._camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
                self._camera.trackbodyid = 1
        try:
            # MuJoCo's letters have sizes from 50% to 300%.
            scale = mujoco.mjtFontScale(50 * min(6, max(1, size[0] // 96)))
            self._renderer = mujoco.Renderer(model, size[1], size[0], font_scale=scale)
        # The GL library's own errors are of many types.
        except Exception as error:
            raise NoOpenGL(
                f"no OpenGL for MuJoCo to draw with ({error}): install libegl1 or "
                "libosmesa6, and set MUJOCO_GL to egl or osmesa"
            ) from None

    def draw(self, episode: Sequence[Any]) -> np.ndarray:
        """Return a picture of the last physics state, uint8 (height, width, 3)."""
        physics = episode[-1].physics
        self._data.qpos[:], self._data.qvel[:] = physics.qpos, physics.qvel
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, self._camera)
        if self._walks:
            self._mark_metres()
        return self._renderer.render().copy()

    def _mark_metres(self) -> None:
        """Draw a line across the ground at each whole metre nearby, with its number."""
        scene, model = self._renderer.scene, self._model
        planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        floor = model.geom_pos[planes][0, 2] if planes.any() else 0.0
        x, y, _ = self._data.subtree_com[1]
        for metre in range(round(x) - _METRES, round(x) + _METRES + 1):
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(
                geom,
                mujoco.mjtGeom.mjGEOM_BOX,
                np.array([0.02, 0.5, 0.002]),
                np.array([metre, y + 1.0, floor]),
                np.eye(3).ravel(),
                np.array([0.9, 0.2, 0.1, 1.0], np.float32),
            )
            geom.label = f"{metre} m"
            scene.ngeom += 1

    def moment(self, step: int) -> str:
        """Return the label of a step's picture."""
        return f"{step * self.seconds_per_step:.2f} s"

    def close(self) -> None:
        self._renderer.close()


class OwnPainter:
    """Draws states of an environment that has a function `draw`."""

    def __init__(self, env: Any, size: tuple[int, int]):
        self._env, self._size = env, size
        self.seconds_per_step = float(getattr(env, "dt", 0.1))

    def draw(self, episode: Sequence[Any]) -> np.ndarray:
        """Return a picture of the last state, uint8 (height, width, 3)."""
        name = type(self._env).__name__
        with user_code.refused(f"draw of {name} fails"):
            picture = np.asarray(self._env.draw(episode[-1], self._size))
        shape = (self._size[1], self._size[0], 3)
        if picture.shape != shape or picture.dtype != np.uint8:
            given = f"{picture.dtype}{list(picture.shape)}"
            raise ValueError(
                f"draw of {name} returns {given}: it must be uint8{list(shape)}"
            )
        return picture

    def moment(self, step: int) -> str:
        return f"step {step}"

    def close(self) -> None:
        """Do nothing: there is nothing to free."""


class PointMassPainter(OwnPainter):
    """Draws the point mass, its objects and its path."""

    seconds_per_step = 0.1

    def __init__(self, env: PointMass, size: tuple[int, int]):
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        self._layout = env.layout
        figure = Figure(figsize=(size[0] / 100, size[1] / 100), dpi=100)
        self._canvas = FigureCanvasAgg(figure)
        self._axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))

    def draw(self, episode: Sequence[Any]) -> np.ndarray:
        """Return a picture of the path so far, uint8 (height, width, 3)."""
        positions = np.stack([state.position for state in episode])
        axes = self._axes
        axes.clear()
        point_mass_layout(axes, self._layout, episode[-1].collected)
        axes.plot(*positions.T, color="0.3", linewidth=1)
        axes.plot(*positions[-1], "o", color="black", markersize=6)
        axes.set(xticks=[], yticks=[])
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


Painter = LocomotionPainter | OwnPainter


def can_draw(env: Env) -> bool:
    """Return whether an environment, wrapped or not, has a painter."""
    ours = isinstance(env.unwrapped, Locomotion | PointMass)
    return ours or hasattr(env.unwrapped, "draw")


def painter(env: Env, size: tuple[int, int]) -> Painter:
    """Return the painter of an environment, wrapped or not."""
    if isinstance(env.unwrapped, Locomotion):
        return LocomotionPainter(env.unwrapped, size)
    if isinstance(env.unwrapped, PointMass):
        return PointMassPainter(env.unwrapped, size)
    if can_draw(env):
        return OwnPainter(env.unwrapped, size)
    raise ValueError(f"{type(env.unwrapped).__name__} can't be drawn")


def point_mass_layout(axes: Any, layout: Any, collected: np.ndarray) -> None:
    """Draw the point mass' box and objects; `collected` ones, (objects,), are pale."""
    from matplotlib.patches import Circle, Rectangle

    kinds = (
        (layout.blue, "#0072B2", layout.blue_reward),
        (layout.green, "#009E73", layout.green_reward),
        (layout.orange, "#E69F00", layout.orange_reward),
    )
    objects = [(x, y, c, r) for centres, c, r in kinds for x, y in centres]
    for (x, y, color, reward), taken in zip(objects, collected, strict=True):
        alpha = 0.12 if taken else 0.6
        axes.add_patch(Circle((x, y), layout.radius, color=color, alpha=alpha))
        axes.text(x, y, f"{reward:+g}", ha="center", va="center", fontsize=9)
    (x, y), spread = layout.start, layout.start_spread
    corner = (x - spread, y - spread)
    axes.add_patch(Rectangle(corner, 2 * spread, 2 * spread, color="0.85", zorder=0))
    axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal")
