"""The folders of programs."""

import json

from gasil_jax import algorithm
from gasil_jax.sweeps import programs
from gasil_jax.sweeps.programs import Program, ProgramFolder
from gasil_jax.sweeps.runs import Run


def test_a_program_of_a_version_with_fewer_settings_is_read(tmp_path):
    """What it lacks has its default, so that its runs are those of this version."""
    runs = tuple(Run("point_mass", algorithm("ppo"), seed) for seed in (3, 4))
    stored = ProgramFolder(Program(runs), tmp_path / "now", {"seed": (3, 4)})
    with stored.opened():
        pass
    listed = json.loads((stored.path / "program.json").read_text())
    (experiment,) = listed["experiments"]
    del experiment["algorithm"]["entropy_coefficient"], listed["sha256"]
    (stored.path / "program.json").write_text(json.dumps(listed))
    (read,) = programs.read(tmp_path)
    assert read.program.runs == runs
