"""The command line: a run from end to end, and refusals before anything compiles."""

import dataclasses
import json
import math
import pathlib
import re
import shutil
import signal
import subprocess
import sys
import types

import jax
import numpy as np
import pytest
from refusals import refused, rows
from small_training import FLAGS, table

import gasil_jax
from gasil_envs import user_code
from gasil_jax import run
from gasil_jax.cli import options as options_
from gasil_jax.cli.options import Options
from gasil_jax.cli.reporting import HelpShown, reports_errors
from gasil_jax.host import checkpoint, saved, start, training
from gasil_jax.host import sweep as sweep_

pytestmark = pytest.mark.xdist_group("commands")


def shown_by(capsys, *words):
    with pytest.raises(HelpShown):
        run.main(words)
    return capsys.readouterr().out


def flags_of(shown):
    return set(re.findall(r"^  (--[a-z-]+)", shown, re.MULTILINE))


@pytest.mark.parametrize("agent", ["ppo+gasil-adaptive", "ppo+sil"])
def test_the_help_explains_every_option_by_topic(agent, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    shown = shown_by(capsys, "--help-all", "--agent", agent)
    assert max(map(len, shown.splitlines())) < 80
    settings = gasil_jax.algorithm(
        agent, decompose_rewards=True, normalize_rewards=True
    ).settings
    flags = {f"--{name.replace('_', '-')}" for name in settings}
    assert flags <= flags_of(shown)
    # A text stands beside its flag or in the next line.
    assert not re.findall(r"^  --\S+( \S+)*\n(?! {8})", shown, re.MULTILINE)
    topics = re.split(r"^(\w+):\n", shown, flags=re.MULTILINE)[1:]
    for topic, flag in (
        ("recording", "--log"),
        ("environment", "--obs-noise"),
        ("training", "--gamma"),
        ("decompose_rewards", "--decomposition-updates"),
        ("normalize_rewards", "--reward-clip"),
    ):
        assert flag in flags_of(topics[topics.index(topic) + 1])
    most_needed = shown_by(capsys, "--help", "--agent", agent)
    assert 20 < len(flags_of(most_needed)) <= 32
    assert {"--env", "--seeds", "--out"} <= flags_of(most_needed) < flags_of(shown)
    assert "--help-all shows all options" in most_needed


def test_the_help_shows_the_defaults_of_the_preset(capsys):
    gamma = gasil_jax.preset("walker2d", "ppo").config.gamma
    words = ("--help", "--env", "walker2d", "--agent", "ppo")
    shown = " ".join(shown_by(capsys, *words).split())
    assert f"discount factor (default: {gamma:g})" in shown


def test_the_environments_are_listed(capsys):
    names = shown_by(capsys, "--list-envs").splitlines()
    assert names[0] == "point_mass"
    assert {"walker2d", "brax:ant", "sparse:u_maze"} < set(names)
    assert len(names) == len(set(names)) and all(len(x.split()) == 1 for x in names)


def test_a_run_from_end_to_end(trained):
    out, told, printed = trained
    assert "compiling" in told and "steps/s" in told
    final, following = printed.splitlines()
    number = r"-?\d+\.\d"
    assert re.match(
        rf"final return {number}, final evaluation {number} \(interquartile mean over "
        r"3 seeds\), [\d,]+ steps/s on .*, in out$",
        final,
    )
    assert following == (
        "next: python -m gasil_jax.evaluate out; python -m gasil_jax.plot out; "
        "python -m gasil_jax.render out --out episode.gif"
    )
    config = json.loads((out / "config.json").read_text())
    assert config["env"] == "point_mass" and config["seeds"] == [5, 6, 7]
    assert config["algorithm"]["agent"] == "ppo+gasil" and config["points"] == [{}]
    assert config["algorithm"]["alpha"] == 0.5

    (program,) = (out / "programs").iterdir()
    assert {path.name for path in program.iterdir() if path.name != ".lock"} == {
        *("program.json", "metrics.csv", "evaluations.csv", "training.json"),
        "checkpoints",
    }
    rows = table(program / "metrics.csv")
    assert [row["seed"] for row in rows[:3]] == ["5", "6", "7"]
    assert [int(row["env_steps"]) for row in rows[::3]] == [256, 512, 768, 1024]
    columns = "point seed env_steps episode_return episode_length good_return"
    assert list(rows[0])[:6] == columns.split()
    for column in ("policy_loss", "value_loss", "entropy", "explained_variance"):
        assert all(math.isfinite(float(row[column])) for row in rows)
    scores = table(program / "evaluations.csv")
    assert [int(row["env_steps"]) for row in scores[::3]] == [0, 512, 1024]

    summary = json.loads((out / "summary.json").read_text())
    assert summary["env_steps_per_second"] > 0 and summary["compile_seconds"] > 0
    assert "jax" in summary["versions"] and summary["device"]
    # The last tenth of four iterations is one.
    last = {row["seed"]: float(row["episode_return"]) for row in rows[-3:]}
    evaluated = {row["seed"]: float(row["mean"]) for row in scores[-3:]}
    for row in table(out / "results.csv"):
        assert float(row["final_return"]) == pytest.approx(last[row["seed"]], rel=1e-5)
        score = evaluated[row["seed"]]
        assert float(row["final_evaluation"]) == pytest.approx(score, rel=1e-5)
    (point,) = summary["points"]
    assert point["mean"] == pytest.approx(sum(last.values()) / 3)
    curves = np.load(out / "curves.npz")
    assert curves["episode_return"].shape == (1, 3, 4)
    assert curves["evaluation_mean"].shape == (1, 3, 3)
    assert np.load(out / "policy.npz")["seeds"].tolist() == [5, 6, 7]
    assert (out / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_finished_run_is_resumed_without_training(trained, tmp_path, capsys):
    out = shutil.copytree(trained.folder, tmp_path / "out")
    (out / "results.csv").unlink()
    assert run.main(["--resume", "--out", str(out)]) == 0
    captured = capsys.readouterr()
    assert "compiling" not in captured.err
    assert captured.out.splitlines()[0].split(" on ")[0] in trained.printed
    for name in ("results.csv", "summary.json", "policy.npz"):
        assert (out / name).read_bytes() == (trained.folder / name).read_bytes(), name
    for path in trained.folder.glob("programs/*/*.csv"):
        copied = out / path.relative_to(trained.folder)
        assert copied.read_bytes() == path.read_bytes(), path


def test_help_and_a_refusal_load_little_and_start_no_device(tmp_path):
    """All of it takes seconds, and nothing compiles without a device."""
    code = """
import sys
import gasil_jax.cli.run
slow = "brax gymnasium matplotlib mujoco orbax warp".split()
print({*slow} & {*sys.modules} or "nothing")
gasil_jax.algorithm("ppo+gasil").replace(num_envs=8)
status = gasil_jax.cli.run.main(["--env", "hoper"])
print(status, "matplotlib" in sys.modules)
from gasil_envs import registry
registry.check("gymnax:CartPole-v1", registry.Settings())
from jax._src import xla_bridge
print(xla_bridge.backends_are_initialized())
"""
    command = [sys.executable, "-c", code]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.stdout.split() == ["nothing", "2", "False", "False"], result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert "did you mean 'hopper'" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_output_that_nobody_reads_to_the_end_is_no_error():
    code = """
import sys
from gasil_jax.cli import reporting
sys.exit(reporting.reports_errors(lambda: print(100_000 * "line\\n"))())
"""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "line\n"
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 128 + signal.SIGPIPE


def test_code_that_exits_later_does_not_decide_the_status(capsys):
    assert reports_errors(lambda: sys.exit())() == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: your own code ended the program: SystemExit (")


def test_ctrl_c_passes_through_what_checks_the_users_code():
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt), user_code.refused("never said"):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, handler)


def test_a_run_in_which_no_episode_can_end_is_told(capsys):
    env = gasil_jax.make_env("point_mass")
    # 3 iterations of 16 steps in each environment; an episode has 50.
    short = gasil_jax.algorithm("ppo", total_steps=40, num_envs=1, batch_steps=16)
    note = training._note_if_no_episode_ends
    note(env, [short.replace(total_steps=50), short])
    (line,) = capsys.readouterr().err.splitlines()
    assert "no return is known: each of 1 environments takes 48 steps" in line
    note(env, [short.replace(total_steps=50)])
    # Where episodes may end early, they may end within few steps.
    monopod = types.SimpleNamespace(episode_length=1000)
    monopod.unwrapped = monopod
    note(monopod, [short])
    assert capsys.readouterr().err == ""


def notes(capsys):
    return [x for x in capsys.readouterr().err.splitlines() if x.startswith("note: ")]


#: Options with which a run of the point mass has notes, and parts of these.
NOTES = """
--physics mujoco --integrator euler | physics is mujoco, which has no effect: point_ma
--no-normalize-rewards --reward-clip 3 | reward_clip is 3.0, which has no effect: norma
--decomposition-updates 9 | is 9, which has no effect: decompose_rewards
--agent gasil --decompose-rewards | 'gasil' does not use the env
--seeds 2 --alpha 0.7 --decomposition-updates 9 --decompose-rewards |
--agent ppo --gamma 0.9 |
"""


@pytest.mark.parametrize(("words", "message"), rows(NOTES))
def test_an_option_without_effect_is_told(words, message, capsys):
    options_.read(Options, ["--env", "point_mass", *words.split()], "x")
    lines = notes(capsys)
    # Physics has two.
    assert len(lines) == bool(message) + ("mujoco" in words), lines
    assert not message or message in lines[0]


#: Environments with options, and what is noted of their presets.
UNTUNED = """
point_mass --agent ppo+novelty | agent 'ppo+novelty' on point_mass with
brax:ant | nothing for agent 'ppo+gasil' on brax:ant with dense rewards
gymnax:CartPole-v1 --preset gymnax |
walker2d --agent ppo+bc --preset paper |
walker2d --agent ppo --reward-delay 20 |
sparse:u_maze --agent ppo+gasil+novelty |
"""


@pytest.mark.parametrize(("words", "message"), rows(UNTUNED))
def test_a_task_without_a_tuned_preset_is_told(words, message, capsys):
    read = options_.read(Options, ["--env", *words.split()], "x")
    env = types.SimpleNamespace(num_actions=2) if "gymnax" in words else object()
    options_.note_if_untuned(*read, env)
    lines = notes(capsys)
    assert len(lines) == bool(message) and all(message in line for line in lines)


def test_training_starts_from_another_runs_policy(
    trained, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    first = str(trained.folder)
    more = ("--agent", "ppo", "--init-from", first, "--evaluate-every", "128")
    assert run.main([*FLAGS, *more, "--keep-checkpoints", "3", "--out", "second"]) == 0
    (stored,) = tmp_path.glob("second/**/00000000")
    *_, last = saved.load(pathlib.Path("second"))
    begun = checkpoint.read(stored).restore(jax.eval_shape(lambda: last))
    best = start.find(trained.folder).seed
    *_, expected = saved.load(trained.folder, seed=best)
    for part in (lambda x: x.actor_critic.policy.params, lambda x: x.normalizer):
        jax.tree.map(np.testing.assert_array_equal, part(begun), part(expected))
    assert begun.iteration.tolist() == [0]
    # It is not the run that starts from scratch, and other policies are refused.
    (one,) = sweep_.read(pathlib.Path("second")).runs.values()
    assert one.key != dataclasses.replace(one, start=None).key
    for words, why in (
        (("--init-from", first, "--layer-norm"), "has another form: "),
        (("--init-from", "nowhere"), "nowhere, which does not exist"),
    ):
        assert why in refused(capsys, run, *FLAGS, *words)
    assert not pathlib.Path("runs").exists()


def test_the_settings_of_a_config_are_taken(trained, tmp_path, capsys):
    config = ("--config", str(trained.folder / "config.json"))
    _, requested = options_.read(Options, [*config, "--alpha", "0.3"], "x")
    before = sweep_.read(trained.folder)
    assert requested.algorithm == before.algorithm.replace(alpha=0.3)
    same = dataclasses.replace(requested, algorithm=before.algorithm)
    assert same == dataclasses.replace(before, algorithm=before.algorithm)
    assert run.main([*config, "--agent", "ppo"]) == 2
    assert "where agent was ppo+gasil, is ppo: leave it out" in capsys.readouterr().err
    assert run.main(["--config", "nowhere.json"]) == 2
    assert "config is nowhere.json: it must be the config" in capsys.readouterr().err
