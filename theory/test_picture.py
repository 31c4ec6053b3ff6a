"""The picture of the smallest counterexample shows the mixer's numbers, and README.md's tables are the same."""

import re
from pathlib import Path

import numpy as np

from theory import picture

README = (Path(__file__).parent / "README.md").read_text()


def test_readme_opens_with_the_tables_of_the_picture():
    printed = re.findall(r"^\| agent 1: \*\*a\*\*.*?\| (\S+) \| (.*) \|\n\| b \| (\S+) \| (.*) \|$", README, re.M)
    printed = [[float(re.search(r"-?\d+", cell)[0]) for cell in table] for table in printed]
    literal, shipped = (q.ravel().tolist() for _, q, _ in picture.tables())
    assert sorted(printed) == sorted([literal, shipped]) and literal != shipped
    assert [bool(verdict) for *_, verdict in picture.tables()] == [False, True]


def test_picture_is_drawn(tmp_path, capsys):
    picture.main(["-o", str(tmp_path / "picture.png")])
    from PIL import Image

    pixels = np.asarray(Image.open(tmp_path / "picture.png").convert("RGB"))
    assert pixels.shape == (720, 1350, 3)
    for colour in (picture.GREEDY, picture.BEST):
        rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
        here = np.flatnonzero((pixels == rgb).all(2).any(0))  # columns
        assert here.min() < 675 < here.max(), "marked in both panels"
    assert "margin=1" in capsys.readouterr().out
