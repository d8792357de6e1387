"""Memory is estimated before a run; memory during one: test_resume.py."""

import jax
import numpy as np
import pytest
from refusals import refused
from small_training import FLAGS

import gasil_jax
from gasil_jax import config, run
from gasil_jax.errors import InputError
from gasil_jax.host import environments, resources
from gasil_jax.host.members import make_members


def slow(*case):
    return pytest.param(*case, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("agent", "changes"),
    [
        ("ppo+sil", {"sil_buffer_steps": 50_000}),
        ("ppo", {"hidden_sizes": (1500, 1500)}),
        slow("ppo+bc", {"num_envs": 64, "batch_steps": 8192}),
    ],
)
def test_the_estimate_is_within_a_factor_of_two(agent, changes):
    env = gasil_jax.make_env("point_mass")
    algorithm = gasil_jax.algorithm(agent, **changes)
    members = make_members(env, algorithm, range(3), devices=jax.devices()[:1])
    states = jax.eval_shape(members.init)
    account = members.advance.lower(states, np.int32(0), ()).compile().memory_analysis()
    total = account.temp_size_in_bytes + account.argument_size_in_bytes
    assert 0.5 < 3 * resources.need(env, algorithm) / total < 2.0


def test_a_run_that_cannot_fit_is_refused_with_numbers(monkeypatch, tmp_path, capsys):
    arguments = [*FLAGS, "--seeds", "3", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(resources, "available", lambda devices: 10_000)
    assert "free: at most 0 fit" in refused(capsys, run, *arguments)
    assert not (tmp_path / "out").exists()


class Wide(gasil_jax.Agent):
    rows: int = config.count(1)

    def update_and_reward(self, state, context, key):
        rows = jax.random.normal(key, (self.rows, 1000))
        return state, context.rollout.reward + rows.mean(), {}


def test_any_count_that_shapes_a_large_array_is_refused_before_compiling(monkeypatch):
    monkeypatch.setattr(jax.stages.Lowered, "compile", None)
    env = gasil_jax.make_env("point_mass")
    algorithm = gasil_jax.Algorithm(Wide(rows=2**31 - 1))
    told = (
        r"an array of shape \(1, 2147483647, 1000\), with rows 2147483647: it needs 8"
    )
    with pytest.raises(InputError, match=told):
        make_members(env, algorithm, [0]).compile()


def write_group(folder, **values):
    """Write the files of a control group."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in values.items():
        (folder / name.replace("_", ".", 1)).write_text(text)


def test_a_container_has_what_others_in_it_leave(tmp_path):
    """Each control group's limit holds, also those of the groups around it."""
    own, root = tmp_path / "own", tmp_path / "groups"
    own.write_text("0::/jobs/mine\n")
    used = {"memory_current": "700", "memory_stat": "anon 3\ninactive_file 50\n"}
    write_group(root, memory_max="9000", **used)
    write_group(root / "jobs" / "mine", memory_max="1000", **used)
    assert resources._free_in_control_groups(root, own) == [350, 8350]
    write_group(root / "jobs", memory_max="900", **used)
    assert min(resources._free_in_control_groups(root, own)) == 250
    write_group(root / "jobs", memory_max="max\n")
    assert min(resources._free_in_control_groups(root, own)) == 350
    # Without a namespace of its own, a container sees its group at the root.
    own.write_text("0::/not/mounted/here\n")
    assert resources._free_in_control_groups(root, own) == [8350]
    assert resources._free_in_control_groups(root, tmp_path / "none") == []


def test_the_limit_of_a_container_counts_as_cores(tmp_path):
    root, own = tmp_path / "cgroup", tmp_path / "own"
    cores = environments.available_cores(root, own)
    own.write_text("0::/jobs/one\n")
    write_group(root / "jobs/one", cpu_max="max 100000\n")
    assert environments.available_cores(root, own) == cores
    write_group(root / "jobs", cpu_max="50000 100000\n")
    assert environments.available_cores(root, own) == 1
    # The first version, in which each resource has its own hierarchy.
    own.write_text("5:memory:/\n4:cpu,cpuacct:/docker/x\n")
    no_limit = {"cpu_cfs_quota_us": "-1\n", "cpu_cfs_period_us": "100000\n"}
    write_group(root / "cpu/docker/x", **no_limit)
    assert environments.available_cores(root, own) == cores
    write_group(root / "cpu/docker", **no_limit | {"cpu_cfs_quota_us": "90000\n"})
    assert environments.available_cores(root, own) == 1


class Device:
    platform = "gpu"

    def __init__(self, used):
        self.used = used

    def memory_stats(self):
        return {"bytes_limit": 100_000, "bytes_in_use": self.used}


def test_members_have_equal_shares_of_the_devices_that_are_used():
    """One that is larger than a device does not fit eight, nor nine half as large."""
    devices = [Device(20_000), *[Device(10_000)] * 7]
    assert resources.available(devices) == 8 * 80_000
    assert resources.available(devices[1:2]) == 90_000
    algorithm = gasil_jax.algorithm()
    fits = lambda size, count: resources.check_memory(size, algorithm, count, devices)
    fits(80_000, 8)
    fits(40_000, 16)
    for size, count, message in (
        (81_000, 1, "about 0.08 MB of memory, .* 0.08 MB are free: at most 0 fit"),
        (81_000, 8, "seeds are 8 .* at most 0 fit"),
        (41_000, 9, "seeds are 9 .* at most 8 fit"),
    ):
        with pytest.raises(ValueError, match=message):
            fits(size, count)
    env = gasil_jax.make_env("point_mass")
    resources.check_episodes(env, 100, 8, devices)
    with pytest.raises(
        ValueError, match="episodes is 100: the episodes of 80 policies"
    ):
        resources.check_episodes(env, 100, 80, devices)


def test_available_memory_is_read():
    free = resources.available(jax.devices())
    assert free is None or 10**7 < free < 10**14
