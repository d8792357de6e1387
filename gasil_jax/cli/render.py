"""Make a film of a run's policy: ``python -m gasil_jax.render RUN --out walk.mp4``."""

import dataclasses
import pathlib
from collections.abc import Sequence
from importlib.util import find_spec

import jax

from gasil_jax.cli.parsing import check_minimum, input_checked, read
from gasil_jax.cli.policies import PolicyOptions
from gasil_jax.cli.reporting import reports_errors
from gasil_jax.errors import InputError
from gasil_jax.host import environments, output_file, video
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
    steps = min(options.steps, num_steps)
    run = video.make_episode(env, num_steps=steps, stochastic=options.stochastic)
    with announced("render", "compiling and running the episode"):
        states, total = run(weights[0], jax.random.key(options.key))
    try:
        with (
            announced("render", f"drawing {options.out}"),
            input_checked(),
            output_file.atomic(options.out) as partial,
        ):
            num_frames = video.save(env, states, size, partial)
    except video.NoOpenGL as error:
        raise OSError(str(error)) from error
    print(
        f"seed {seeds[0]}: return {total:.1f} in {len(states) - 1} steps, "
        f"{num_frames} frames in {options.out}"
    )
    return 0
