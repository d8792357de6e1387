"""Settings that all tests share: two devices, a cache, how programs are compiled."""

import atexit
import gc
import importlib.metadata
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
# XLA reports an error for each program that it loads, where tests compare the output.
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
# By default programs that compile in less than a second are compiled by each process.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.1")

# Without fusion emitters XLA's CPU backend generates code in a third of the time, and
# with less work in one part than in 32 for as many threads. Later releases cannot do
# without the emitters, and end the process at a flag that they do not know.
if importlib.metadata.version("jaxlib").startswith("0.10."):
    _flags = os.environ.get("XLA_FLAGS", "")
    _flags += " --xla_cpu_use_fusion_emitters=false"
    _flags += " --xla_cpu_parallel_codegen_split_count=1"
    os.environ["XLA_FLAGS"] = _flags.strip()

# Where each operation was written is in no result; to note it takes a twentieth.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
# What JAX traces and compiles stays alive: to look through all of it as often as Python
# does by default takes a twentieth of the time.
gc.set_threshold(100_000, 20, 20)

# Compiling takes most of the time, so most of XLA's optimizations are turned off. Tests
# with this mark check XLA's numbers or its memory, and are compiled as for users.
_AS_FOR_USERS = "compiled_as_for_users"
# Modules with tests that take long by themselves, or together on one worker.
_LONG = {"test_examples", "test_figures", "test_fitting", "test_ray", "test_readme"}
_LONG |= {"test_report", "test_resume", "test_sweep"}


def pytest_configure(config):
    """Say what our mark means, so that pytest knows it."""
    text = f"{_AS_FOR_USERS}: compile with all of XLA's optimizations"
    config.addinivalue_line("markers", text)


def pytest_collectstart():
    """Give two devices their threads, before a module of tests starts JAX.

    Not earlier: of several processes, one only hands out tests and needs no imports.
    """
    from gasil_envs.physics import host_threads

    host_threads.reserve(2)


def pytest_collection_finish():
    """Look no more through what has been imported."""
    gc.freeze()


def _is_optimized(item):
    return item.get_closest_marker(_AS_FOR_USERS) is not None


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """Set how far programs are optimized, here and in the processes a test starts."""
    import jax

    plainly = not _is_optimized(item)
    before = os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS", "0")
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(plainly))
    if before != str(int(plainly)):
        jax.config.update("jax_disable_most_optimizations", plainly)
        # JAX keeps compiled programs whatever the setting, and they round otherwise.
        jax.clear_caches()
        _programs.clear()


# The compiled first states and training of members, by all that they depend on.
_programs = {}


@pytest.fixture(autouse=True, scope="session")
def equal_members_share_a_program():
    """Trace and compile the training of equal members once in a session.

    Members are equal if they are trained by the same algorithm, whatever its numbers,
    in the same environment, or in one that was made by the same name with the same
    settings. Yields the programs, for a test that needs one to be compiled. Without it
    three files of tests/host (evaluations, disks, folders) took 83 seconds of a
    processor, and not 61.
    """
    import jax

    from gasil_envs import registry
    from gasil_jax.host.members import Members

    jax.devices()  # The first run would start as many as it has members.
    compile_ = Members.compile

    def compiled(self, states=None):
        if jax.tree.leaves(self.data):
            return compile_(self, states)
        # A class of the same name may be another one.
        kind = type(getattr(self.env, "unwrapped", None))
        made = registry.made_with(self.env) or id(self.env)
        numbers = dict.fromkeys(self.algorithm.hyperparameters, 0.0)
        padded = self.num_members + self._padding
        key = (kind, made, self.algorithm.replace(**numbers), padded, *self.devices)
        if key in _programs:
            vars(self)["first_states"], advance, _ = _programs[key]
            states = self.init() if states is None else self.to_devices(states)
        else:
            states, advance = compile_(self, states)
            # The environment stays alive, so that no other one gets its id.
            _programs[key] = self.first_states, advance, self.env
        return states, advance

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Members, "compile", compiled)
        yield _programs


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Order the tests, and give those that share a module's fixture to one worker.

    Programs that are compiled alike come together, since JAX forgets them all when that
    changes. Long tests come before the others, so that none is left at the end.
    """
    items.sort(
        key=lambda item: (not _is_optimized(item), item.module.__name__ not in _LONG)
    )
    for item in items:
        fixtures = item._fixtureinfo.name2fixturedefs.values()
        if any(definitions[-1].scope == "module" for definitions in fixtures):
            item.add_marker(pytest.mark.xdist_group(item.module.__name__))


@pytest.fixture
def figures(monkeypatch):
    """The figures that are saved in a test; their files are empty."""
    from matplotlib.figure import Figure

    kept = []

    def keep(figure, path, **_):
        kept.append(figure)
        path.touch()

    monkeypatch.setattr(Figure, "savefig", keep)
    return kept


def _untrained(out, env, **settings):
    """Write a run's folder with a first checkpoint: no training compiles."""
    import jax
    import numpy as np

    import gasil_jax
    from gasil_jax.host import checkpoint, training
    from gasil_jax.host.environments import Settings
    from gasil_jax.host.sweep import Sweep

    layers = {"hidden_sizes": (8,), "discriminator_hidden_sizes": (8,)}
    sizes = {"num_envs": 1, "batch_steps": 64, "buffer_steps": 200}
    algorithm = gasil_jax.algorithm(**sizes, **layers)
    sweep = Sweep(env, algorithm, (0,), settings=Settings(**settings))
    out.mkdir()
    sweep.write(out)
    made = training.make_env(sweep)
    init = jax.vmap(lambda seed: gasil_jax.init(made, algorithm, jax.random.key(seed)))
    states = jax.jit(init)(np.arange(1, dtype=np.uint32))
    (program,) = sweep.unfinished(out)
    record = checkpoint.Record(metrics_rows=0, evaluations_rows=0, score=None)
    with program.opened():
        checkpoint.write(program.path / "checkpoints", 0, states, record)
    return out


@pytest.fixture(scope="session")
def untrained_hopper(tmp_path_factory):
    """The folder of a run on hopper, with C MuJoCo."""
    out = tmp_path_factory.mktemp("hopper") / "run"
    return _untrained(out, "hopper", physics="mujoco")


@pytest.fixture(scope="session")
def untrained_point_mass(tmp_path_factory):
    """The folder of a run on the point mass."""
    return _untrained(tmp_path_factory.mktemp("point_mass") / "run", "point_mass")
