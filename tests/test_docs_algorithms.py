"""docs/algorithms.md says what the scripts say: deviations, names and logged metrics."""

import ast
import re
from importlib import import_module
from pathlib import Path

import pytest

from tests.short_runs import cut_episodes, short
from tests.sync import ROOT, SCRIPTS

PAGE = (ROOT / "docs" / "algorithms.md").read_text()


def section(title):
    """The text below a heading of the second level."""
    return re.search(rf"^## {re.escape(title)}\n(.*?)(?=^## |\Z)", PAGE, re.M | re.S)[1]


def items(text):
    """The numbered list in a text, an item a string with single spaces."""
    return [re.sub(r"\s+", " ", item).strip() for item in re.findall(r"^ ?\d+\. (.*(?:\n  +.*)*)", text, re.M)]


@pytest.mark.parametrize("name", SCRIPTS)
def test_deviations_are_the_docstrings(name):
    docstring = ast.get_docstring(ast.parse((ROOT / f"{name}.py").read_text()))
    listed = items(section(f"{name}.py").split("Numbered deviations")[1])
    assert listed == items(docstring[docstring.index("Numbered deviations") :]) and listed


@pytest.mark.parametrize("name", SCRIPTS)
def test_names_of_the_tables_are_in_the_script(name):
    text, rows = (ROOT / f"{name}.py").read_text(), re.findall(r"^\| .* \| (.*) \|$", section(f"{name}.py"), re.M)
    named = [code for row in rows[1:] for code in re.findall(r"`([^`]+)`", row)]
    assert len(named) > 5
    for code in named:
        method = re.fullmatch(r"(\w+)\.(\w+)", code)
        if method and f"class {method[1]}" in text:
            assert re.search(rf"^class {method[1]}\b.*?^    def {method[2]}\(", text, re.M | re.S), code
        else:
            assert re.search(rf"(?<!\w){re.escape(code)}(?!\w)", text), code
    assert f"    python {name}.py --env wtd-s\n" in section(f"{name}.py")


LOGGED = {}  # script: keys of a short run


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_every_logged_key_is_explained(name, tmp_path, monkeypatch):
    script, keys = import_module(name), set()
    monkeypatch.setattr(script.SummaryWriter, "add_scalar", lambda writer, key, value, step: keys.add(key))
    cut_episodes(monkeypatch, 10)
    options = dict(num_envs=20, total_timesteps=2_000, eval_frequency=2_000, batch_size=1, hidden_size=8)
    more = dict(train_frequency=10, learning_starts=0) if name != "mac_iaicc" else {}
    script.train(short(script, "bp-10", tmp_path, **options, **more))
    LOGGED[name] = keys
    explained = set(re.findall(r"^\| `(\w+/\w+)` \| ", section("What a run leaves, and what it logs"), re.M))
    assert {key.split("/")[0] for key in keys} == {"charts", "losses", "eval"} and keys <= explained
    if len(LOGGED) == len(SCRIPTS):
        assert set().union(*LOGGED.values()) == explained, "explained, but logged by no script"


def test_links_lead_to_files():
    """In every page of docs/, in README.md, CONTRIBUTING.md and theory/README.md."""
    pages = [*(ROOT / "docs").glob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "theory" / "README.md"]
    for page in pages:
        for target in re.findall(r"\]\((?!http)([^)#]+)", page.read_text()):
            assert (Path(page).parent / target).exists(), f"{page.name}: {target}"


def test_readme_is_short_and_its_test_command_is_the_workflows():
    text = (ROOT / "README.md").read_text()
    assert len(text.splitlines()) <= 150
    command = re.search(r"^    (pip install .*pytest)$", text, re.M)[1]
    assert f"run: {command}\n" in (ROOT / ".github" / "workflows" / "test.yml").read_text()
    assert f"    {command}\n" in (ROOT / "CONTRIBUTING.md").read_text()
