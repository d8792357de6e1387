"""Run a sweep's shards on a Ray cluster: ``python -m gasil_jax.sweep --launcher ray``.

Each job is a process of its own. If that dies it is run again, and continues from its
checkpoint.
"""

import contextlib
import importlib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from gasil_jax.errors import InputError
from gasil_jax.host.interruption import Interrupted, Interruption

#: The largest number of times that a job is run again after its process died.
RETRIES = 3
_SECONDS_BETWEEN_POLLS = 1.0
_BAD_INPUT = 2

Jobs = Mapping[str, Sequence[str]]


def _raise_failures(failed: Mapping[str, str], num_jobs: int) -> None:
    """Raise an error if jobs have failed.

    Args:
      failed: why jobs have failed, by the job's name.
      num_jobs: number of all jobs.

    Raises:
      ChildProcessError: if jobs have failed.
      InputError: if all jobs have failed because of bad input.
    """
    if failed:
        jobs = ", ".join(f"{name} ({why})" for name, why in failed.items())
        if list(failed.values()) == [f"status {_BAD_INPUT}"] * num_jobs:
            raise InputError(f"{jobs}: bad input, see above")
        raise ChildProcessError(
            f"{jobs} failed; the others are done. Continue with the same command and "
            "--resume"
        )


class _Unfinished(Exception):
    """A job ended early, and can continue when it is run again."""


def _run_module(program: str, arguments: Sequence[str]) -> int:
    """Run a command line in this process and return its exit status.

    Raises:
      _Unfinished: if it was interrupted or its folder could not be written.
    """
    status = importlib.import_module(program).main(arguments)
    if status not in (0, _BAD_INPUT):
        raise _Unfinished(f"status {status}")
    return status


def _ray_package() -> Any:
    try:
        import ray
    except ImportError:
        raise InputError(
            "launcher is 'ray': it needs the package ray "
            '(pip install "gasil_jax[ray]")'
        ) from None
    return ray


@contextlib.contextmanager
def _connected(ray: Any) -> Iterator[None]:
    """Connect to a Ray cluster: RAY_ADDRESS's, else a running one, else a new one."""
    if ray.is_initialized():
        yield
        return
    ray.init()
    try:
        yield
    finally:
        ray.shutdown()


def run_on_ray(program: str, jobs: Jobs, devices: int | None) -> None:
    """Run jobs as tasks of a Ray cluster, with a GPU each if it has GPUs, else on CPUs.

    If a task's worker or node dies, the task is run again elsewhere.

    Args:
      program: name of the module to start, which workers must have installed.
      jobs: the arguments of each job, by the job's name in messages. Folders in the
        arguments must be the same on every node.
      devices: number of CPU devices of a job and of CPUs that it reserves; default 1.
        Where the cluster has GPUs, a job reserves one of them and one CPU instead.

    Raises:
      ChildProcessError: if jobs have failed; the others are done.
      InputError: if Ray is not installed, if no node has that many CPUs, or if all jobs
        have failed because of bad input.
      Interrupted: if a signal was received; it was passed on to the running jobs.
    """
    ray = _ray_package()
    with _connected(ray):
        if ray.cluster_resources().get("GPU", 0) >= 1:
            needs = {"num_cpus": 1, "num_gpus": 1}
        else:
            needs = {"num_cpus": devices or 1, "num_gpus": 0}
            # By default a job would use every core of its node.
            more = [] if devices else ["--devices", "1"]
            jobs = {name: [*arguments, *more] for name, arguments in jobs.items()}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(node.get("CPU", 0) >= needs["num_cpus"] for node in nodes):
            raise InputError(
                f"launcher is 'ray': no node of the cluster has {needs['num_cpus']} "
                "CPUs, which each job reserves"
            )
        # JAX sets up its devices once per process, so each job needs its own. The
        # process ends with the job, so that the folder is free when the job runs again.
        task = ray.remote(
            max_calls=1, max_retries=RETRIES, retry_exceptions=[_Unfinished], **needs
        )(_run_module)
        names = {
            task.options(name=name).remote(program, list(arguments)): name
            for name, arguments in jobs.items()
        }
        _wait(ray, list(names))
        failed = {}
        for reference, name in names.items():
            try:
                status = ray.get(reference)
            except ray.exceptions.RayError as error:
                failed[name] = str(error).strip().splitlines()[-1]
            else:
                if status:
                    failed[name] = f"status {status}"
    _raise_failures(failed, len(jobs))


def _wait(ray: Any, references: list[Any]) -> None:
    """Wait until all tasks are done; pass a signal that is received on to them."""
    with Interruption() as interruption:
        pending = references
        while pending and interruption.signal is None:
            _, pending = ray.wait(
                pending, num_returns=len(pending), timeout=_SECONDS_BETWEEN_POLLS
            )
        if interruption.signal is not None:
            for reference in pending:
                # Without force the job receives it as Ctrl-C, and saves.
                ray.cancel(reference, force=False)
            ray.wait(references, num_returns=len(references))
            raise Interrupted(interruption.signal)
