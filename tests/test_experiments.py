"""The experiments run from end to end at toy size."""

from experiments import point_mass


def test_the_point_mass_is_trained_and_drawn(tmp_path, capsys):
    size = ("--seeds", "2", "--total-steps", "10240", "--moments", "5")
    assert point_mass.main([*size, "--out", str(tmp_path)]) == 0
    assert "ppo+gasil  final return" in capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {*("point_mass_curves.png", "point_mass_moments.png")}
    assert point_mass.main(["--moments", "2"]) == 2
