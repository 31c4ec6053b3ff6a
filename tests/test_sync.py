"""What the algorithm scripts share is the same to the letter; tests/sync.py says what may differ, and copies."""

import ast

import pytest

from tests import sync
from tests.sync import GROUPS, SCRIPTS, copied, definitions, differences, parts, scripts, stray_lines


def test_scripts_are_in_sync():
    found = differences(scripts())
    assert not found, f"python tests/sync.py copy SCRIPT NAME copies a definition to the others:\n{found}"


def test_the_table_allows_no_more_than_it_must():
    """Groups that have become the same are one group, and names that no script has are gone."""
    split = {script: parts(text) for script, text in scripts().items()}
    for name, groups in GROUPS.items():
        versions = [split[group.split()[0]].get(name) for group in groups]
        assert None not in versions and len(set(versions)) == len(groups) > 1, name


def test_the_lists_for_train_allow_no_more_than_they_must():
    texts = {script: parts(text)["train"] for script, text in scripts().items()}
    for patterns in (sync.OWN_LINES, sync.IAICC_LINES):
        for pattern in list(patterns):
            patterns.remove(pattern)
            try:
                pairs = [(one, other) for one in SCRIPTS for other in SCRIPTS if one < other]
                assert any(stray_lines(texts[one], texts[other], (one, other)) for one, other in pairs), pattern
            finally:
                patterns.append(pattern)


def test_only_these_definitions_belong_to_one_script():
    """A definition that is renamed in one script escapes the comparison: it shows up here."""
    split = {script: parts(text) for script, text in scripts().items()}
    own = {}
    for script in SCRIPTS:
        others = {name for other in SCRIPTS if other != script for name in split[other]}
        own[script] = sorted(split[script].keys() - others)
    assert own == {
        "avf_vdn": ["mix"],
        "avf_qmix": ["QMIXMixer"],
        "avf_qplex": ["Args.mask_ongoing", "QPLEXMixer"],
        "dec_maddrqn": ["own_loss"],
        "cen_maddrqn": ["Team", "team_batch"],
        "mac_iaicc": ["Args.entropy_coef", "Args.n_step", "Args.start_e", "EpisodeBuffer", "actor_critic_loss",
                      "joint_batch", "soft_policy"],
    }  # fmt: skip
    everywhere = set.intersection(*(set(split[script]) for script in SCRIPTS))
    assert {"AgentLinear", "over_rows", "act", "evaluate", "make_learner", "train", "save", "load"} <= everywhere
    assert {"parse_args", "DEFAULTS.bp", "DEFAULTS.ct", "Args.__post_init__", "the rest"} <= everywhere


def test_definitions_come_in_the_same_order():
    """A reader finds every section at the same place; so do the settings of Args and the imports."""
    orders = {script: list(definitions(text)) for script, text in scripts().items()}
    for script, order in orders.items():
        assert order[0] == "" and ast.get_docstring(ast.parse(scripts()[script]))
        for other in SCRIPTS:
            shared = set(order) & set(orders[other])
            assert [n for n in order if n in shared] == [n for n in orders[other] if n in shared], (script, other)
    most = max(({n for n in order if n.startswith("import ")} for order in orders.values()), key=len)
    assert all({n for n in order if n.startswith("import ")} <= most for order in orders.values())


CHANGES = {  # what a slip in one script looks like, and what the report then says
    "a shared function": ("avf_qmix", "live &= ~over", "live = live & ~over", "evaluate"),
    "a comment in one": ("mac_iaicc", "# runs no code of the file", "# safe", "load"),
    "a group's member": ("avf_qmix", '"real": state', '"true": state', "ReplayBuffer"),
    "a default": ("cen_maddrqn", "gamma: float = 0.95", "gamma: float = 0.98", "Args.gamma"),
    "a setting's help": ("dec_maddrqn", "# episodes in the replay buffer", "# episodes", "Args.buffer_size"),
    "a family's values": ("avf_vdn", "td_lambda=0.8", "td_lambda=0.9", "DEFAULTS.ct"),
    "the loop of one": ("dec_maddrqn", "recent = []\n        if", "recent.clear()\n        if", "train"),
    "learning of one": ("avf_qplex", "[1, 2], [args.hysteresis", "[0, 2], [args.hysteresis", "train"),
    "the loop of the actor-critic": ("mac_iaicc", "hidden[:, over] = 0.0\n\n", "hidden[:, over] = 0.1\n\n", "train"),
    "the program": ("mac_iaicc", "sys.exit(128 + stop[0])", "sys.exit(1)", "the rest"),
    "a comment between": ("avf_vdn", "# Where tasks whose ids start so", "# Where families", "the rest"),
    "a statement between": ("avf_qplex", "ALGORITHM = Path", "LIMIT = 1\nALGORITHM = Path", "the rest"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_drift_is_seen(change):
    script, old, new, where = CHANGES[change]
    texts = scripts()
    assert old in texts[script]
    texts[script] = texts[script].replace(old, new)
    found = differences(texts)
    assert where in found and f"{script}.py" in found, found
    assert any(line[0] in "+-" and line[:3] not in ("+++", "---") for line in found.splitlines())


@pytest.mark.parametrize("name", ["evaluate", "ReplayBuffer", "Args.gamma", "DEFAULTS.bp", "Args.__post_init__"])
def test_copying_repairs_its_group_alone(name):
    texts, line = scripts(), {"Args.gamma": "gamma: float", "DEFAULTS.bp": '"bp": dict(', "evaluate": "live &= ~over"}
    line = line.get(name, "self.rows[episode] += 1" if name == "ReplayBuffer" else "high = 1 if name")
    text = texts["avf_vdn"]
    end = text.index("\n", text.index(line))
    texts["avf_vdn"] = text[:end] + "  # now" + text[end:]
    changed = copied(texts, "avf_vdn", name)
    group = GROUPS.get(name, [" ".join(SCRIPTS)])
    (group,) = (g.split() for g in group if "avf_vdn" in g.split())
    assert changed.keys() == set(group) - {"avf_vdn"} and differences(texts) and not differences(texts | changed)
    for script, text in changed.items():
        assert text.count("# now") == 1 and len(text.splitlines()) == len(texts[script].splitlines())


def test_what_cannot_be_copied_is_told():
    texts = scripts()
    for source, name in (("avf_vdn", "train"), ("avf_vdn", "nothing"), ("avf_vdn", "QMIXMixer")):
        with pytest.raises(ValueError, match=f"has no definition {name}"):
            copied(texts, source, name)
    texts["avf_vdn"] = texts["avf_vdn"].replace("def td_loss", "def loss")
    with pytest.raises(ValueError, match="the table has other scripts for td_loss"):
        differences(texts)


def test_the_command_line(tmp_path, monkeypatch, capsys):
    for script, text in scripts().items():
        (tmp_path / f"{script}.py").write_text(text)
    monkeypatch.setattr(sync, "ROOT", tmp_path)
    monkeypatch.setattr(sync.scripts, "__defaults__", (tmp_path,))
    assert sync.main([]) == 0 and "in sync" in capsys.readouterr().out
    slip = scripts()["avf_qmix"].replace("live &= ~over", "live = live & ~over")
    (tmp_path / "avf_qmix.py").write_text(slip)
    assert sync.main([]) == 1
    assert "+    " in capsys.readouterr().out
    assert sync.main(["copy", "avf_vdn.py", "evaluate"]) == 0
    assert capsys.readouterr().out == "rewrote avf_qmix.py\n"
    assert (
        sync.main([]) == 0
        and (tmp_path / "avf_qmix.py").read_text() == scripts(sync.Path(__file__).parents[1])["avf_qmix"]
    )
    assert sync.main(["copy", "avf_vdn.py", "nothing"]) == 2 and sync.main(["copy"]) == 2
