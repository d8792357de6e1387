"""Start training from the policy of another run, as a first checkpoint."""

import functools
import pathlib
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from gasil_envs import user_code
from gasil_jax import train
from gasil_jax.errors import InputError
from gasil_jax.host import checkpoint, saved, sweep
from gasil_jax.host.members import make_members, member
from gasil_jax.host.programs import Program
from gasil_jax.host.sweep import Start


def find(folder: pathlib.Path) -> Start:
    """Return the policy of a run's best seed, in its newest checkpoint."""
    point, seed = saved.best_of(folder, None)
    every = saved.programs_of(folder, sweep.read(folder), point)
    seed = every[0].seeds[0] if seed is None else seed
    (path,) = (x.path for x in every if seed in x.seeds)
    newest, _ = checkpoint.latest(path / "checkpoints")
    if newest is None:
        raise InputError(f"run is {folder}: it has no whole checkpoint")
    return Start(str(folder.absolute()), seed, newest.digest())


def load(start: Start, env: Any, every: Sequence[Program]) -> Any:
    """Return the trained state that programs start from; None if all have begun."""
    if not (fresh := _without_checkpoint(every)):
        return None
    folder = pathlib.Path(start.run)
    if find(folder).sha256 != start.sha256:
        raise InputError(
            f"init_from is {folder}, which has been trained since: what began from its "
            "earlier policy can't begin anew"
        )
    *_, trained = saved.load(folder, seed=start.seed)
    for each in fresh:
        first = functools.partial(train.first_state, env, each.algorithm)
        parts = [
            (x.actor_critic.policy.params, x.normalizer)
            for x in (jax.eval_shape(first, jax.random.key(0)), member(trained, 0))
        ]
        if change := user_code.first_change(*parts):
            where, own, other = change
            raise InputError(
                f"init_from is {folder}, whose policy has another form: {where} is "
                f"{other} and not {own}"
            )
    return trained


def begin(trained: Any, env: Any, every: Sequence[Program]) -> None:
    """Write a first checkpoint, with a trained policy, in programs that have none."""

    def spread(new: Any, old: Any) -> Any:
        return jax.tree.map(lambda x, y: jnp.broadcast_to(y, x.shape), new, old)

    def learned(new: Any, old: Any) -> Any:
        return new.replace(params=spread(new.params, old.params))

    old = trained.actor_critic
    for each in _without_checkpoint(every):
        own = make_members(env, each.algorithm, each.seeds, each.hyperparameters)
        states = own.trim(own.init())
        # All else, such as optimizers and buffers, is as in a new run.
        now, values = states.actor_critic, states.actor_critic.values
        # Another agent may have more streams of rewards, each with its values.
        if len(values) == len(old.values):
            values = tuple(map(learned, values, old.values))
        policy = learned(now.policy, old.policy)
        states = states.replace(
            actor_critic=now.replace(policy=policy, values=values),
            normalizer=spread(states.normalizer, trained.normalizer),
        )
        record = checkpoint.Record(metrics_rows=0, evaluations_rows=0, score=None)
        with each.opened():
            checkpoint.write(each.path / "checkpoints", 0, states, record)


def _without_checkpoint(every: Sequence[Program]) -> list[Program]:
    return [x for x in every if checkpoint.latest(x.path / "checkpoints")[0] is None]
