"""Shared blocks of the algorithm scripts are the same to the letter."""

import pytest

from tests.sync import BLOCK, differences, scripts, synced


def test_shared_blocks_are_identical():
    difference = differences(scripts())
    assert not difference, f"python tests/sync.py rewrites the copies from their source:\n{difference}"


COMMON = {"imports", "run arguments", "agents", "replay", "evaluation", "training", "logging", "runs"}
Q_LEARNING = {"learning arguments", "learning"}
SHARED = {
    "avf_vdn.py": COMMON | Q_LEARNING | {"td loss", "acting"},
    "avf_qmix.py": COMMON | Q_LEARNING | {"td loss", "acting"},
    "avf_qplex.py": COMMON | Q_LEARNING | {"td loss", "acting"},
    "cen_maddrqn.py": COMMON | Q_LEARNING | {"td loss", "team"},
    "dec_maddrqn.py": COMMON | Q_LEARNING | {"acting", "team", "joint history"},
    "mac_iaicc.py": COMMON | {"joint history"},
}


def test_the_scripts_share_what_they_should():
    """What is left of avf_qmix.py and avf_vdn.py outside the blocks is short: docstring, defaults and mixer."""
    texts = scripts()
    assert {name: {match[1] for match in BLOCK.finditer(text)} for name, text in texts.items()} == SHARED
    for text in texts.values():
        blocks = {match[1]: match[2] for match in BLOCK.finditer(text)}
        expected = {"team": "cen_maddrqn.py", "joint history": "dec_maddrqn.py"}
        assert blocks == {name: expected.get(name, "avf_vdn.py") for name in blocks}
    assert len(BLOCK.sub("", texts["avf_vdn.py"]).splitlines()) < 100
    assert len(BLOCK.sub("", texts["avf_qmix.py"]).splitlines()) < 150


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
