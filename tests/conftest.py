"""Shared settings: two host devices and a cache, before anything starts JAX."""

import atexit
import os
import shutil
import tempfile

import pytest

os.environ.setdefault("JAX_NUM_CPU_DEVICES", "2")
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # Of this session alone; its workers and the programs that it starts share it.
    _cache = tempfile.mkdtemp(prefix="gasil-jax-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _cache
    atexit.register(shutil.rmtree, _cache, ignore_errors=True)

from gasil_envs.physics import native

native.reserve_threads(2)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """One worker for the tests that share a module's fixture: it is made once."""
    for item in items:
        found = item._fixtureinfo.name2fixturedefs.values()
        if any(definitions[-1].scope == "module" for definitions in found):
            item.add_marker(pytest.mark.xdist_group(item.module.__name__))


@pytest.fixture(scope="session")
def untrained_hopper(tmp_path_factory):
    """The folder of a run on hopper with a first checkpoint: no training compiles."""
    import jax
    import numpy as np

    import gasil_jax
    from gasil_jax import checkpoint, run
    from gasil_jax.environments import Settings

    out = tmp_path_factory.mktemp("hopper") / "run"
    config = gasil_jax.Config(
        num_envs=1, batch_steps=64, hidden_sizes=(8,), discriminator_hidden_sizes=(8,)
    )
    settings = Settings(physics="mujoco")
    options = run.Options(env="hopper", settings=settings, config=config)
    out.mkdir()
    run.write_config(options, out)
    env = run.make_env(options)
    init = jax.vmap(lambda seed: gasil_jax.init(env, config, jax.random.key(seed)))
    states = jax.jit(init)(np.arange(1, dtype=np.uint32))
    checkpoint.write(out / "checkpoints", 0, states, {"score": None})
    return out
