"""What doing nothing returns."""

import jax

import gasil_jax
from experiments import doing_nothing
from experiments.search import TASKS


def test_zero_actions_are_measured_like_a_policy():
    env = gasil_jax.make_env("point_mass")
    returned = doing_nothing.measure(env, jax.random.key(0), 8)
    assert returned.low <= returned.mean <= returned.high
    assert returned == doing_nothing.measure(env, jax.random.key(0), 8)


def test_each_task_of_the_paper_s_protocol_has_its_return():
    assert [*doing_nothing.stored()] == [*TASKS[:5]]
    # An ant that stands still is paid 1 a step.
    assert doing_nothing.stored()["ant"].low > 900
