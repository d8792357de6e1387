"""Command lines that can't be are refused in a line, before anything is made."""

import pytest
from refusals import refused, rows

from experiments import __main__ as experiments
from gasil_jax import evaluate, plot, render, run, sweep
from gasil_jax.host import output_file

PROGRAMS = {
    "run": (run, ""),
    "hopper": (run, "--env hopper "),
    "mass": (run, "--env point_mass "),
    "corridor": (run, "--env corridor:Corridor --agent ppo "),
    "sweep": (sweep, "--env point_mass "),
    "grid": (sweep, "--env point_mass --grid "),
    "shard": (sweep, "--env point_mass --grid alpha=1 --out x "),
    "figure": (experiments, ""),
    "evaluate": (evaluate, ""),
    "plot": (plot, ""),
    "score": (evaluate, "RUN "),
    "draw": (plot, "RUN "),
    "film": (render, "RUN "),
    "again": (run, "--out RUN "),
    "resume": (run, "--resume --out RUN "),
    "swept": (evaluate, "SWEEP "),
}
#: How each line begins, what else is in it, and what is told.
LINES = """
run | --env is missing: see --help
run --env walker | env 'walker' is unknown: did you mean 'walker2d'? (one
run --env zoo | env 'zoo' is unknown: it must be one of point_mass, hopper
run --env gymnx:Catch-bsuite | did you mean 'gymnax:Catch-bsuite'? (one of br
run --env gymnax:Breakout | did you mean 'gymnax:Breakout-MinAtar'
run --env brax:fast:x | env 'brax:fast:x' is unknown: it must be one of brax:ant
run --env brax:ant --physics mujoco | leave it out, brax:ant has its own
run --env nowhere:Line | 'nowhere:Line' can't be imported: No module
run --env json:Line | has no attribute 'Line'
run --env json:loads | arguments: missing a required argument: 's'
run --resume | resume needs --out and the folder to continue
run --resume --out nosuch | out is nosuch, which holds no run to continue: to
hopper --agent ppo+gasill | did you mean 'ppo+gasil'?
hopper --agent ppo --alpha 0.7 | alpha is a setting of gasil, ppo+gasil, ppo+gasil+n
hopper --agent ppo+sil --buffer-episodes 3 | --buffer-episodes is unknown: buffer_
hopper --preset papre | did you mean 'paper'
hopper --seeds 0 | seeds is 0: it must be from 1 to
hopper --seeds two | seeds is 'two': it must be a whole number
hopper --no-seeds | --no-seeds is unknown: did you mean --seeds?
hopper --batch-steps 1000000007 | nearest that does is 1
hopper --alpha big | alpha is 'big': it must be a number
hopper --minibatch-size 60 | nearest that does is 64
hopper --reward-delay 0 | reward_delay is 0
hopper --out /proc/nowhere/run | can't be written
hopper --lr 1 | option --lr is unknown: did you mean --learning-rate?
hopper --total-step 5 | is unknown: did you mean --total-steps?
hopper --xyz 5 | option --xyz is unknown: see --help
hopper --normalize-rewards False | 'False' is not an option or its
hopper --hidden-sizes 64,64 | is '64,64': it must be whole numbers, separated by spaces
hopper --alpha-schedule 1 2 3 | is '1 2 3': it must be STEPS FACTOR pairs, separated
hopper --log wandb --log tensorboard | log is given twice: put all
hopper --log tensorbord | log is 'tensorbord': it must be one of tens
hopper --log tensorboard tensorboard | log has 'tensorboard' twice: name it once
hopper --resume=3 | resume: ignored explicit argument '3'
hopper ant | 'ant' is not an option or its value: see --help
mass --max-episode-steps 51 | from 1 to 50, the environment's
mass --evaluate-every 0 | evaluate_every is 0: it must be a whole number, 1
mass --video-every 0 | video_every is 0: it must be a whole number, 1
mass --evaluate-episodes 3 | evaluate_episodes is 3: it needs evaluate_every
mass --evaluate-every 9 --evaluate-episodes 2e9 | GB of memory
mass --out LONGx | too long
mass --alpha LONGx | alpha is 'xxxxxxxxxxxxxxxxxxxxxxxxxxxxxx
mass --agent gail | expert is missing
mass --agent gail --expert nowhere.npz | it must be an .npz file
mass --agent gail --expert minari:nothing/there-v0 | minari:nothing/there-v0
mass --agent gasil --preset scaled | it is for ppo, ppo+novelty, ppo+gasil+n
corridor --policy-components 4 | policy_components is 4: it must be 1, the
sweep | grid is empty
sweep --agent ppo --random 5 | random is 5: it must be from 1 to 4, of 4 points
sweep --random 3 --grid alpha=0.1,0.2,0.1 | it must be from 1 to 2, of 2 points
sweep --points-file no.json | no.json, which can't be read
grid alhpa=1 | did you mean 'alpha'
grid alpha=1 --agent ppo | gail, not of ppo. What can vary: batch_steps
grid buffer_steps=9 --agent ppo+sil | buffer_steps is a setting of ppo+bc, ppo+bc+n
grid decomposition_learning_rate=1e-3 | has no effect: decompose_rewards is off
grid num_envs=1,2 | 'num_envs' can't vary: it must be one of batch_steps
grid alpha=1,big | it must be numbers, like alpha=0.1,0.2
grid buffer_steps=1.5 | whole numbers, like buffer_steps=10,20
grid alpha=0.02,0.1 alpha=0.2 | grid has alpha twice
grid alpha=1 --points-file x | points_file can't be combined with grid
grid policy_components=1,4 --env sparse:key_grid | policy_components is 4: it must be 1
grid alpha=1 --shard 1/1 | shard needs --out
grid alpha=1 --shards 3 | shards is 3: it needs --launcher
grid alpha=1 --launcher ray --shards 1 | launcher needs --out
shard --shard 5/4 | shard is '5/4'
shard --shard 1/2 | 1 runs (points x seeds) make 1
shard --launcher ray | None: --launcher needs --shards
shard --launcher ray --shards 2 | make 1 shards
figure nonsense | experiment 'nonsense' is unknown: it must be one of
figure matrix --shard 3/2 | shard is '3/2': it must be NUMBER/COUNT
figure matrix --devices 0 | devices is 0: it must be from 1 to
figure matrix --quick --results x | results is x: --quick writes below
figure report --help-me | option --help-me is unknown: see --help
figure benchmark --tables speed | tables is 'speed': it must be one of physics, training
figure benchmark --repeats 9 --page | page is set, but
evaluate | RUN is missing: see --help
evaluate zoo:walker --gymnasium | policy of the zoo 'walker' is unknown: did
evaluate zoo:swimmer-delayed --point 1 | it has no points and no checkpoints
plot | runs is empty: name one folder or more
"""
#: The same of folders in which there is a run or a sweep.
LINES_OF_RUNS = """
again --env point_mass | is not empty: name a new or an empty folder, or continue
resume --agent ppo | agent was ppo+gasil, is ppo: leave it out
resume --preset paper | preset was tuned, is paper: leave it out
resume --gamma 0.5 | gamma was 0.98, is 0.5: only total_steps and seeds
resume --obs-noise 0.2 --num-epochs 3 | num_epochs was 2, is 3
resume --seeds 2 | seeds were [5, 6, 7]: only total_steps and seeds may
resume --evaluate-every 300 | evaluate_every was 512, is 300
score --checkpoint first | checkpoint is 'first': it must be one of last, be
score --episodes 1000000000000 | GB of memory
score --seed 8 | seed is 8: the run has 5, 6, 7
score --point 1 | point is 1: 
score --gymnasium | must be of a locomotion task of Gymnasium
score --out x.txt | it must end in .csv
score --out /proc/scores.csv | /proc/scores.csv, which can't be written
evaluate RUN/programs | has no config.json: it must be the folder of a run or a swe
evaluate RUN/nowhere | does not exist: it must be the folder of a run or a sweep
swept --point 4 | has points 0 to 1
swept --point 1 --checkpoint best | it must be 'last'
draw --metric entropie | metric 'entropie' is unknown: did you mean 'entropy'
draw --smooth 0 | smooth is 0: it must be 1 or more
draw --x steps | x is 'steps': it must be one of env_steps
draw --out x.txt | must end in .png, .pdf, .svg
draw --out RUN/learning_curve.png | which exists: name a new file
draw --out /proc/nowhere/x.png | out is /proc/nowhere/x.png
draw RUN --labels a | labels has 1 names: it must have one for each of the
film --out film.avi | must end in .mp4, .gif, .png
film --out RUN/policy.gif --seed 9 | seed is 9: the run has 5, 6, 7
film --width 99999999 | width is 99999999: it must be from 1 to 4096
film --key -1 | key is -1: it must be from 0 to 4294967295
film --out /proc/nowhere/film.gif | out is /proc/nowhere/film.gif
"""


def told_of(line, capsys, **folders):
    """Return what is told of a line in which names stand for folders."""
    program, begin = PROGRAMS[line.split()[0]]
    line = begin + line.partition(" ")[2].replace("LONGx", 5000 * "x")
    for name, folder in folders.items():
        line = line.replace(name, str(folder))
    return refused(capsys, program, *line.split())


@pytest.mark.parametrize(("line", "message"), rows(LINES))
def test_it_is_one_line_and_status_2(line, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert message in told_of(line, capsys)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.xdist_group("commands")
@pytest.mark.parametrize(("line", "message"), rows(LINES_OF_RUNS))
def test_a_folder_of_results_is_left_alone(
    line, message, trained, swept, tmp_path, monkeypatch, capsys
):
    def contents():
        paths = [x for x in trained.folder.rglob("*") if x.is_file()]
        # The lock may have been taken for a moment.
        return {x: x.read_bytes() for x in paths if x.name != ".lock"}

    monkeypatch.chdir(tmp_path)
    before = contents()
    assert message in told_of(line, capsys, RUN=trained.folder, SWEEP=swept.folder)
    assert contents() == before and list(tmp_path.iterdir()) == []


def test_a_name_with_no_room_for_the_partial_files_is_too_long(tmp_path):
    # A file is first written under a name that is longer by some 40 bytes.
    with pytest.raises(ValueError, match="too long"):
        output_file.make_parent(tmp_path / f"{'x' * 240}.gif")
