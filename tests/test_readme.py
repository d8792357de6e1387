"""What README and documentation tell people to type works."""

import itertools
import os
import pathlib
import re
import shlex
import subprocess

import jax
import numpy as np
import pytest
from small_training import FLAGS, SETTINGS, drawn_policies

import gasil_jax
from experiments.agents.constant_bonus import PPOBonus
from gasil_jax.cli import evaluate, options, parsing, plot, render, run, sweep
from gasil_jax.host import environments, policy_file, saved
from gasil_jax.host.sweep import parse_shard

README = pathlib.Path(__file__).parent.parent / "README.md"
TEXT = README.read_text()
DOCS = README.parent / "docs"
DOCUMENTS = (README, *sorted(DOCS.glob("*.md")))

PROGRAMS = {
    f"gasil_jax.{module.__name__.split('.')[-1]}": module
    for module in (run, sweep, evaluate, plot, render)
}
#: The options of those that train.
TRAINING = {
    "gasil_jax.run": options.Options,
    "gasil_jax.sweep": options.SweepOptions,
}
SMALL = ("--total-steps", "512", *FLAGS[4:])
#: What stands for an option's value when a command is run.
TOY = {"--env": "point_mass", "--reward-delay": "1", "--seeds": "2", "--episodes": "2"}
# Other presets may have nothing for it.
TOY |= {"--preset": "tuned", "--evaluate-every": "128"}
#: In a command that needs a run of a locomotion task.
LOCOMOTION = "--gymnasium"
#: How commands begin that are not run here, and why.
NOT_RUN = {
    "python -m pip install": "it changes the environment; .ci/run does it",
    "python -m pytest": "it runs this",
    "python -m experiments benchmark": "it measures for minutes",
    "python -m experiments profile": "it measures for minutes",
    "python -m gasil_jax.sweep --env hopper --seeds 10 --random": "tests/commands/"
    "test_shards.py and tests/commands/test_ray.py train shards",
    "python -m gasil_jax.run --env my_tasks:Line": "a test below trains it",
    "python -m gasil_jax.run --env gymnax:Breakout-MinAtar --agent my_tasks": "a test "
    "below trains it",
    "python -m gasil_jax.run --env my_tasks:Quadruped": "a test below trains it",
    "python -m gasil_jax.sweep --env my_tasks:Line": "a test below trains it",
}


def commands():
    """Return every console command of the documents once.

    A line starts with $ and continues after a backslash. && separates commands, and
    variables and a core that are set before a command are left out.
    """
    text = "\n".join(path.read_text() for path in DOCUMENTS)
    unique = {}
    for block in re.findall(r"```console\n(.*?)```", text, re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            if line.startswith("$ "):
                for command in line[2:].split(" && "):
                    command = re.sub(r"^([A-Z_]+=\S+|taskset -c 0) ", "", command)
                    unique[shlex.join(shlex.split(command, comments=True))] = None
    return list(unique)


OURS = [line for line in commands() if line.startswith("python -m gasil_jax")]
FIGURES = [
    line
    for line in commands()
    if line.startswith("python -m experiments") and not line.startswith(tuple(NOT_RUN))
]


@pytest.fixture(scope="session")
def my_tasks(tmp_path_factory):
    """The agent and the task of the documents can be imported; return the test."""
    text = (DOCS / "extending.md").read_text()
    agent, test, model, network, task, robot = re.findall(
        r"```python\n(.*?)```", text, re.DOTALL
    )
    # Its step on the fast physics, slow to compile, is in test_robots.py.
    robot = robot.replace("Locomotion(task)", "Locomotion(task, physics='mujoco')")
    assert "physics='mujoco'" in robot
    # Whatever its attributes are called, it is none of ours.
    names = "Line.model = Line.layout = Line.task = None"
    folder = tmp_path_factory.mktemp("my_tasks")
    every = (agent, model, network, task, robot, names)
    (folder / "my_tasks.py").write_text("\n".join(every))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield test


@pytest.mark.parametrize("line", OURS)
def test_a_command_is_understood(line, my_tasks):
    _, _, program, *arguments = shlex.split(line)
    if program in TRAINING:
        options.read(TRAINING[program], arguments, program)
    else:
        parsing.read(PROGRAMS[program].Options, arguments, program)


def test_other_commands_are_named_with_a_reason():
    for line in commands():
        runs = line in OURS or line in FIGURES
        assert runs or any(map(line.startswith, NOT_RUN)), line
    for start in NOT_RUN:
        assert any(line.startswith(start) for line in commands()), start


@pytest.mark.parametrize("line", FIGURES)
def test_a_figure_is_there(line, capsys):
    from experiments import __main__ as experiments

    assert experiments.main([*shlex.split(line)[3:], "--list"]) == 0
    assert "runs are missing" in capsys.readouterr().out


SCALING = (DOCS / "scaling.md").read_text()


def calls_of(script, folder, **variables):
    """Return the arguments of each `python` in a shell script, in any order."""
    listed = folder / "calls"
    listed.unlink(missing_ok=True)
    stubs = {
        "nvidia-cuda-mps-control": "true",
        "python": f'echo "$(printf "%q " "$@")" >> {listed}',
        "srun": 'exec "$@"',
    }
    for name, body in stubs.items():
        (folder / name).write_text(f"#!/bin/bash\n{body}\n")
        (folder / name).chmod(0o755)
    path = f"{folder}:{os.environ['PATH']}"
    variables = {name: str(value) for name, value in variables.items()}
    subprocess.run(["bash", "-euc", script], check=True, env={"PATH": path} | variables)
    return [shlex.split(line) for line in listed.read_text().splitlines()]


BASH = re.findall(r"```bash\n(.*?)```", SCALING, re.DOTALL)


def shard_of(call):
    assert call[:2] == ["-m", "gasil_jax.sweep"]
    words = call[2:]
    at = words.index("--out") + 1
    out, words[at] = words[at], "nowhere"
    given, _ = options.read(options.SweepOptions, words, "gasil_jax.sweep")
    return *parse_shard(given.shard), out, given.resume


def test_the_scripts_of_schedulers_start_every_shard_once(tmp_path):
    """In a real shell, with stand-ins for the schedulers and for Python."""
    shell, slurm = BASH[1:]
    assert sorted(shard_of(call) for call in calls_of(shell, tmp_path)) == [
        (number, 4, "OUT", False) for number in range(1, 5)
    ]

    first, last = map(int, re.search(r"--array=(\d+)-(\d+)", slurm).groups())
    for index in (first, last):
        (call,) = calls_of(
            slurm, tmp_path, SLURM_ARRAY_TASK_ID=index, SCRATCH="/a place"
        )
        assert shard_of(call) == (index, last, "/a place/OUT", True)

    yaml = pytest.importorskip("yaml")
    (text,) = re.findall(r"```yaml\n(.*?)```", SCALING, re.DOTALL)
    job = yaml.safe_load(text)["spec"]
    (container,) = job["template"]["spec"]["containers"]
    assert container["command"] == ["bash", "-c"]
    (script,) = container["args"]
    for index in (0, job["completions"] - 1):
        (call,) = calls_of(script, tmp_path, JOB_COMPLETION_INDEX=index)
        assert shard_of(call) == (index + 1, job["completions"], "/results/OUT", True)


def as_toy(line, finished, locomotion, folder):
    """Return a command's program and arguments, made small, with output in `folder`."""
    _, _, program, *arguments = shlex.split(line)
    needs_locomotion = LOCOMOTION in line
    for i, (option, value) in enumerate(zip(["", *arguments], arguments)):
        if option in TOY:
            arguments[i] = TOY[option]
        elif option == "--out":
            arguments[i] = str(folder / value)
        elif value == "RUN":
            arguments[i] = str(locomotion if needs_locomotion else finished)
    if program in ("gasil_jax.run", "gasil_jax.sweep"):
        arguments += [*SMALL, "--out", str(folder)]
    if program == "gasil_jax.run":
        # As many members as a sweep of two seeds has, whose program it shares.
        arguments += ["--seeds", "8"]
    return PROGRAMS[program], arguments


def parts_of(line):
    """Return what a command uses: its program and options, what it reads and writes."""
    _, _, program, *arguments = shlex.split(line)
    options = {word for word in arguments if word.startswith("--")}
    read = {word for word in arguments[:1] if not word.startswith("--")}
    written = set(re.findall(r"--out \S+(\.\w+)", line))
    return {program, *options, *read, *written}


def test_the_commands_run(tmp_path, capsys, untrained_hopper, my_tasks):
    """On the point mass and for some hundred steps; each kind of command once.

    The settings of the other runs are understood, by the test above, and are trained
    with in the tests of agents.
    """
    pytest.importorskip("imageio_ffmpeg")
    lines = [line for line in OURS if not line.startswith(tuple(NOT_RUN))]
    # The first command's run is what the others take.
    is_run = lambda line: line.startswith("python -m gasil_jax.run")
    first, *others = sorted(lines, key=is_run, reverse=True)
    # A command with no other parts than one before it is that one, with other values.
    others = [line for line in others if not is_run(line)]
    others.sort(key=lambda line: -len(parts_of(line)))
    finished, ran = tmp_path / "0", []
    for number, line in enumerate([first, *others]):
        if any(parts_of(line) <= parts for parts in ran):
            continue
        ran.append(parts_of(line))
        folder = tmp_path / str(number)
        if line != first:
            folder.mkdir()
        program, arguments = as_toy(line, finished, untrained_hopper, folder)
        status = program.main(arguments)
        captured = capsys.readouterr()
        assert status == 0, (line, captured.err)
        assert captured.out, line
        # What a command names as its output is there.
        for option, value in itertools.pairwise(shlex.split(line)):
            if option == "--out":
                assert (folder / value).stat().st_size > 0, line
    assert {program for parts in ran for program in parts} >= PROGRAMS.keys()


def test_options_in_the_table_exist():
    table = (DOCS / "running.md").read_text()
    rows = re.findall(r"^\| (`--.*?) \|", table, re.MULTILINE)
    fields = [field for row in rows for field in re.findall(r"--[a-z-]+", row)]
    assert len(fields) > 18
    given, requested = options.read(options.Options, ["--env", "hopper"], "x")
    names = {*vars(given), *vars(requested.settings), *vars(requested.recording)}
    for agent in gasil_jax.agents.AGENTS:
        models = {"decompose_rewards": True, "normalize_rewards": True}
        names |= gasil_jax.algorithm(agent, **models).settings.keys()
    for field in fields:
        assert field[2:].replace("-", "_") in names, field


def test_the_agents_of_the_table_are_all_that_there_are():
    table = TEXT[TEXT.index("| `--agent` |") :].split("\n\n")[0]
    agents = re.findall(r"^\| `([a-z][a-z+-]*)` \|", table, re.MULTILINE)
    assert sorted(agents) == sorted(gasil_jax.agents.AGENTS)


@pytest.fixture
def finished_hopper(tmp_path, monkeypatch):
    """The folder runs/hopper with policies, in the working directory."""
    monkeypatch.chdir(tmp_path)
    folder = pathlib.Path("runs", "hopper")
    folder.mkdir(parents=True)
    env = gasil_jax.make_env("point_mass")
    states = drawn_policies(env, gasil_jax.algorithm("ppo"), 4)
    policy_file.save(folder / "policy.npz", states, env, range(4), np.zeros(4))


def run_python(path):
    """Run a document's Python on the point mass, made small; return its names."""
    blocks = re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)
    assert blocks
    env = gasil_jax.make_env("point_mass")

    def small(algorithm):
        """A smaller algorithm; of agents with an alpha this one compiles soonest."""
        small = gasil_jax.Algorithm(PPOBonus(), config=algorithm.config)
        return small.replace(**SETTINGS | {"batch_steps": 512, "total_steps": 1024})

    names = {"observation": np.zeros(env.observation_size, np.float32), "small": small}
    changes = {
        r'"(walker2d|hopper)", ': '"point_mass", ',
        r"(gasil_jax\.preset\(.*\))": r"small(\1)",
        "1_000_000": "1024",
        r"key\(0\), \d+\)": "key(0), 2)",
        r"n_trials=\d+": "n_trials=2",
        # Together as many members as in the other call, which share a program.
        r"seeds=10,\n    points": "seeds=5, points",
    }
    for block in blocks:
        for pattern, value in changes.items():
            block = re.sub(pattern, value, block)
        exec(compile(block, str(path), "exec"), names)
    return names


def test_the_python_of_the_readme_runs(finished_hopper):
    names = run_python(README)
    assert names["returns"].shape == (4, 2, 2)  # alphas, seeds, iterations
    assert names["action"].shape == (2,)


def test_the_python_of_the_documentation_runs(finished_hopper, figures):
    names = run_python(DOCS / "python.md")
    assert names["metrics"]["episode_return"].shape == (2, 2)  # seeds, iterations
    assert names["state"].iteration.shape == (2,)
    assert names["scores"]["episode_return"].shape == (10,)
    assert names["action"].shape == (2,) == names["act"](names["observation"]).shape
    assert names["tried"].metrics["episode_return"].shape == (2, 5, 2)
    # Of the copies, the networks are one and the numbers that they draw are not.
    copies = names["population"]
    first, second = copies.actor_critic.policy.params["params"]["log_std"]
    np.testing.assert_array_equal(first, second)
    assert len(np.unique(jax.vmap(jax.random.uniform)(copies.key))) == 2
    result = names["result"]
    assert result.metrics["episode_return"].shape == (10, 2)
    # The untrained policy and the last one.
    assert result.evaluations["mean"].shape == (10, 2)
    (folder,) = pathlib.Path("runs/walker2d/programs").iterdir()
    assert (folder / "checkpoints").is_dir()


def test_the_search_with_optuna_runs():
    pytest.importorskip("optuna")
    study = run_python(DOCS / "scaling.md")["study"]
    assert len(study.trials) == 2
    assert np.isfinite(study.best_value)
    assert 0.01 <= study.best_params["alpha"] <= 1.0


def test_the_links_of_the_readme_lead_somewhere():
    targets = re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", TEXT)
    assert len(targets) > 15
    for target in targets:
        assert (README.parent / target).exists(), target


def test_the_documented_agent_and_task_train(my_tasks, tmp_path, capsys, figures):
    out = tmp_path / "out"
    small = "--total-steps 256 --batch-steps 128 --num-envs 4 --reward-delay 7"
    both = ["--env", "my_tasks:Line", "--agent", "my_tasks:Scaled", *small.split()]
    arguments = ["--reward-factor", "0.3", "--first-seed", "5", "--out", str(out)]
    model = ["--rewards", "my_tasks:Counted", "--growth", "0.25"]
    assert run.main([*both, *model, *arguments]) == 0
    metrics = np.load(out / "curves.npz")
    assert metrics["factor"].tolist() == [[[1.0, 1.25]]]
    assert (metrics["scaled_reward"] < 0).all()
    # At most 20 steps of at most 0.1.
    assert (metrics["episode_length"] <= 20).all()
    assert evaluate.main([str(out), "--episodes", "2"]) == 0
    assert re.search(r"5 +2 +-[0-9.]+ +[0-9.]+ +20.0", capsys.readouterr().out)
    assert render.main([str(out), "--out", str(tmp_path / "line.gif")]) == 2
    assert "of an environment that can't be drawn" in capsys.readouterr().err
    assert evaluate.main([str(out), "--gymnasium"]) == 2
    assert "must be of a locomotion task" in capsys.readouterr().err


def test_the_documented_robot_trains_and_is_drawn(my_tasks, tmp_path, figures):
    env = ["--env", "my_tasks:Quadruped", "--agent", "ppo"]
    out = tmp_path / "run"
    assert run.main([*env, *SMALL, "--seeds", "1", "--out", str(out)]) == 0
    assert (np.load(out / "curves.npz")["faulty_steps"] == 0).all()
    assert environments.can_be_drawn(saved.load(out)[0])


def test_the_documented_network_trains_on_planes(my_tasks, tmp_path, capsys, figures):
    pytest.importorskip("gymnax")
    run_of_it = ["--env", "gymnax:Breakout-MinAtar", "--agent", "my_tasks:Planes"]
    out = tmp_path / "run"
    arguments = [*run_of_it, "--preset", "gymnax", *SMALL[:-2], "--seeds", "2"]
    assert run.main([*arguments, "--out", str(out)]) == 0
    assert "policy.npz is not written: the policy's network is a F" in (
        capsys.readouterr().err
    )
    *_, states = saved.load(out)
    params = states.actor_critic.policy.params
    assert params["params"]["own"]["Conv_0"]["kernel"].shape == (2, 3, 3, 4, 16)
    action = gasil_jax.load_policy(out, which="best")(np.zeros((3, 400)))
    assert action.shape == (3,) and action.dtype == np.int32
    assert evaluate.main([str(out), "--episodes", "2"]) == 0


def test_the_documented_test_of_an_agent_passes(my_tasks):
    names = {"gasil_jax": gasil_jax}
    exec(my_tasks, names)
    names["test_the_reward_is_scaled"]()


def rows_of(page, heading):
    """Return the cells of the table below a heading of a document, in rows."""
    table = (DOCS / page).read_text().split(f"## {heading}\n")[1].split("\n## ")[0]
    rows = [x for x in table.splitlines() if x.startswith("| `")]
    return [[cell.strip() for cell in row.strip("|").split(" | ")] for row in rows]


@pytest.mark.parametrize("agent", gasil_jax.agents.AGENTS)
def test_the_list_of_metrics_is_complete(agent, tmp_path):
    env = gasil_jax.make_env("point_mass", reward_delay=5)
    models = {"normalize_rewards": True, "decompose_rewards": True}
    algorithm = gasil_jax.algorithm(agent, batch_steps=64, num_envs=4, **models)
    if agent == "gail":
        observation = np.zeros((9, env.observation_size), np.float32)
        action = np.zeros((9, env.action_size), np.float32)
        np.savez(tmp_path / "expert.npz", observation=observation, action=action)
        algorithm = algorithm.replace(expert=str(tmp_path / "expert.npz"))
    first = lambda: gasil_jax.init(env, algorithm, jax.random.key(0))
    step = lambda: gasil_jax.train_step(env, algorithm, first())[1]
    listed = [
        name.strip("`")
        for name, agents, *_ in rows_of("data.md", "Metrics")
        if agents.split(", ")[0] == "all" or agent in agents.split(", ")
    ]
    assert sorted(listed) == sorted(jax.eval_shape(step))
