"""Speed of the locomotion tasks: ``python -m experiments.benchmark``.

Environment steps a second of random actions under jit, vmap and scan, and the time to
compile, of our constraint solver and MJX's side by side, on the default device.
"""

import argparse
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp

import gasil_envs
from gasil_envs.physics.mjx import SOLVERS

TASKS = tuple(name for name in gasil_envs.names() if name != "point_mass")


def measure(
    name: str, solver: str, num_envs: int, num_steps: int
) -> tuple[float, float]:
    """Environment steps a second, the best of three rollouts, and compile seconds."""
    env = gasil_envs.make(name, solver=solver)
    low, high = env.action_range
    keys = jax.random.split(jax.random.key(0), num_envs)
    start = jax.jit(jax.vmap(env.reset))(keys)

    def step(state: Any, key: jax.Array) -> Any:
        shape = (num_envs, env.action_size)
        action = jax.random.uniform(key, shape, minval=low, maxval=high)
        stepped = jax.vmap(env.step)(state, action)
        done = stepped.done > 0

        def restart(first: jax.Array, now: jax.Array) -> jax.Array:
            at = done.reshape((-1,) + (1,) * (now.ndim - 1))
            return jnp.where(at, first, now).astype(now.dtype)

        return jax.tree.map(restart, start, stepped), stepped.reward.mean()

    def rollout(state: Any, key: jax.Array) -> Any:
        return jax.lax.scan(step, state, jax.random.split(key, num_steps))

    began = time.perf_counter()
    compiled = jax.jit(rollout).lower(start, keys[0]).compile()
    compile_seconds = time.perf_counter() - began
    jax.block_until_ready(compiled(start, keys[0]))
    seconds = []
    for key in keys[1:4]:
        began = time.perf_counter()
        jax.block_until_ready(compiled(start, key))
        seconds.append(time.perf_counter() - began)
    return num_envs * num_steps / min(seconds), compile_seconds


def main() -> int:
    """Print a row for each task."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--num-steps", type=int, default=20)
    options = parser.parse_args()
    jax.config.update("jax_default_matmul_precision", "highest")
    device = jax.devices()[0].device_kind
    print(f"{options.num_envs} environments on {device}: steps/s (compile seconds)")
    for name in options.envs:
        rows = {
            solver: measure(name, solver, options.num_envs, options.num_steps)
            for solver in SOLVERS
        }
        cells = [f"{s} {speed:8,.0f} ({t:4.0f})" for s, (speed, t) in rows.items()]
        ratio = rows["small"][0] / rows["mjx"][0]
        print(f"{name:12} {'  '.join(cells)}  ratio {ratio:.2f}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
