"""The command line: a run from end to end, and refusals before anything compiles."""

import contextlib
import csv
import io
import itertools
import json
import math
import re
import signal
import subprocess
import sys
import types

import brax.envs
import pytest
from small_training import DISCRIMINATOR_FLAGS, FLAGS

import gasil_jax
from gasil_envs import locomotion, user_code
from gasil_jax.host import command_line, run_options
from gasil_jax.run import main
from gasil_jax.sweeps import assembly

SMALL = (
    *(*FLAGS, *DISCRIMINATOR_FLAGS, "--seeds", "3", "--first-seed", "5"),
    *("--total-steps", "1e3"),
    *("--batch-steps", "256", "--num-epochs", "2", "--buffer-steps", "300"),
    *("--alpha", "0.5", "--alpha-schedule", "0", "0.5", "500", "1"),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder of a run, and what was told and printed."""
    folder, told, printed = tmp_path_factory.mktemp("run"), io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        with contextlib.redirect_stderr(told), contextlib.redirect_stdout(printed):
            assert main([*SMALL, "--out", "out"]) == 0, told.getvalue()
    return folder / "out", told.getvalue(), printed.getvalue()


@pytest.mark.parametrize("agent", gasil_jax.agents.AGENTS)
def test_the_help_explains_every_option_in_whole_lines(agent, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main(["--help", "--agent", agent])
    shown = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    # There may be a frame.
    lines = [line.replace("│", " ").rstrip() for line in shown.splitlines()]
    is_text = lambda line: line.startswith(" " * 7)
    for line, following in itertools.pairwise(lines):
        # Where all flags are short, the text begins beside them.
        has_text = is_text(line) or re.match(r" +--[a-z].*\S  +\S", line)
        if re.match(" +--[a-z]", line):
            assert has_text or is_text(following), line
        if has_text and is_text(following):
            # The next word did not fit into 80 columns, two of them blank.
            assert len(line) + 1 + len(following.split()[0]) > 78, line
    rewards = {"decompose_rewards": True, "normalize_rewards": True}
    for name in gasil_jax.algorithm(agent, **rewards).settings:
        assert f" --{name.replace('_', '-')}" in shown


def test_the_help_is_in_groups_by_topic(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr().out
    flags = ("--log", "--obs-noise", "--gamma", "--alpha ", "--decomposition", "--rew")
    titles = ("", "environment ", "training ", "agent ", "decompose-rewards ")
    titles += ("normalize-rewards ",)
    for title, following, flag in zip(titles, (*titles[1:], None), flags):
        group = shown.split(f" {title}options ", 1)[1]
        if following is not None:
            group = group.split(f" {following}options ")[0]
        assert f" {flag}" in group


def test_a_run_from_end_to_end(finished):
    out, told, printed = finished
    assert "compiling" in told and "steps/s" in told
    final, following = printed.splitlines()
    assert re.match(
        r"final return -?\d+\.\d \(interquartile mean over 3 seeds\), [\d,]+ steps/s",
        final,
    )
    assert following == (
        "next: python -m gasil_jax.evaluate out; python -m gasil_jax.plot out; "
        "python -m gasil_jax.render out --out episode.gif"
    )

    config = json.loads((out / "config.json").read_text())
    assert config["env"] == "point_mass" and config["first_seed"] == 5
    assert config["algorithm"]["agent"] == "ppo+gasil"
    assert config["algorithm"]["alpha"] == 0.5

    rows = list(csv.DictReader((out / "metrics.csv").open()))
    assert {row["seed"] for row in rows} == {"5", "6", "7"}
    assert [int(r["env_steps"]) for r in rows[::3]] == [256, 512, 768, 1024]
    assert list(rows[0])[:6] == [
        "seed",
        "env_steps",
        "episode_return",
        "episode_length",
        "good_return",
        "discriminator_loss",
    ]
    for column in ("policy_loss", "value_loss", "entropy", "explained_variance"):
        assert all(math.isfinite(float(row[column])) for row in rows)

    summary = json.loads((out / "summary.json").read_text())
    assert set(summary["final_return"]) == {"5", "6", "7"}
    assert summary["env_steps_per_second"] > 0 and summary["compile_seconds"] > 0
    assert "jax" in summary["versions"] and summary["device"]
    # The last tenth of four iterations is one.
    last = {row["seed"]: float(row["episode_return"]) for row in rows[-3:]}
    for seed, value in summary["final_return"].items():
        assert value == pytest.approx(last[seed], rel=1e-5)
    assert (out / "learning_curve.png").read_bytes().startswith(b"\x89PNG")


def test_the_final_policies_are_scored(finished, capsys):
    from gasil_jax.evaluate import main

    out, *_ = finished
    assert main([str(out), "--episodes", "4"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["seed", "5", "6", "7", "return"]
    assert lines[-1].endswith("(interquartile mean over 3 seeds)")
    assert main([str(out.parent)]) == 2
    assert "must be the folder of a run" in capsys.readouterr().err
    for number, message in (("0", "it must be"), ("1000000000000", "GB of memory")):
        assert main([str(out), "--episodes", number]) == 2
        error = capsys.readouterr().err
        assert f"episodes is {number}: " in error and message in error


def test_a_used_folder_is_refused_and_left_alone(finished, capsys):
    out, *_ = finished
    contents = lambda: {
        p.name: p.read_bytes()
        for p in out.iterdir()
        if p.is_file() and p.name != ".lock"
    }
    before = contents()
    assert main([*SMALL, "--out", str(out)]) == 2
    assert "not empty" in capsys.readouterr().err
    assert contents() == before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("--env walker", "env 'walker' is unknown: did you mean 'walker2d'? (one"),
        ("--env zoo", "env 'zoo' is unknown: it must be one of point_mass, hopper"),
        ("--env zoo", "pusher, brax:NAME, gymnax:NAME, navix:NAME, playground:NAME"),
        ("--env gymnx:Catch-bsuite", "did you mean 'gymnax:Catch-bsuite'? (one of br"),
        ("--env hopper --agent ppo+gasill", "did you mean 'ppo+gasil'?"),
        (
            "--env hopper --agent ppo --alpha 0.7",
            "option --alpha is unknown: alpha is a setting of gasil, ppo+gasil, "
            "gail, not of ppo",
        ),
        (
            "--env hopper --agent ppo+sil --no-buffer-discounts",
            "option --no-buffer-discounts is unknown: buffer_discounts is a setting of",
        ),
        ("--env hopper --seeds 0", "seeds is 0: it must be from 1 to"),
        ("--env hopper --seeds 1e30", "must be from 1 to 1,048,576"),
        ("--env hopper --batch-steps 1000000007", "nearest that does is 1"),
        ("--env hopper --seeds two", "seeds is 'two': it must be a whole number"),
        ("--env hopper --devices 1.5", "devices is '1.5': it must be a whole number"),
        ("--env hopper --alpha big", "alpha is 'big': it must be a number"),
        ("--env hopper --num-envs -2", "num_envs is -2"),
        ("--env hopper --total-steps 0", "total_steps is 0"),
        (
            "--env hopper --total-steps 2.5",
            "total_steps is '2.5': it must be a whole number",
        ),
        ("--env hopper --minibatch-size 60", "nearest that does is 64"),
        ("--env hopper --alpha nan", "alpha is nan"),
        ("--env hopper --reward-delay 0", "reward_delay is 0"),
        ("--env hopper --obs-noise -1", "obs_noise is -1"),
        ("--env hopper --out /proc/nowhere/run", "can't be written"),
        (
            "--env hopper --total-step 5",
            "option --total-step is unknown: did you mean --total-steps",
        ),
        ("--env hopper --seed 3", "unknown: did you mean --seeds or --first-seed?"),
        ("--env hopper --lr 1e-3", "unknown: did you mean --learning-rate?"),
        ("--env hopper --xyz 5", "option --xyz is unknown: see --help"),
        (
            "--env hopper --normalize-rewards False",
            "--normalize-rewards turns it on and --no-normalize-rewards off",
        ),
        (
            "--env hopper --hidden-sizes 64,64",
            "hidden_sizes is '64,64': it must be whole numbers, separated by spaces",
        ),
        (
            "--env hopper --alpha-schedule 2e6,0,3e6,1",
            "alpha_schedule is '2e6,0,3e6,1': it must be STEPS FACTOR pairs, separated",
        ),
        (
            "--env hopper --alpha-schedule 1 2 3",
            "alpha_schedule is 3 numbers: it must be STEPS FACTOR pairs",
        ),
        ("--resume --out nosuch", "out is nosuch, which holds no run to continue: to"),
        ("--env hopper --resume=3", "resume is '3': it takes no value"),
        ("--env hopper --log wandb --log tensorboard", "log is given twice: put all"),
        ("--env brax:antt", "did you mean 'brax:ant'?"),
        ("--env brax:zoo", "env 'brax:zoo' is unknown: it must be one of brax:"),
        ("--env brax:ant --physics mujoco", "leave it out, brax:ant has its own"),
        ("--env nowhere:Line", "'nowhere:Line' can't be imported: No module"),
        ("--env json:Line", "has no attribute 'Line'"),
        ("--env sys:path", "must build an environment without arguments"),
        ("--env json:loads", "arguments: missing a required argument: 's'"),
        ("--env os:getcwd", "'os:getcwd' is no environment: it has no reset"),
        ("--env os:getcwd --physics mujoco", "leave it out, os:getcwd has"),
        (
            "--env point_mass --max-episode-steps 51",
            "from 1 to 50, the environment's own limit",
        ),
        ("", "option --env is missing: see --help"),
        (
            "--env hopper walker2d",
            "'walker2d' is not an option or its value: see --help",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(arguments, message, capsys):
    assert main(arguments.split()) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert len(captured.err.splitlines()) == 1
    assert message in captured.err


def test_a_refusal_starts_no_device_and_does_not_load_the_plots(tmp_path):
    # Both take seconds, and nothing compiles without a device.
    code = """
import sys
from gasil_jax.run import main
status = main(["--env", "hoper"])
from jax._src import xla_bridge
print(status, xla_bridge.backends_are_initialized(), "matplotlib" in sys.modules)
"""
    result = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert result.stdout.split() == ["2", "False", "False"]
    assert len(result.stderr.splitlines()) == 1
    assert "did you mean 'hopper'" in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_output_that_nobody_reads_to_the_end_is_no_error():
    code = """
import sys
from gasil_jax.host import command_line
sys.exit(command_line.reports_errors(lambda: print(100_000 * "line\\n"))())
"""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "line\n"
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 128 + signal.SIGPIPE


def test_a_name_that_the_terminal_can_not_show_is_no_error(monkeypatch):
    terminal = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", terminal)
    assert command_line.reports_errors(lambda: print("in r\u00e9sum\u00e9") or 0)() == 0
    terminal.flush()
    assert terminal.buffer.getvalue() == b"in r\\xe9sum\\xe9\n"


def test_a_line_break_in_a_name_keeps_the_error_in_a_line(capsys):
    assert main(["--env", "hopper", "--out", "/proc/no\nrun"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert r"/proc/no\nrun" in line


def test_code_that_exits_later_does_not_decide_the_status(capsys):
    status = command_line.reports_errors(lambda: sys.exit())()
    assert status == 2
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
    assembly.note_if_no_episode_ends(env, [short.replace(total_steps=50), short])
    (line,) = capsys.readouterr().err.splitlines()
    assert "no return is known: each of 1 environments takes 48 steps" in line
    assembly.note_if_no_episode_ends(env, [short.replace(total_steps=50)])
    # Where episodes may end early, they may end within few steps.
    monopod = types.SimpleNamespace(episode_length=1000)
    monopod.unwrapped = monopod
    assembly.note_if_no_episode_ends(monopod, [short])
    assert capsys.readouterr().err == ""
    for name, task in locomotion.TASKS.items():
        endless = ("halfcheetah", "swimmer", "humanoidstandup", "reacher", "pusher")
        ends = locomotion.Locomotion.ends_early.fget(types.SimpleNamespace(task=task))
        assert ends == (name not in endless), name


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (
            "--physics mujoco",
            ["physics is mujoco, which has no effect: point_mass has none"],
        ),
        ("--physics mjx", ["physics is mjx, which has no effect"]),
        ("--integrator euler", ["integrator is euler, which has no effect"]),
        (
            "--no-normalize-rewards --reward-clip 3",
            ["reward_clip is 3.0, which has no effect: normalize_rewards is off"],
        ),
        ("--seeds 2 --devices 8", ["devices is 8, of which 2 are used"]),
        ("--seeds 2 --devices 2 --alpha 0.7", []),
        ("--agent ppo --gamma 0.9", []),
        (
            "--decomposition-updates 9",
            ["is 9, which has no effect: decompose_rewards is off"],
        ),
        ("--decomposition-updates 9 --decompose-rewards", []),
        ("--agent gasil --decompose-rewards", ["'gasil' does not use the env"]),
        ("--decomposition-hidden-sizes 8 9", ["hidden_sizes is (8, 9), which has no"]),
    ],
)
def test_an_option_without_effect_is_told(arguments, messages, capsys):
    words = ["--env", "point_mass", *arguments.split()]
    options = run_options.parse(run_options.Options, words, "gasil_jax.run")
    run_options.check(options)
    run_options.note_options_without_effect(options, options.seeds)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(messages)
    assert all(message in line for message, line in zip(messages, lines, strict=True))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            "point_mass --agent ppo+novelty",
            "agent 'ppo+novelty' on point_mass with",
        ),
        ("point_mass --agent ppo --reward-delay 2", "on point_mass with delayed"),
        ("brax:ant", "nothing for agent 'ppo+gasil' on brax:ant with dense rewards"),
        ("walker2d --agent ppo+bc --preset paper", None),
        ("walker2d --agent ppo --reward-delay 20", None),
        ("walker2d --agent ppo --preset scaled --reward-delay 20", None),
    ],
)
def test_a_task_without_a_tuned_preset_is_told(arguments, message, capsys):
    words = ["--env", *arguments.split()]
    run_options.note_if_untuned(
        run_options.parse(run_options.Options, words, "gasil_jax.run")
    )
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == (message is not None)
    assert all(message in line for line in lines)


def test_an_environment_that_brax_itself_breaks_is_refused(
    tmp_path, monkeypatch, capsys
):
    class Broken:
        action_size = 1
        reset = step = staticmethod(lambda *arguments: {}["a_min"])

    monkeypatch.setitem(brax.envs._envs, "broken", Broken)
    out = tmp_path / "run"
    assert main(["--env", "brax:broken", "--out", str(out)]) == 2
    # Where that takes long, a line before it says what is being built.
    *_, line = capsys.readouterr().err.splitlines()
    assert "env 'brax:broken' fails within Brax" in line and "KeyError: 'a_min'" in line
    assert not out.exists()
