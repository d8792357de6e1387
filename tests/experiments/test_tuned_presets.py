"""The tuned presets are what the stored searches chose."""

import dataclasses

import pytest

import gasil_jax
from experiments.search import ADAPTIVE, AGENTS, DELAY, PAIR, TASKS, Search
from experiments.store import RESULTS, Store


@pytest.mark.parametrize("reward_delay", [1, DELAY])
@pytest.mark.parametrize("env", TASKS)
def test_the_tuned_rows_are_what_the_searches_chose(env, reward_delay):
    store = Store(RESULTS / "runs")
    for agent in AGENTS:
        if agent not in gasil_jax.agents.AGENTS:
            continue
        search = Search(env, agent, reward_delay)
        # Adaptive imitation has one setting for all other tasks.
        if agent == ADAPTIVE and not (reward_delay > 1 and env in ("ant", "humanoid")):
            continue
        others = [dataclasses.replace(search, chooser=x) for x in PAIR]
        tuned = gasil_jax.preset(env, agent, reward_delay=reward_delay)
        assert tuned in [x.algorithm(x.chosen(store)) for x in (search, *others)]
