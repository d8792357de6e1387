"""Engines that run the shards of a sweep: ``python -m gasil_jax.sweep --launcher ray``.

A launcher is given a command line for each job, has them run, each in a process of its
own, runs those again whose process died (a job goes on from its checkpoint), and
returns when all are done. Adding one is a function and a line in `LAUNCHERS`.
"""

import contextlib
import importlib
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from gasil_jax.errors import InputError, unknown
from gasil_jax.host.interruption import Interrupted, Interruption

#: How often a job is run again after its process died.
RETRIES = 3
_SECONDS_BETWEEN_LOOKS = 1.0
_BAD_INPUT = 2

Jobs = Mapping[str, Sequence[str]]
Launcher = Callable[[str, Jobs, int | None], None]


def check(name: str) -> None:
    """Raise `InputError` for a launcher that is unknown or not installed."""
    if name not in LAUNCHERS:
        raise InputError(unknown("launcher", name, tuple(LAUNCHERS)))
    if name == "ray":
        _ray_package()


def _refuse_failed(failed: Mapping[str, str]) -> None:
    """Raise `ChildProcessError` that names jobs and why, if there are any."""
    if failed:
        told = ", ".join(f"{name} ({why})" for name, why in failed.items())
        raise ChildProcessError(
            f"{told} failed; the others are done, and the same command goes on"
        )


def run_locally(program: str, jobs: Jobs, devices: int | None) -> None:
    """Run jobs on this machine one after another, each with all of its devices.

    Args:
      program: the module that is started.
      jobs: arguments of each, by a name that messages use.
      devices: not looked at: it is among the arguments.

    Raises:
      ChildProcessError: jobs have failed; the others are done.
      Interrupted: by a signal, which the running job was sent too.
    """
    failed = {}
    for name, arguments in jobs.items():
        for _ in range(1 + RETRIES):
            status = _run_process([sys.executable, "-m", program, *arguments])
            if status in (0, _BAD_INPUT):
                break
        if status:
            failed[name] = f"status {status}"
    _refuse_failed(failed)


def _run_process(command: Sequence[str]) -> int:
    """Its exit status, negative if a signal has killed it."""
    with Interruption() as interruption:
        # In a session of its own Ctrl-C reaches it once, from here.
        child = subprocess.Popen(command, start_new_session=True)
        while True:
            with contextlib.suppress(subprocess.TimeoutExpired):
                status = child.wait(_SECONDS_BETWEEN_LOOKS)
                break
            if interruption.signal is not None:
                child.send_signal(interruption.signal)
                child.wait()
                raise Interrupted(interruption.signal)
    if interruption.signal is not None:
        raise Interrupted(interruption.signal)
    return status


class _Unfinished(Exception):
    """A job that ended before its time, and can go on."""


def _run_module(program: str, arguments: Sequence[str]) -> int:
    """Run a command line in this process; returns its exit status.

    Raises:
      _Unfinished: it was interrupted, or its folder could not be written.
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
    """Connected to the cluster of RAY_ADDRESS, or one that is there, or a new one."""
    began = not ray.is_initialized()
    if began:
        ray.init()
    try:
        yield
    finally:
        if began:
            ray.shutdown()


def run_on_ray(program: str, jobs: Jobs, devices: int | None) -> None:
    """Run jobs as tasks of a Ray cluster: a GPU each where it has GPUs, else CPUs.

    A task whose worker or node died is run again elsewhere.

    Args:
      program: the module that is started; workers must have it.
      jobs: arguments of each, by a name that messages use. Folders in them must be the
        same on every node.
      devices: CPU devices of a job, and CPUs that it occupies; default 1.

    Raises:
      ChildProcessError: jobs have failed; the others are done.
      InputError: no node has so much.
      Interrupted: by a signal, which the running jobs were sent too.
    """
    ray = _ray_package()
    with _connected(ray):
        if ray.cluster_resources().get("GPU", 0) >= 1:
            needs = {"num_cpus": 1, "num_gpus": 1}
        else:
            needs = {"num_cpus": devices or 1, "num_gpus": 0}
            # A job alone would take every core of its node for itself.
            more = [] if devices else ["--devices", "1"]
            jobs = {name: [*arguments, *more] for name, arguments in jobs.items()}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if not any(node.get("CPU", 0) >= needs["num_cpus"] for node in nodes):
            raise InputError(
                f"devices is {devices}: no node of the cluster has so many CPUs"
            )
        # JAX takes its devices once in a process, so each job has a process; and it
        # dies with the job's, so that nothing holds the folder when it runs again.
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
    _refuse_failed(failed)


def _wait(ray: Any, references: list[Any]) -> None:
    """Until all are done; a signal is passed on to them."""
    with Interruption() as interruption:
        pending = references
        while pending and interruption.signal is None:
            _, pending = ray.wait(
                pending, num_returns=len(pending), timeout=_SECONDS_BETWEEN_LOOKS
            )
        if interruption.signal is not None:
            for reference in pending:
                # Not forced: it comes as Ctrl-C, and the job saves.
                ray.cancel(reference, force=False)
            ray.wait(references, num_returns=len(references))
            raise Interrupted(interruption.signal)


LAUNCHERS: Mapping[str, Launcher] = {"local": run_locally, "ray": run_on_ray}
