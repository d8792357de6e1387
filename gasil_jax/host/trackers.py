"""Log metrics to TensorBoard and Weights & Biases, besides metrics.csv.

Steps are environment steps per member. Weights & Biases has a run for each member;
TensorBoard has one, with means over the members and each member's returns.
"""

import contextlib
import importlib
import os
import pathlib
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from gasil_jax.errors import InputError

_Config = Mapping[str, Any]
#: What each member has of its own, by its label.
_Members = Mapping[str, _Config]


class Tracker(Protocol):
    """A destination for metrics."""

    def log(self, step: int, metrics: Mapping[str, np.ndarray]) -> None:
        """Log metrics of one iteration, (members,) each; NaN where there is none."""

    def log_video(self, step: int, path: pathlib.Path) -> None:
        """Log a film of the first member, a .gif."""

    def close(self) -> None:
        """Write everything that is still buffered, and close."""


class _TensorBoard:
    def __init__(
        self, folder: pathlib.Path, name: str, config: _Config, members: _Members
    ):
        import tensorboardX

        del name  # TensorBoard names a run by its folder.
        self._labels = tuple(members)
        self._writer = tensorboardX.SummaryWriter(str(folder / "tensorboard"))
        self._writer.add_text("config", f"```\n{_as_text(config)}\n```")

    def log(self, step: int, metrics: Mapping[str, np.ndarray]) -> None:
        for name, values in metrics.items():
            if np.isfinite(values).any():
                mean = float(values[np.isfinite(values)].mean())
                self._writer.add_scalar(f"mean/{name}", mean, step)
            if name in ("episode_return", "evaluation"):
                for label, value in zip(self._labels, values, strict=True):
                    if np.isfinite(value):
                        self._writer.add_scalar(f"{name}/{label}", float(value), step)

    def log_video(self, step: int, path: pathlib.Path) -> None:
        from tensorboardX.proto.summary_pb2 import Summary

        # `add_video` would need moviepy. TensorBoard plays a picture that is a film.
        image = Summary.Image(colorspace=3, encoded_image_string=path.read_bytes())
        value = Summary.Value(tag=f"video/{self._labels[0]}", image=image)
        self._writer.file_writer.add_summary(Summary(value=[value]), step)

    def close(self) -> None:
        self._writer.close()


class _WeightsAndBiases:
    def __init__(
        self, folder: pathlib.Path, name: str, config: _Config, members: _Members
    ):
        import wandb

        # A continued run is the same run in Weights & Biases, even with more steps.
        identifier = _identifier(folder / "wandb-id")
        try:
            self._runs = [
                wandb.init(
                    project=os.environ.get("WANDB_PROJECT", "gasil_jax"),
                    group=os.environ.get("WANDB_RUN_GROUP", name),
                    name=f"{name}-{label}",
                    dir=str(folder),
                    id=f"{identifier}-{label}",
                    resume="allow",
                    config={**config, **own},
                    allow_val_change=True,
                    reinit="create_new",
                )
                for label, own in members.items()
            ]
        except wandb.errors.Error as error:
            raise InputError(
                f"log is 'wandb', which can't start: {' '.join(str(error).split())} "
                "(solve that, or set WANDB_MODE=offline, and continue with --resume)"
            ) from None

    def log(self, step: int, metrics: Mapping[str, np.ndarray]) -> None:
        for index, run in enumerate(self._runs):
            own = {name: float(values[index]) for name, values in metrics.items()}
            run.log({x: y for x, y in own.items() if np.isfinite(y)}, step=step)

    def log_video(self, step: int, path: pathlib.Path) -> None:
        import wandb

        self._runs[0].log({"video": wandb.Video(str(path), format="gif")}, step=step)

    def close(self) -> None:
        for run in self._runs:
            run.finish()


def _identifier(path: pathlib.Path) -> str:
    """Return the random identifier in a file, which is created if it is missing."""
    with contextlib.suppress(FileExistsError), path.open("x") as file:
        file.write(uuid.uuid4().hex)
    return path.read_text()


def _as_text(config: _Config) -> str:
    return "\n".join(f"{name}: {value}" for name, value in config.items())


#: name -> (the required package, the tracker's class).
TRACKERS: Mapping[str, tuple[str, Callable[..., Tracker]]] = {
    "tensorboard": ("tensorboardX", _TensorBoard),
    "wandb": ("wandb", _WeightsAndBiases),
}


def check(setting: str, names: Sequence[str]) -> None:
    """Raise `ValueError` for a tracker that is unknown, not installed or repeated."""
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"{setting} has {name!r} twice: name it once")
        if name not in TRACKERS:
            allowed = ", ".join(TRACKERS)
            raise ValueError(f"{setting} is {name!r}: it must be one of {allowed}")
        package = TRACKERS[name][0]
        try:
            importlib.import_module(package)
        except ImportError:
            raise ValueError(
                f"{setting} is {name!r}: it needs the package {package} "
                f'(pip install "gasil_jax[{name}]")'
            ) from None


def make(
    names: Sequence[str],
    folder: pathlib.Path,
    *,
    run_name: str,
    config: _Config,
    members: _Members,
) -> list[Tracker]:
    """Return the trackers of a run."""
    kinds = [TRACKERS[name][1] for name in names]
    return [kind(folder, run_name, config, members) for kind in kinds]


def log(trackers: Sequence[Tracker], metrics: Mapping[str, np.ndarray]) -> None:
    """Log a chunk of metrics, (members, iterations) each, to all trackers."""
    for index, step in enumerate(metrics["env_steps"][0] if trackers else ()):
        now = {name: x[:, index] for name, x in metrics.items() if name != "env_steps"}
        for tracker in trackers:
            tracker.log(int(step), now)
