"""The picture of the smallest counterexample shows the mixer's numbers, and README.md's tables are the same.

And the programs of this folder check their options and paths before they compute.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from theory import deviations, expressiveness, optimism, picture

README = (Path(__file__).parent / "README.md").read_text()


def number(cell):
    """The first number of a table's cell."""
    return float(re.search(r"-?\d+", cell)[0])


def test_readme_opens_with_the_tables_of_the_picture():
    printed = re.findall(r"^\| agent 1: \*\*a\*\*.*?\| (\S+) \| (.*) \|\n\| b \| (\S+) \| (.*) \|$", README, re.M)
    printed = [[number(cell) for cell in cells] for cells in printed]
    (_, literal, literal_verdict), (_, shipped, shipped_verdict) = picture.panels()
    assert len(printed) == 2
    assert literal.ravel().tolist() in printed
    assert shipped.ravel().tolist() in printed
    assert not literal_verdict
    assert shipped_verdict


def test_picture_is_drawn(tmp_path, capsys):
    picture.main(["-o", str(tmp_path / "picture.png")])
    pixels = np.asarray(Image.open(tmp_path / "picture.png").convert("RGB"))
    assert pixels.shape == (720, 1350, 3)
    for colour in (picture.GREEDY, picture.BEST):
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        is_marked = (pixels == rgb).all(2)
        columns = np.flatnonzero(is_marked.any(0))
        assert columns.min() < 675 < columns.max(), "marked in both panels"
    assert "margin=1" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("program", "command", "says"),
    [
        (picture, ["-o", "nowhere/picture.png"], "picture: .*cannot write 'nowhere/picture.png'"),
        (picture, ["-o", "picture.gif"], "picture: .*has to be a .png file"),
        (picture, ["-o", "."], "picture: .*has to be a .png file"),
        (picture, ["--size", "3"], "picture: unrecognized arguments"),
        (optimism, ["-o", "nowhere/figure.png"], "optimism: .*cannot write"),
        (optimism, ["-o", ""], "optimism: .*cannot write"),
        (optimism, ["--steps", "-1"], "optimism: --steps must not be negative, got -1"),
        (optimism, ["--steps", "many"], "optimism: .*--steps"),
        (optimism, ["--steps", "0", "-o", "figure.png"], "optimism: the figure of --output needs runs"),
        (optimism, ["--seed", "-1"], "--seed must be from 0"),
        (expressiveness, ["--fast"], "expressiveness: unrecognized arguments"),
        (deviations, [], "deviations: .*required: run"),
        (deviations, ["nowhere"], "there is no folder nowhere"),
        (deviations, ["nowhere", "--pairs", "-1"], "deviations: --show and --pairs must not be negative"),
    ],
)
def test_bad_options_are_refused_in_a_line_before_anything_is_computed(monkeypatch, tmp_path, program, command, says):
    monkeypatch.chdir(tmp_path)
    for name in ("panels", "push_beside_random_partner", "breaks", "returns"):
        monkeypatch.delattr(program, name, raising=False)
    with pytest.raises(SystemExit, match=says) as refused:
        program.main(command)
    assert len(str(refused.value).splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_without_matplotlib_a_picture_is_refused_before_it_is_computed(monkeypatch):
    monkeypatch.setattr(picture.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"optimism: .*pictures need matplotlib"):
        optimism.main(["-o", "figure.png"])
