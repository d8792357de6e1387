"""A sweep on a Ray cluster: a worker is killed in the middle, and nothing is lost.

It needs Ray: pip install "gasil_jax[ray]".
"""

import json
import os
import re
import signal
import threading
import time

import numpy as np
import pytest
from small_training import FLAGS

from gasil_jax import sweep
from gasil_jax.host import ray_launcher

ray = pytest.importorskip("ray")

STEPS = 100 * 128
LONG = (*FLAGS, "--agent", "ppo", "--total-steps", str(STEPS), "--seeds", "2")
LONG += ("--devices", "1", "--checkpoint-every", str(10 * 128))
# Two programs: a shard has one of them, as the whole sweep has.
GRID = ("--grid", "gamma=0.9,0.99", "num_epochs=1,2")


@pytest.fixture(scope="module")
def cluster():
    ray.init(num_cpus=2, num_gpus=0, include_dashboard=False)
    yield
    ray.shutdown()


def process_of(folder):
    """Return the process that trains the shard in a folder."""
    return int(re.match(r"process (\d+)", (folder / ".lock").read_text()).group(1))


def test_the_shard_of_a_killed_worker_continues_from_its_checkpoint(
    cluster, tmp_path, figures
):
    out = tmp_path / "out"
    killed, programs = [], []

    def kill():
        begun = "programs/*/checkpoints/*[0-9]/manifest.json"
        while not (checkpoints := list(out.glob(begun))):
            time.sleep(0.01)
        programs.append(checkpoints[0].parents[2])
        killed.append(process_of(programs[0]))
        os.kill(killed[0], signal.SIGKILL)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    arguments = [*LONG, *GRID, "--launcher", "ray", "--shards", "2"]
    assert sweep.main([*arguments, "--out", str(out)]) == 0
    (program,) = programs
    (other,) = {path for path in (out / "programs").iterdir()} - {program}
    assert len(killed) == 1 and process_of(program) != killed[0]
    assert process_of(other) not in (os.getpid(), killed[0], process_of(program))
    # All is there, and what it had done before it was killed was not done again.
    steps = 128 * np.arange(1, STEPS // 128 + 1)
    np.testing.assert_array_equal(
        np.load(out / "curves.npz")["env_steps"], np.tile(steps, (4, 2, 1))
    )
    trained = json.loads((program / "training.json").read_text())
    assert trained["env_steps"] < 4 * STEPS
    before = {p: p.stat().st_mtime_ns for p in (out / "programs").rglob("*")}
    assert sweep.main([*arguments, "--out", str(out)]) == 2
    assert sweep.main(["--resume", "--out", str(out)]) == 0
    assert {p: p.stat().st_mtime_ns for p in (out / "programs").rglob("*")} == before


def test_a_shard_that_fails_is_named(cluster):
    """Here a program that imports nothing, and returns 2 at an unknown option."""
    told = r"shard 1/1 \(status 2\) failed, see above"
    with pytest.raises(ChildProcessError, match=told):
        ray_launcher.run_on_ray("timeit", {"shard 1/1": ["--unknown"]}, 1)
