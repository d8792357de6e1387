"""Make a film of a run's policy: ``python -m gasil_jax.render RUN --out walk.mp4``.

MuJoCo draws locomotion off screen. The point mass is drawn as the path of an episode.
Other environments draw themselves.
"""

import contextlib
import dataclasses
import os
import pathlib
import sys
from collections.abc import Sequence
from ctypes.util import find_library
from importlib.util import find_spec
from typing import Any

# MuJoCo reads this variable on import. Without a display, EGL can draw on a CPU too.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "disable")

import jax
import numpy as np

from gasil_envs import pictures, wrappers
from gasil_jax import policy
from gasil_jax.cli.parsing import check_minimum, input_checked, read
from gasil_jax.cli.policies import PolicyOptions
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.errors import InputError
from gasil_jax.host import environments, output_file
from gasil_jax.host.progress import announced

_PICTURES = (".mp4", ".gif", ".png")
# Limit of a frame's width and height in pixels, because all frames are in memory at
# once.
_LARGEST_SIZE = 4096


@dataclasses.dataclass(frozen=True)
class Options(PolicyOptions):
    """Draw an episode of a run's policy.

    Attributes:
      out: file to write: .mp4 (needs the package imageio-ffmpeg), .gif or .png (a strip
        of eight pictures in two rows).
      seed: seed of the policy; default the one with the highest final return.
      steps: largest number of steps.
      width: width of a frame in pixels.
      height: height of a frame in pixels.
    """

    out: pathlib.Path = pathlib.Path("episode.mp4")
    seed: int | None = None
    steps: int = 1000
    width: int = 480
    height: int = 360


def episode(
    env: Any, act: Any, key: jax.Array, *, num_steps: int
) -> tuple[list[Any], float]:
    """Return the physics states of an episode, from its start on, and its true return.

    A step in which the physics fails ends the episode; the step is left out of both.
    """
    reset_key, key = jax.random.split(key)
    state = jax.jit(env.reset)(reset_key)
    step = jax.jit(lambda state, key: env.step(state, act(state.obs, key)))
    states, total = [jax.device_get(state.pipeline_state)], 0.0
    for step_key in jax.random.split(key, num_steps):
        observation, state = state.obs, step(state, step_key)
        reward = state.info.get("true_reward", state.reward)
        if not wrappers.step_is_sound(observation, state):
            break
        states.append(jax.device_get(state.pipeline_state))
        total += float(reward)
        if state.done > 0 or wrappers.truncated(state):
            break
    return states, total


#: About the largest number of frames/s of a film; states in between are left out.
_FRAMES_PER_SECOND = 25.0


def frames_of(
    env: Any, states: Sequence[Any], size: tuple[int, int]
) -> tuple[list[np.ndarray], float]:
    """Return pictures (height, width, 3) uint8 of physics states, and frames/s."""
    with contextlib.closing(pictures.painter(env, size)) as painter:
        every = max(1, round(1.0 / (_FRAMES_PER_SECOND * painter.seconds_per_step)))
        counts = range(1, len(states) + 1, every)
        frames = [painter.draw(states[:count]) for count in counts]
    return frames, 1.0 / (every * painter.seconds_per_step)


def save(
    env: Any, states: Sequence[Any], size: tuple[int, int], path: pathlib.Path
) -> int:
    """Draw states in the format of the path's suffix; return the frame count."""
    if path.suffix == ".png":
        return write_strip(env, states, size, path=path)
    frames, fps = frames_of(env, states, size)
    write_film(frames, fps, path)
    return len(frames)


def write_film(frames: Sequence[np.ndarray], fps: float, path: pathlib.Path) -> None:
    """Write frames as a film, .mp4 or .gif."""
    from PIL import Image

    if path.suffix == ".mp4":
        import imageio_ffmpeg

        height, width = frames[0].shape[:2]
        # By default pictures are stretched to multiples of sixteen pixels.
        writer = imageio_ffmpeg.write_frames(
            str(path), (width, height), fps=fps, macro_block_size=2
        )
        writer.send(None)
        for frame in frames:
            writer.send(np.ascontiguousarray(frame))
        writer.close()
        # The writer ignores the exit status of ffmpeg.
        if not (path.exists() and path.stat().st_size):
            raise OSError("ffmpeg wrote nothing")
    else:
        images = [Image.fromarray(frame) for frame in frames]
        duration = 1000.0 / fps
        images[0].save(
            path, save_all=True, append_images=images[1:], duration=duration, loop=0
        )


def write_strip(
    env: Any, states: Sequence[Any], size: tuple[int, int], *, path: pathlib.Path
) -> int:
    """Write up to eight pictures of an episode in two rows, each above its time.

    The times are large enough to read when the strip, four pictures wide, fills a
    column of a paper.
    """
    from matplotlib import font_manager
    from PIL import Image, ImageDraw, ImageFont

    width, height = size
    steps = np.unique(np.linspace(0, len(states) - 1, 8).round().astype(int)).tolist()
    columns = -(-len(steps) // 2)
    gap, letters = width // 24, max(8, width // 9)
    below = 3 * letters // 2
    strip = Image.new(
        "RGB", (columns * (width + gap) - gap, 2 * (height + below)), "white"
    )
    font = ImageFont.truetype(font_manager.findfont("DejaVu Sans"), letters)
    pen = ImageDraw.Draw(strip)
    with contextlib.closing(pictures.painter(env, size)) as painter:
        for number, step in enumerate(steps):
            x = number % columns * (width + gap)
            y = number // columns * (height + below)
            strip.paste(Image.fromarray(painter.draw(states[: step + 1])), (x, y))
            middle = (x + width // 2, y + height + below // 2)
            pen.text(middle, painter.moment(step), "black", font, anchor="mm")
    strip.save(path)
    return len(steps)


@reports_errors
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    options = read(Options, arguments, "gasil_jax.render")
    output_file.check(options.out, _PICTURES)
    if options.out.suffix == ".mp4" and find_spec("imageio_ffmpeg") is None:
        raise InputError(
            f"out is {options.out}: an .mp4 needs the package imageio-ffmpeg (pip "
            'install "gasil_jax[render]"); a .gif or .png needs nothing'
        )
    check_minimum(options, steps=1)
    for name in ("width", "height"):
        if not 1 <= getattr(options, name) <= _LARGEST_SIZE:
            raise InputError(
                f"{name} is {getattr(options, name)}: it must be from 1 to "
                f"{_LARGEST_SIZE}"
            )
    # The encoder of films needs even numbers of pixels.
    size = (options.width + options.width % 2, options.height + options.height % 2)
    env, num_steps, seeds, weights = options.load(options.seed, only_best=True)
    if not environments.can_be_drawn(env):
        raise InputError(
            "run is of an environment that can't be drawn: it must have a function "
            "draw(state, size)"
        )
    output_file.make_parent(options.out)
    drawn = policy.make(weights[0])
    act = drawn if options.stochastic else lambda observation, key: drawn(observation)
    steps = min(options.steps, num_steps)
    with announced("render", "compiling and running the episode"):
        states, total = episode(env, act, jax.random.key(options.key), num_steps=steps)
    try:
        with (
            announced("render", f"drawing {options.out}"),
            input_checked(),
            output_file.atomic(options.out) as partial,
        ):
            num_frames = save(env, states, size, partial)
    except pictures.NoOpenGL as error:
        raise OSError(str(error)) from error
    print(
        f"seed {seeds[0]}: return {total:.1f} in {len(states) - 1} steps, "
        f"{num_frames} frames in {options.out}"
    )
    return 0
