"""Log metrics to TensorBoard and Weights & Biases, besides metrics.csv.

A tracker gets the metrics that metrics.csv gets. "mean/NAME" is a metric's mean over
the members, and "episode_return/LABEL" is the return of one member. "evaluation/mean"
and "evaluation/LABEL" are mean returns of an evaluation, over all members and of one
member. Steps are environment steps per member.
"""

import contextlib
import importlib
import netrc
import os
import pathlib
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol
from urllib.parse import urlsplit

import numpy as np

from gasil_jax.errors import InputError
from gasil_jax.host import command_line


class Tracker(Protocol):
    """A destination for scalars."""

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log the scalars of one iteration."""

    def close(self) -> None:
        """Write everything that is still buffered, and close."""


class _TensorBoard:
    def __init__(self, folder: pathlib.Path, name: str, config: Mapping[str, Any]):
        import tensorboardX

        del name  # TensorBoard names a run by its folder.
        self._writer = tensorboardX.SummaryWriter(str(folder / "tensorboard"))
        self._writer.add_text("config", f"```\n{_as_text(config)}\n```")

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        for name, value in scalars.items():
            self._writer.add_scalar(name, value, step)

    def close(self) -> None:
        self._writer.close()


class _WeightsAndBiases:
    def __init__(self, folder: pathlib.Path, name: str, config: Mapping[str, Any]):
        import wandb

        # A continued run is the same run in Weights & Biases, even with more steps.
        try:
            self._run = wandb.init(
                # By itself it would ask for a key while the run begins.
                mode="offline" if _lacks_key() else None,
                project=os.environ.get("WANDB_PROJECT", "gasil_jax"),
                name=name,
                dir=str(folder),
                id=_identifier(folder / "wandb-id"),
                resume="allow",
                config=dict(config),
                allow_val_change=True,
            )
        except wandb.errors.Error as error:
            raise InputError(
                f"log is 'wandb', which can't start: {' '.join(str(error).split())} "
                "(solve that, or set WANDB_MODE=offline, and continue with --resume)"
            ) from None

    def log(self, step: int, scalars: Mapping[str, float]) -> None:
        self._run.log(dict(scalars), step=step)

    def close(self) -> None:
        self._run.finish()


def _lacks_key() -> bool:
    """Return whether Weights & Biases would ask for an API key, so as to go online."""
    if "WANDB_MODE" in os.environ or "WANDB_API_KEY" in os.environ:
        return False
    server = os.environ.get("WANDB_BASE_URL", "https://api.wandb.ai")
    # `wandb login` keeps the key here.
    path = os.environ.get("NETRC") or os.path.expanduser("~/.netrc")
    try:
        login = netrc.netrc(path).authenticators(urlsplit(server).hostname or "")
    except (OSError, netrc.NetrcParseError):
        return True
    return login is None


def _identifier(path: pathlib.Path) -> str:
    """Return the random identifier in a file, which is created if it is missing.

    It distinguishes runs whose folders have the same name.
    """
    with contextlib.suppress(FileExistsError), path.open("x") as file:
        file.write(uuid.uuid4().hex)
    return path.read_text()


def _as_text(config: Mapping[str, Any]) -> str:
    return "\n".join(f"{name}: {value}" for name, value in config.items())


#: name -> (the required package, the tracker's class).
TRACKERS: Mapping[str, tuple[str, Callable[..., Tracker]]] = {
    "tensorboard": ("tensorboardX", _TensorBoard),
    "wandb": ("wandb", _WeightsAndBiases),
}


def check(names: Sequence[str]) -> None:
    """Raise `ValueError` for a tracker that is unknown or not installed.

    A note says if Weights & Biases will be offline.
    """
    for name in names:
        if name not in TRACKERS:
            allowed = ", ".join(TRACKERS)
            raise ValueError(f"log is {name!r}: it must be one of {allowed}")
        package = TRACKERS[name][0]
        try:
            importlib.import_module(package)
        except ImportError:
            raise ValueError(
                f"log is {name!r}: it needs the package {package} "
                f'(pip install "gasil_jax[{name}]")'
            ) from None
    if "wandb" in names and _lacks_key():
        command_line.note(
            "log is 'wandb' and there is no API key: the run is kept in its folder, "
            "for `wandb sync` (`wandb login` beforehand logs online)"
        )


def make(
    names: Sequence[str],
    folder: pathlib.Path,
    *,
    run_name: str,
    config: Mapping[str, Any],
) -> list[Tracker]:
    """Return the trackers of a run.

    Args:
      names: names in `TRACKERS`.
      folder: folder of the run, or of a program of a sweep.
      run_name: name that the run has in the trackers.
      config: settings to show with the run.

    Raises:
      InputError: if a tracker can't start.
    """
    return [TRACKERS[name][1](folder, run_name, config) for name in names]


def log(
    trackers: Sequence[Tracker],
    labels: Mapping[str, Sequence[Any]],
    metrics: Mapping[str, np.ndarray],
) -> None:
    """Log a chunk of metrics, (members, iterations) each, to all trackers."""
    for index, step in enumerate(metrics["env_steps"][0] if trackers else ()):
        scalars = {}
        for name, values in metrics.items():
            column = values[:, index][np.isfinite(values[:, index])]
            if column.size and name != "env_steps":
                scalars[f"mean/{name}"] = float(column.mean())
        returns = metrics["episode_return"][:, index]
        scalars |= _by_member("episode_return", labels, returns)
        for tracker in trackers:
            tracker.log(int(step), scalars)


def log_evaluation(
    trackers: Sequence[Tracker],
    labels: Mapping[str, Sequence[Any]],
    scores: Mapping[str, np.ndarray],
) -> None:
    """Log the scores of an evaluation, (members,) each, to all trackers."""
    mean = {"evaluation/mean": float(scores["mean"].mean())}
    scalars = mean | _by_member("evaluation", labels, scores["mean"])
    for tracker in trackers:
        tracker.log(int(scores["env_steps"][0]), scalars)


def _by_member(
    name: str, labels: Mapping[str, Sequence[Any]], values: np.ndarray
) -> dict[str, float]:
    """Return the finite ones of the values (members,), as NAME/LABEL of the member."""
    members = zip(*labels.values(), strict=True)
    return {
        f"{name}/{'-'.join(map(str, member))}": float(value)
        for member, value in zip(members, values, strict=True)
        if np.isfinite(value)
    }
