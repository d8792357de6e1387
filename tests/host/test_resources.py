"""Memory is estimated before a run; memory during one: test_resume.py."""

import re

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


@pytest.mark.parametrize(
    ("agent", "changes"),
    [
        pytest.param(
            *("ppo+bc", {"num_envs": 64, "batch_steps": 8192}),
            marks=[pytest.mark.compiled_as_for_users, pytest.mark.slow],
        ),
        ("ppo+sil", {"sil_buffer_steps": 50_000}),
        pytest.param("ppo+sil", {"sil_minibatch_size": 50_000}, marks=pytest.mark.slow),
        pytest.param(
            *("ppo+gasil", {"discriminator_minibatch_size": 50_000}),
            marks=pytest.mark.slow,
        ),
        ("ppo", {"hidden_sizes": (1500, 1500)}),
    ],
)
def test_the_estimate_is_within_a_factor_of_two(agent, changes):
    env = gasil_jax.make_env("point_mass")
    algorithm = gasil_jax.algorithm(agent, **changes)
    members = make_members(env, algorithm, range(3), devices=jax.devices()[:1])
    states = jax.eval_shape(members.init)
    account = members.advance.lower(states, np.int32(0), ()).compile().memory_analysis()
    total = account.temp_size_in_bytes + account.argument_size_in_bytes
    assert 0.5 < 3 * resources.need(env, algorithm).memory / total < 2.0


def test_a_run_that_cannot_fit_is_refused_with_numbers(monkeypatch, tmp_path, capsys):
    arguments = [*FLAGS, "--seeds", "3", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(resources, "available", lambda devices: 10_000)
    assert "a single seed needs about" in refused(capsys, run, *arguments)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("agent", "changes", "part"),
    [
        ("ppo+bc", {"buffer_steps": 10**8}, "the state of agent 'ppo+bc', with buffer"),
        ("ppo", {"batch_steps": 2**24}, "outputs of layers, with batch_steps 16777216"),
        ("ppo", {"batch_steps": 2**24, "hidden_sizes": (8,)}, "batches, with batch_st"),
        ("ppo+sil", {"sil_buffer_steps": 10**8}, "the state of agent 'ppo+sil', with"),
        ("ppo+sil", {"sil_minibatch_size": 10**9}, "outputs of layers, with sil_minib"),
        ("gasil", {"discriminator_minibatch_size": 10**9}, "outputs of layers, with d"),
        ("ppo", {"hidden_sizes": (10**6,)}, "outputs of layers, with batch_steps 2048"),
        ("ppo", {"hidden_sizes": (10**5, 10**5)}, "networks"),
    ],
)
def test_what_needs_most_memory_is_named(agent, changes, part, monkeypatch):
    monkeypatch.setattr(resources, "available", lambda devices: 10_000)
    algorithm = gasil_jax.algorithm(agent, **changes)
    one = resources.need(gasil_jax.make_env("point_mass"), algorithm)
    with pytest.raises(ValueError, match=f"most is for {re.escape(part)}"):
        resources.check_memory(one, algorithm, 1, jax.devices()[:1])


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


def test_a_container_has_what_others_in_it_leave(tmp_path):
    """Each control group's limit holds, also those of the groups around it."""
    own, root = tmp_path / "own", tmp_path / "groups"
    own.write_text("0::/jobs/mine\n")

    def write(group, limit):
        values = {"max": limit, "current": "700", "stat": "anon 3\ninactive_file 50\n"}
        group.mkdir(parents=True, exist_ok=True)
        for name, text in values.items():
            (group / f"memory.{name}").write_text(text)

    write(root, "9000")
    write(root / "jobs" / "mine", "1000")
    assert resources._free_in_control_groups(root, own) == [350, 8350]
    write(root / "jobs", "900")
    assert min(resources._free_in_control_groups(root, own)) == 250
    write(root / "jobs", "max\n")
    assert min(resources._free_in_control_groups(root, own)) == 350
    # Without a namespace of its own, a container sees its group at the root.
    own.write_text("0::/not/mounted/here\n")
    assert resources._free_in_control_groups(root, own) == [8350]
    own.write_text("0::/\n")
    assert resources._free_in_control_groups(root, own) == [8350]
    assert resources._free_in_control_groups(root, tmp_path / "none") == []


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
    fits = lambda size, count: resources.check_memory(
        resources.Need(size, "networks"), algorithm, count, devices
    )
    fits(80_000, 8)
    fits(40_000, 16)
    for size, count, message in (
        (81_000, 1, "a single seed needs .* are free: most is for networks"),
        (81_000, 8, "a single seed needs about 0.08 MB"),
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


def test_the_limit_of_a_container_counts_as_cores(tmp_path):
    root, own = tmp_path / "cgroup", tmp_path / "own"

    def limit(folder, **files):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in files.items():
            (folder / name.replace("__", ".")).write_text(text)

    cores = environments.available_cores(root, own)
    own.write_text("0::/jobs/one\n")
    limit(root / "jobs/one", cpu__max="max 100000\n")
    assert environments.available_cores(root, own) == cores
    limit(root / "jobs", cpu__max="50000 100000\n")
    assert environments.available_cores(root, own) == 1
    limit(root / "jobs", cpu__max=f"{10**9} 1000\n")
    assert environments.available_cores(root, own) == cores
    # The first version, in which each resource has its own hierarchy.
    own.write_text("5:memory:/\n4:cpu,cpuacct:/docker/x\n")
    quota = {"cpu__cfs_quota_us": "-1\n", "cpu__cfs_period_us": "100000\n"}
    limit(root / "cpu/docker/x", **quota)
    assert environments.available_cores(root, own) == cores
    limit(root / "cpu/docker", **{**quota, "cpu__cfs_quota_us": "90000\n"})
    assert environments.available_cores(root, own) == 1
