"""Run an episode of a policy and draw it, after training or in between."""

import contextlib
import os
import pathlib
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from ctypes.util import find_library
from typing import Any

# MuJoCo reads this variable on import, so this module must be imported before it is.
# Without a display, EGL can draw on a CPU too.
if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl" if find_library("EGL") else "disable")

import jax
import numpy as np

from gasil_envs import pictures, wrappers
from gasil_jax import policy, rollout
from gasil_jax.host import output_file
from gasil_jax.host.members import Interval, Members, member
from gasil_jax.host.progress import Progress
from gasil_jax.host.trackers import Tracker

NoOpenGL = pictures.NoOpenGL

#: About the largest number of frames/s of a film; states in between are left out.
_FRAMES_PER_SECOND = 25.0
#: Width and height in pixels of the films during training.
_SIZE = (320, 240)

Episode = Callable[[Mapping[str, Any], jax.Array], tuple[list[Any], float]]


def make_episode(env: Any, *, num_steps: int, stochastic: bool = False) -> Episode:
    """Return a function of a policy and a key: the physics states and the return."""
    reset = jax.jit(env.reset)

    @jax.jit
    def step(weights: Mapping[str, Any], state: Any, key: jax.Array) -> Any:
        action = policy.make(weights)(state.obs, key if stochastic else None)
        return env.step(state, action)

    def episode(weights: Mapping[str, Any], key: jax.Array) -> tuple[list[Any], float]:
        reset_key, key = jax.random.split(key)
        state = reset(reset_key)
        states, total = [jax.device_get(state.pipeline_state)], 0.0
        for step_key in jax.random.split(key, num_steps):
            observation, state = state.obs, step(weights, state, step_key)
            reward = state.info.get("true_reward", state.reward)
            # A step in which the physics fails ends the episode, and is left out.
            if not wrappers.step_is_sound(observation, state):
                break
            states.append(jax.device_get(state.pipeline_state))
            total += float(reward)
            if state.done > 0 or wrappers.truncated(state):
                break
        return states, total

    return episode


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
    """Write up to eight pictures of an episode in two rows, each above its time."""
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


class Videos:
    """Films the policy of the first member, as STEPS.gif, also for the trackers."""

    def __init__(
        self,
        members: Members,
        folder: pathlib.Path,
        *,
        every: int,
        trackers: Sequence[Tracker],
    ):
        self.interval, self.seconds = Interval(every, members.config), 0.0
        self._members, self._folder, self._trackers = members, folder, trackers
        self._works = True
        steps = rollout.max_episode_steps(members.env)
        self._episode = make_episode(members.env, num_steps=steps)

    def film(self, states: Any, done: int, progress: Progress) -> None:
        """Film an episode after `done` iterations."""
        env, steps = self._members.env, done * self._members.config.batch_steps
        path = self._folder / f"{steps:08d}.gif"
        if not self._works:
            return
        started = time.monotonic()
        try:
            # Before the episode compiles, which takes seconds.
            pictures.painter(env, _SIZE).close()
            first = "" if self.seconds else "compiling and "
            with progress.aside(f"{first}filming an episode"):
                self._folder.mkdir(exist_ok=True)
                weights = policy.weights(member(states, 0), env)
                drawn, _ = self._episode(weights, jax.random.key(0))
                with output_file.atomic(path) as partial:
                    save(env, drawn, _SIZE, partial)
        except (NoOpenGL, ValueError, OSError) as error:
            self._works = False
            progress.warn(f"no videos are made: {error}")
        else:
            for tracker in self._trackers:
                tracker.log_video(steps, path)
        self.seconds += time.monotonic() - started
