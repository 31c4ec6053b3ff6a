"""What the algorithm scripts share is the same to the letter; tests/sync.py says what may differ, and copies."""

import ast

import pytest

from tests import sync
from tests.sync import GROUPS, OWN_LINES, SCRIPTS, copied, definitions, differences, parts, pieces, scripts


def test_scripts_are_in_sync():
    found = differences(scripts())
    assert not found, f"python tests/sync.py copy SCRIPT NAME copies a definition to the others:\n{found}"


def test_the_table_allows_no_more_than_it_must():
    """Groups that have become the same are one group, and names that no script has are gone."""
    split = {script: parts(text) for script, text in scripts().items()}
    for name, groups in GROUPS.items():
        versions = [split[group.split()[0]].get(name) for group in groups]
        assert None not in versions and len(set(versions)) == len(groups) > 1, name


def test_the_lines_of_train_are_no_more_than_they_must(monkeypatch):
    """If any one of them were missing in the table, `train` would differ."""
    trains = {script: parts(text)["train"] for script, text in scripts().items()}
    for names, own in OWN_LINES.items():
        for piece in pieces(own):
            rest = "\n\n".join(other for other in pieces(own) if other != piece)
            monkeypatch.setitem(OWN_LINES, names, rest)
            assert sync.train_differences(trains), piece
        monkeypatch.setitem(OWN_LINES, names, own)
    assert not sync.train_differences(trains)


def test_only_these_definitions_belong_to_one_script():
    """A definition that is renamed in one script escapes the comparison: it shows up here."""
    split = {script: parts(text) for script, text in scripts().items()}
    own = {}
    for script in SCRIPTS:
        others = {name for other in SCRIPTS if other != script for name in split[other]}
        own[script] = {name for name in split[script].keys() - others if "." not in name or name.startswith("Args.")}
    assert own == {
        "avf_vdn": {"mix"},
        "avf_qmix": {"QMIXMixer"},
        "avf_qplex": {"QPLEXMixer", "Args.mask_ongoing"},
        "dec_maddrqn": {"own_loss"},
        "cen_maddrqn": {"Team", "values_at_rows"},
        "mac_iaicc": {"logits_at_rows", "Critics", "soft_policy", "actor_critic_loss", "Args.n_step"}
        | {"Args.random_timesteps", "Args.start_e", "Args.entropy_coef"},
    }
    everywhere = set.intersection(*(set(split[script]) for script in SCRIPTS))
    assert {"ReplayBuffer.end_episodes", "evaluate", "make_learner", "train", "save", "load"} <= everywhere
    assert {"parse_args", "DEFAULTS.bp-", "DEFAULTS.ct-", "Args.__post_init__", "the rest"} <= everywhere


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
    "a shared function": ("avf_qmix", "running &= ~over", "running = running & ~over", "evaluate"),
    "a shared method": ("avf_qplex", "rng.integers(len(", "rng.choice(len(", "ReplayBuffer.sample"),
    "a class of another name": ("mac_iaicc", "self.running_rows[over] = 0", "pass", "ReplayBuffer.end_episodes"),
    "a class's docstring": ("avf_vdn", "Agents share no weights", "Agents share nothing", "Agents"),
    "a comment in one": ("mac_iaicc", "# half a file, where the disk is full", "# half a file", "save"),
    "a group's member": ("avf_qmix", '"real": (last_state', '"real": (state', "mixer_states"),
    "a setting's value": ("cen_maddrqn", "td_lambda: float = 0.8", "td_lambda: float = 0.9", "Args.td_lambda"),
    "a setting's type": ("avf_vdn", "seed: int", "seed: float", "Args.seed"),
    "a setting's help": ("dec_maddrqn", "# episodes in the replay buffer", "# episodes", "Args.buffer_size"),
    "a family's values": ("avf_vdn", "eval_episodes=400", "eval_episodes=401", "DEFAULTS.ct-"),
    "a check": ("avf_vdn", 'AT_MOST_1 = ("learning_rate", ', "AT_MOST_1 = (", "AT_MOST_1"),
    "the loop of one": ("dec_maddrqn", "hidden[:, over] = 0.0\n\n", "\n", "train, what is common"),
    "the loop of two": ("avf_qmix", "over = terminations | truncations\n        if", "if", "avf_qplex.py train"),
    "learning of one": ("avf_vdn", "optimizer.zero_grad()", "pass", "train, what is common"),
    "an update owed": ("avf_vdn", "step > args.learning_starts and", "", "not once in train of avf_vdn.py"),
    "the loop of the actor-critic": ("mac_iaicc", "bar.update(args.num_envs)", "", "train, what is common"),
    "an own line, moved": ("avf_qplex", 'state = infos["state"]\n        obs,', "obs,", "avf_qplex.py train"),
    "the program": ("mac_iaicc", "sys.exit(130)", "sys.exit(1)", "the rest"),
    "a comment of an own line": ("dec_maddrqn", "# no two purposes", "# No two purposes", "train, what is common"),
    "a comment between": ("avf_vdn", "# Other values for", "# Values for", "the rest"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_drift_is_seen(change):
    script, old, new, where = CHANGES[change]
    texts = scripts()
    assert texts[script].count(old) >= 1
    texts[script] = texts[script].replace(old, new)
    found = differences(texts)
    assert where in found and f"{script}.py" in found, found


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("evaluate", "running &= ~over"),
        ("ReplayBuffer.begin_rows", "self.running_rows[e] += 1"),
        ("Args.gamma", "gamma: float = 0.95"),
        ("Args.__post_init__", "kind = type(getattr"),
        ("DEFAULTS.bp-", '"bp-": dict('),
    ],
)
def test_copying_repairs_its_group_alone(name, line):
    texts = scripts()
    text = texts["avf_vdn"]
    end = text.index("\n", text.index(line))
    texts["avf_vdn"] = text[:end] + "  # now" + text[end:]
    changed = copied(texts, "avf_vdn", name)
    group = next(group.split() for group in GROUPS.get(name, [" ".join(SCRIPTS)]) if "avf_vdn" in group.split())
    assert changed.keys() == set(group) - {"avf_vdn"}
    assert differences(texts) and not differences(texts | changed)
    for script, text in changed.items():
        assert text.count("# now") == 1 and len(text.splitlines()) == len(texts[script].splitlines())


def test_what_cannot_be_copied_is_told():
    texts = scripts()
    for name in ("nothing", "QMIXMixer"):
        with pytest.raises(ValueError, match=rf"avf_vdn.py has no definition {name}"):
            copied(texts, "avf_vdn", name)
    texts["avf_vdn"] = texts["avf_vdn"].replace("def td_loss", "def loss")
    with pytest.raises(ValueError, match="the table has other scripts for td_loss"):
        differences(texts)


def test_the_command_line(tmp_path, monkeypatch, capsys):
    """It compares, it copies, and it says what it did."""
    texts = scripts()
    for script, text in texts.items():
        (tmp_path / f"{script}.py").write_text(text)
    monkeypatch.setattr(sync, "ROOT", tmp_path)
    assert sync.main([]) == 0 and "in sync" in capsys.readouterr().out
    (tmp_path / "avf_qmix.py").write_text(texts["avf_qmix"].replace("running &= ~over", "running = running & ~over"))
    assert sync.main([]) == 1 and "+        running = running & ~over" in capsys.readouterr().out
    assert sync.main(["copy", "avf_vdn.py", "evaluate"]) == 0
    assert capsys.readouterr().out == "rewrote avf_qmix.py\n"
    assert sync.main([]) == 0 and (tmp_path / "avf_qmix.py").read_text() == texts["avf_qmix"]
    assert sync.main(["copy", "avf_vdn.py", "nothing"]) == 2 and sync.main(["copy"]) == 2
