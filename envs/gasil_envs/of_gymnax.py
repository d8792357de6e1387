"""The environments of gymnax 1.0 by name, as gymnax:NAME.

They reset themselves and count their own time in `step`, which is not used here: what
is stepped is `step_env`.
"""

import functools
from typing import Any

import gymnax
import jax
import jax.numpy as jnp
import numpy as np
from gymnax.environments import spaces
from matplotlib.colors import hsv_to_rgb
from PIL import Image

from gasil_envs.worlds import Unfit, World

#: Environments that download data when they are built.
_DOWNLOADING = ("MNISTBandit-bsuite",)


def names() -> tuple[str, ...]:
    """Return the names of gymnax' environments, and of those registered with it."""
    return tuple(gymnax.registered_envs)


def build(name: str) -> World:
    """Build NAME, or NAME:PART if observations have several parts."""
    bare, _, part = name.partition(":")
    if bare in _DOWNLOADING:
        raise Unfit("downloads data when it is built, which is not supported")
    env, params = gymnax.make(bare)

    def begin(key: jax.Array) -> tuple[Any, Any]:
        observation, state = env.reset_env(key, params)
        return state, observation

    def advance(key: jax.Array, state: Any, action: jax.Array) -> Any:
        observation, state, reward, terminated, _ = env.step_env(
            key, state, action, params
        )
        return state, observation, reward, terminated

    space = env.action_space(params)
    if isinstance(space, spaces.Discrete):
        actions: Any = int(space.n)
    elif isinstance(space, spaces.Box):
        actions = tuple(
            np.broadcast_to(x, space.shape) for x in (space.low, space.high)
        )
    else:
        raise Unfit(f"has actions in {space}: they must be in a box or discrete")
    world = World(
        begin,
        advance,
        actions=actions,
        episode_length=int(params.max_steps_in_episode),
        part=part or None,
    )
    _, seen = jax.eval_shape(begin, jax.random.key(0))
    if hasattr(env, "render"):
        world.draw = functools.partial(_draw, env, params)
    elif len(getattr(seen, "shape", ())) == 3:
        world.draw = functools.partial(_draw_planes, env, params)
    return world


def _draw_planes(
    env: Any, params: Any, state: Any, size: tuple[int, int]
) -> np.ndarray:
    """Return a picture of MinAtar's planes, each in a color of its own."""
    planes = np.asarray(env.get_obs(jax.tree.map(jnp.asarray, state[0]), params=params))
    colors = 255 * hsv_to_rgb(
        [(i / planes.shape[-1], 0.8, 1.0) for i in range(planes.shape[-1])]
    )
    last = planes.shape[-1] - 1 - planes[..., ::-1].argmax(axis=-1)
    picture = np.where(planes.any(axis=-1, keepdims=True), colors[last], 0.0)
    image = Image.fromarray(picture.astype(np.uint8))
    return np.asarray(image.resize(size, Image.Resampling.NEAREST))


def _draw(env: Any, params: Any, state: Any, size: tuple[int, int]) -> np.ndarray:
    """Return the picture that an environment draws of a state, with Matplotlib."""
    import matplotlib.pyplot as plt
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure, _ = env.render(state[0], params)
    figure.set(dpi=100, size_inches=(size[0] / 100, size[1] / 100))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    plt.close(figure)
    return np.asarray(canvas.buffer_rgba())[..., :3].copy()
