"""The runs that the figures request."""

import dataclasses

import jax
import numpy as np
import pytest

import gasil_jax
from experiments.figures import CONSTANT, FIGURES, Arm, Curve, Figure, grid
from experiments.search import DELAY, PAIR
from experiments.store import RESULTS, Store
from gasil_jax.config import Config, validate

STORE = Store(RESULTS / "runs")


@pytest.mark.parametrize("name", FIGURES)
def test_every_run_of_a_figure_is_valid(name):
    runs = FIGURES[name].requested(STORE)
    for config in {run.config for run in runs}:
        validate(config, gasil_jax.agents())
    assert len(set(runs)) == len(runs)
    # The points of a search decide for the single setting.
    assert runs or name == "single_setting"


@pytest.mark.parametrize("name", FIGURES)
def test_a_figure_names_what_it_has(name):
    figure = FIGURES[name]
    names = {
        (panel, curve) for panel, curves in figure.panels.items() for curve in curves
    }
    if figure.early is not None:
        names |= {(panel, f"{curve} early") for panel, curve in names}
    for terms in figure.compared().values():
        assert {(panel, curve) for _, panel, curve in terms} <= names
        assert sum(weight for weight, _, _ in terms) == 0


#: Their pages say how many of their runs are stored.
INCOMPLETE = ("batch_geometry", "wider_search")


@pytest.mark.parametrize("name", [x for x in FIGURES if x not in INCOMPLETE])
def test_what_is_published_is_complete(name):
    if (RESULTS / f"{name}.md").exists():
        assert not STORE.missing(FIGURES[name].requested(STORE))


def test_a_curve_has_no_runs_before_its_search_has_chosen(tmp_path):
    for curve in FIGURES["mujoco"].panels["hopper"].values():
        assert curve.runs(Store(tmp_path)) == () and len(curve.runs(STORE)) == 10


def test_the_control_differs_in_the_discriminator_alone():
    for curves in FIGURES["constant_bonus"].panels.values():
        control, tuned = (curves[name].runs(STORE)[0] for name in ("constant", PAIR[1]))
        one, other = (vars(x.config.hyperparameters) for x in (control, tuned))
        changed = {name for name in one if one[name] != other[name]}
        one, other = (dict(vars(x.config)) for x in (control, tuned))
        del one["hyperparameters"], other["hyperparameters"]
        changed |= {name for name in one if one[name] != other[name]}
        assert "discriminator_entropy_coefficient" in changed
        assert all(name.startswith("discriminator_") for name in changed)


def test_the_control_s_discriminator_is_held_at_a_half():
    env = gasil_jax.make_env("point_mass")
    small = {"total_steps": 20 * 512, "batch_steps": 512, "num_envs": 8}
    probability = {}
    for name, change in (
        ("free", {**CONSTANT, "discriminator_entropy_coefficient": 1e-3}),
        ("held", CONSTANT),
    ):
        config = Config(agent="ppo+gasil").replace(**small, **change)
        _, metrics = jax.jit(gasil_jax.make_train(env, config))(jax.random.key(0))
        names = ("discriminator_good_probability", "discriminator_policy_probability")
        probability[name] = np.array([metrics[x][-1] for x in names])
    assert np.abs(probability["held"] - 0.5).max() < 0.005
    assert 0.5 - probability["free"][0] > 0.02


def test_the_figure_on_geometry_is_the_tuned_presets_with_other_environments():
    figure, runs = FIGURES["batch_geometry"], set()
    for panel, curves in figure.panels.items():
        for curve in curves.values():
            curve_runs = curve.runs(STORE)
            assert len(curve_runs) == (20 if panel.startswith("halfcheetah") else 10)
            delay = DELAY if panel.endswith("delayed") else 1
            preset = gasil_jax.preset(curve.env, curve.agent, "tuned", delay)
            config = curve_runs[0].config
            assert (config.batch_steps, config.total_steps) == (2048, 1_000_000)
            same = {
                name: getattr(preset, name) for name in ("num_envs", "stagger_episodes")
            }
            assert (
                config.replace(**same) == preset and curve_runs[0].reward_delay == delay
            )
            runs |= set(curve_runs)
    assert len(runs) == len(figure.requested(STORE)) == 960
    assert {(x.config.num_envs, x.config.stagger_episodes) for x in runs} == {
        (count, drawn) for count in (1, 8, 32, 128) for drawn in (True, False)
    }
    # Runs that an earlier figure trained with the same settings are used.
    assert len(runs) - len(STORE.missing(runs)) >= 100


def test_a_curve_changes_what_was_chosen():
    curve = FIGURES["humanoid"].panels["dense"]["ppo+gasil-from-2M"]
    scheduled, fixed = (
        x.runs(STORE)[0].config
        for x in (curve, FIGURES["humanoid"].panels["dense"]["ppo+gasil"])
    )
    assert scheduled.alpha_schedule == ((2e6, 0.0), (3e6, 1.0))
    alpha = fixed.hyperparameters.alpha
    assert scheduled.replace(alpha=alpha, alpha_schedule=()) == fixed
    bare = dataclasses.replace(curve, base="tuned", changes={})
    assert isinstance(bare, Curve) and bare.point(STORE) == {}


SHARED = {"num_envs": 64, "normalize_rewards": True}
DELAYS = Figure(
    "Delays",
    "",
    grid(
        ("hopper", "swimmer"),
        PAIR,
        (1, 5, 20, 1000),
        panel="{env}",
        curve="{arm}-{delay}",
        base=None,
        changes=SHARED,
    ),
    over=("reward_delay", "delay"),
)


def test_an_ablation_is_a_row():
    weak = Arm("weak", "ppo+gasil", {"alpha": 0.01, "num_envs": 8})
    arms = ("ppo", weak, "ppo+gasil")
    panels = grid(("hopper", "ant"), arms, (DELAY,), base=None, changes=SHARED, seeds=5)
    figure = Figure("Ablation", "", panels, favourite="ppo+gasil")
    assert list(figure.panels) == ["hopper-delayed", "ant-delayed"]
    for _, name, curve in figure.curves():
        runs = curve.runs(STORE)
        assert [run.seed for run in runs] == [0, 1, 2, 3, 4]
        assert {run.reward_delay for run in runs} == {DELAY}
        agent = "ppo" if name == "ppo" else "ppo+gasil"
        expected = Config(agent=agent, total_steps=1_000_000).replace(**SHARED)
        if name == "weak":
            expected = expected.replace(alpha=0.01, num_envs=8)
        assert runs[0].config == expected
    others = [key[1:] for key in figure.compared() if key[0] == "ant-delayed"]
    assert others == [("ppo+gasil", "ppo"), ("ppo+gasil", "weak")]


def test_a_figure_over_delays_is_a_row():
    assert list(DELAYS.panels) == ["hopper", "swimmer"]
    for _, name, curve in DELAYS.curves():
        (run, *_) = curve.runs(STORE)
        assert name == f"{run.config.agent}-{run.reward_delay}"
        assert run.config.num_envs == 64
    # Agents are compared where the delay is the same.
    others = [key[1:] for key in DELAYS.compared() if key[0] == "hopper"]
    assert others == [(f"ppo+gasil-{x}", f"ppo-{x}") for x in (1, 5, 20, 1000)]
