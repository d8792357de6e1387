"""Speed and fidelity of the locomotion tasks: ``python -m experiments.benchmark``.

For each way of building a task, on the default device: environment steps a second of
random actions under jit, vmap and scan, seconds to compile, and the relative error of
one step (the worst entry of the observation, median over the environments) against C
MuJoCo with the model's own integrator, which is Gymnasium's.
"""

import argparse
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import gasil_envs

TASKS = tuple(name for name in gasil_envs.names() if name != "point_mass")
VARIANTS = {
    "mjx": {"solver": "mjx"},
    "ours": {},
    "mujoco": {"physics": "mujoco"},
    "ours-euler": {"integrator": "euler"},
    "mujoco-euler": {"physics": "mujoco", "integrator": "euler"},
}


def make_rollout(env: Any, num_envs: int, num_steps: int) -> Any:
    """From states and a key to the states after random actions, and mean rewards."""
    low, high = env.action_range

    def step(states: Any, key: jax.Array) -> Any:
        action_key, reset_key = jax.random.split(key)
        shape = (num_envs, env.action_size)
        action = jax.random.uniform(action_key, shape, minval=low, maxval=high)
        stepped = jax.vmap(env.step)(states, action)
        fresh = jax.vmap(env.reset)(jax.random.split(reset_key, num_envs))
        done = stepped.done > 0

        def restart(first: jax.Array, now: jax.Array) -> jax.Array:
            at = done.reshape((-1,) + (1,) * (now.ndim - 1))
            return jnp.where(at, first, now).astype(now.dtype)

        return jax.tree.map(restart, fresh, stepped), stepped.reward.mean()

    def rollout(states: Any, key: jax.Array) -> Any:
        return jax.lax.scan(step, states, jax.random.split(key, num_steps))

    return rollout


def measure(env: Any, num_envs: int, num_steps: int) -> tuple[float, float]:
    """Environment steps a second, the best of three rollouts, and compile seconds."""
    keys = jax.random.split(jax.random.key(0), num_envs)
    states = jax.jit(jax.vmap(env.reset))(keys)
    rollout = make_rollout(env, num_envs, num_steps)
    began = time.perf_counter()
    compiled = jax.jit(rollout).lower(states, keys[0]).compile()
    compile_seconds = time.perf_counter() - began
    # Not from the start: most bodies have fallen to the ground after a while.
    states, _ = jax.block_until_ready(compiled(states, keys[0]))
    seconds = []
    for key in keys[1:4]:
        began = time.perf_counter()
        jax.block_until_ready(compiled(states, key))
        seconds.append(time.perf_counter() - began)
    return num_envs * num_steps / min(seconds), compile_seconds


def one_step_error(env: Any, reference: Any, num_envs: int, num_steps: int) -> float:
    """Median relative error of the observation after one step from the same states."""
    keys = jax.random.split(jax.random.key(1), num_envs)
    states = jax.jit(jax.vmap(reference.reset))(keys)
    states, _ = jax.jit(make_rollout(reference, num_envs, num_steps))(states, keys[0])
    low, high = env.action_range
    shape = (num_envs, env.action_size)
    action = jax.random.uniform(keys[1], shape, minval=low, maxval=high)
    right = np.asarray(jax.jit(jax.vmap(reference.step))(states, action).obs)
    obs = np.asarray(jax.jit(jax.vmap(env.step))(states, action).obs)
    error = np.abs(obs - right) / (1.0 + np.abs(right))
    return float(np.median(error.max(axis=1)))


def main() -> int:
    """Print a row for each task and variant."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=VARIANTS)
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--num-steps", type=int, default=20)
    options = parser.parse_args()
    jax.config.update("jax_default_matmul_precision", "highest")
    device = jax.devices()[0].device_kind
    print(f"{options.num_envs} environments on {device}")
    print("task         variant       steps/s  compile s  error of a step", flush=True)
    size = (options.num_envs, options.num_steps)
    for name in options.envs:
        reference = gasil_envs.make(name, physics="mujoco")
        for variant in options.variants:
            env = gasil_envs.make(name, **VARIANTS[variant])
            speed, seconds = measure(env, *size)
            error = one_step_error(env, reference, *size)
            row = f"{speed:9,.0f}  {seconds:9.1f}  {error:.1e}"
            print(f"{name:12} {variant:12} {row}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
