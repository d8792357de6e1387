"""Run a sweep's shards on a Ray cluster, each as a process of its own."""

import contextlib
import importlib
from collections.abc import Mapping, Sequence
from typing import Any

from gasil_jax.errors import InputError
from gasil_jax.host.interruption import Interrupted, Interruption

#: The largest number of times that a job is run again after its process died.
RETRIES = 3
_SECONDS_BETWEEN_POLLS = 1.0
_BAD_INPUT = 2


class _Unfinished(Exception):
    """A job ended early, and can continue when it is run again."""


def _run_module(program: str, arguments: Sequence[str]) -> int:
    """Run a command line in this process and return its exit status."""
    status = importlib.import_module(program).main(arguments)
    if status not in (0, _BAD_INPUT):
        raise _Unfinished(f"status {status}")
    return status


def run_on_ray(
    program: str, jobs: Mapping[str, Sequence[str]], devices: int | None
) -> None:
    """Run jobs on a cluster, with a GPU each if it has any; their nodes may die."""
    try:
        import ray
    except ImportError:
        raise InputError(
            "launcher is 'ray': it needs the package ray "
            '(pip install "gasil_jax[ray]")'
        ) from None
    with contextlib.nullcontext() if ray.is_initialized() else ray.init():
        failed = _failures(ray, program, jobs, devices)
    if failed:
        told = ", ".join(f"{name} ({why})" for name, why in failed.items())
        raise ChildProcessError(
            f"{told} failed, see above; the others are done. Continue with the same "
            "command and --resume"
        )


def _failures(
    ray: Any, program: str, jobs: Mapping[str, Sequence[str]], devices: int | None
) -> dict[str, str]:
    """Run jobs on a cluster; return why some have failed, by the job's name."""
    on_gpu = ray.cluster_resources().get("GPU", 0) >= 1
    # By default a job would use every core of its node.
    more = [] if on_gpu or devices else ["--devices", "1"]
    # JAX sets up its devices once per process, so each job needs its own. The process
    # ends with the job, so that the folder is free when the job runs again.
    task = ray.remote(
        max_calls=1,
        max_retries=RETRIES,
        retry_exceptions=[_Unfinished],
        num_cpus=1 if on_gpu else devices or 1,
        num_gpus=int(on_gpu),
    )(_run_module)
    names = {
        task.options(name=name).remote(program, [*arguments, *more]): name
        for name, arguments in jobs.items()
    }
    with Interruption() as interruption:
        pending = list(names)
        while pending and interruption.signal is None:
            _, pending = ray.wait(
                pending, num_returns=len(pending), timeout=_SECONDS_BETWEEN_POLLS
            )
        if interruption.signal is not None:
            for reference in pending:
                # Without force the job receives it as Ctrl-C, and saves.
                ray.cancel(reference, force=False)
            ray.wait(list(names), num_returns=len(names))
            raise Interrupted(interruption.signal)
    failed = {}
    for reference, name in names.items():
        try:
            if status := ray.get(reference):
                failed[name] = f"status {status}"
        except ray.exceptions.RayError as error:
            failed[name] = str(error).strip().splitlines()[-1]
    return failed
