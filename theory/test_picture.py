"""The picture of the smallest counterexample shows the mixer's numbers, and README.md's tables are the same."""

import re
from pathlib import Path

import numpy as np
from PIL import Image

from theory import picture

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
