"""The profile's table, and the parts that operations belong to."""

from types import SimpleNamespace

import jax
import pytest

from experiments import __main__ as experiments
from experiments import measured, profile


@pytest.fixture
def cache_settings():
    name = "jax_compilation_cache_include_metadata_in_key"
    before = getattr(jax.config, name)
    yield
    jax.config.update(name, before)


@pytest.fixture
def page(tmp_path, monkeypatch):
    """A function that puts a command into a page of its own, and returns the page."""

    def having(command):
        path = tmp_path / "performance.md"
        table = f"$ {command}\n```\n\n<!-- begin -->\nbefore\n<!-- end -->"
        other = table.replace(command, "python -m experiments profile --seeds 7")
        path.write_text(f"{other}\n\n{table}\n")
        monkeypatch.setattr(measured, "PAGE", path)
        return path

    return having


def test_every_part_of_an_iteration_is_in_the_table(cache_settings, page, capsys):
    toy = "profile --env point_mass --seeds 2 --iterations 1 --repeats 1"
    written = page(f"taskset -c 0 python -m experiments {toy}")
    assert experiments.main([*toy.split(), "--page"]) == 0
    title, *lines = capsys.readouterr().out.splitlines()
    other, ours = written.read_text().split(toy)
    assert "before" in other and "before" not in ours
    for line in lines:
        assert f"| {line[:30].strip()} | {' | '.join(line[30:].split())} |\n" in ours
    assert title.startswith("point_mass, ppo+gasil, 2 seeds")
    rows = {line[:30].strip(): [float(x) for x in line[30:].split()] for line in lines}
    for part in (*profile.PARTS, "host: metrics.csv"):
        # There is no physics, and the preset leaves rewards as they are.
        absent = part.startswith(("physics", "rewards", "agent's"))
        assert part in rows or absent, part
    *parts, total, whole = rows.values()
    assert total[0] == pytest.approx(sum(time for time, _ in parts), abs=0.1)
    assert total[1] == 1 and whole[0] > 0
    # Little belongs to no part.
    assert rows["the rest"][1] < 0.1


def plane(name, **seconds):
    event = lambda name, s: SimpleNamespace(name=name, duration_ns=s * 1e9)
    events = [event(name, s) for name, each in seconds.items() for s in each]
    return SimpleNamespace(name=name, lines=[SimpleNamespace(events=events)])


def test_the_times_of_a_gpu_are_those_of_its_kernels():
    program = """ENTRY %main (x: f32[]) -> f32[] {
  %loop_add_fusion.1 = f32[] fusion(%x), metadata={op_name="jit(f)/ppo/add"}
}
"""
    host = plane("/host:CPU", **{"loop_add_fusion.1": [50.0], "call": [9.0]})
    gpu = plane("/device:GPU:0", loop_add_fusion_1=[1.0, 2.0, 6.0], MemcpyD2D=[3.0])
    totals = profile.seconds_of_parts([host, gpu], program)
    assert totals["PPO: minibatches"] == 6.0 and totals["the rest"] == 3.0
    totals = profile.seconds_of_parts([host], program)
    assert totals["PPO: minibatches"] == 50.0 and totals["the rest"] == 0.0


def test_operations_belong_to_the_scopes_that_they_were_written_in():
    program = """HloModule toy
%body (x: f32[]) -> f32[] {
  %dot.1 = f32[2]{0} dot(%x, %x), metadata={op_name="jit(f)/vmap(ppo)/while/body/dot"}
  ROOT %copy.1 = f32[2]{0} copy(%dot.1)
}

ENTRY %main (x: f32[]) -> f32[] {
  %while.1 = f32[] while(%x), body=%body, metadata={op_name="jit(f)/ppo/while"}
  %call.1 = f32[] call(%x), to_apply=%g, metadata={op_name="jit(f)/ppo/jit(g)"}
  %step.1 = f32[] call(%x), to_apply=%s, frontend_attributes={inlineable="false",\
xla_cpu_small_call="true"}, metadata={op_name="jit(f)/vmap(physics)/jit(tiled)"}
  %sort.1 = f32[] sort(%x), metadata={op_name="jit(f)/ppo/permutation/sort"}
  ROOT %add.1 = f32[] add(%x, %x), metadata={op_name="jit(f)/add"}
}
"""
    assert profile.operations(program) == {
        "dot.1": "PPO: minibatches",
        "copy.1": "PPO: minibatches",
        "step.1": "physics",
        "sort.1": "PPO: permutations",
        "add.1": "the rest",
    }
