"""Shared blocks of the algorithm scripts are the same to the letter."""

import pytest

from tests.sync import BLOCK, differences, scripts, synced


def test_shared_blocks_are_identical():
    difference = differences(scripts())
    assert not difference, f"python tests/sync.py rewrites the copies from their source:\n{difference}"


def test_the_scripts_share_what_they_should():
    """What is left of avf_qmix.py and avf_vdn.py outside the blocks is short: docstring, defaults and mixer."""
    for name, text in scripts().items():
        blocks = {match[1]: match[2] for match in BLOCK.finditer(text)}
        assert {"imports", "agents", "replay", "td loss", "training", "runs"} <= blocks.keys(), name
        assert set(blocks.values()) == {"avf_vdn.py"}
    assert len(BLOCK.sub("", scripts()["avf_vdn.py"]).splitlines()) < 100
    assert len(BLOCK.sub("", scripts()["avf_qmix.py"]).splitlines()) < 150


def test_drift_is_seen_and_repaired():
    texts = {
        "a.py": "x = 0\n# >>> one, identical to a.py\ny = 1\n# <<< one\n",
        "b.py": "    # >>> one, identical to a.py\ny = 2\n    # <<< one\nz = 3\n",
    }
    assert "-y = 2" in differences(texts) and "+y = 1" in differences(texts)
    repaired = synced(texts)
    assert repaired["b.py"] == "# >>> one, identical to a.py\ny = 1\n# <<< one\nz = 3\n" and not differences(repaired)
    for broken, message in (
        ({"a.py": "# >>> one, identical to a.py\ny = 1\n"}, "without its other end"),
        ({"a.py": "# >>> one, identical to b.py\ny = 1\n# <<< one\n"}, "which has none"),
        ({"a.py": texts["a.py"] * 2}, "twice"),
    ):
        with pytest.raises(ValueError, match=message):
            synced(broken)
