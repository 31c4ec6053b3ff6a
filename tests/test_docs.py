"""The pages of docs/ say what the code does."""

import re
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import pytest

import envs
import play

DOCS = Path(__file__).parents[1] / "docs"
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?!\w)")


def differences(page, made):
    """Lines of two texts that say different things, as pairs. The last digit of a decimal may be off by one, and a
    column may be wider for it: another processor rounds differently."""
    pages, mades = page.splitlines(), made.splitlines()
    if len(pages) != len(mades):
        return [(f"{len(pages)} lines", f"{len(mades)} lines")]
    return [(one, other) for one, other in zip(pages, mades, strict=True) if not same(one, other)]


def same(one, other):
    if NUMBER.sub("#", one).split() != NUMBER.sub("#", other).split():
        return False
    for a, b in zip(NUMBER.findall(one), NUMBER.findall(other), strict=True):
        digits = len(a.partition(".")[2])
        if digits != len(b.partition(".")[2]) or abs(float(a) - float(b)) > (digits > 0) * 1.01 * 10**-digits:
            return False
    return True


@pytest.fixture(scope="module")
def page():
    """The module that makes the numbers of how-it-works.md."""
    sys.path.insert(0, str(DOCS))
    try:
        import how_it_works
    finally:
        sys.path.remove(str(DOCS))
    return how_it_works


@pytest.mark.slow
def test_the_blocks_of_how_it_works_can_be_made_of_any_models(page, tmp_path, monkeypatch):
    """Here of models that have learned nothing, whose episodes are short: the numbers have to agree with each other."""
    make = envs.make
    monkeypatch.setattr(envs, "make", lambda env_id, num_envs=1: make(env_id, num_envs, horizon=40))
    steps = dict(num_envs=4, total_timesteps=240, learning_starts=160, train_frequency=20, eval_frequency=240)
    sizes = dict(eval_episodes=1, batch_size=2, hidden_size=8)
    for name in page.MODELS:
        script = import_module(name)
        args = replace(script.Args(), runs_dir=str(tmp_path), seed=2, **steps, **sizes)
        script.train(args).rename(tmp_path / name)
    script, args, learner, _ = play.load_run(tmp_path / "avf_qplex", "best")
    _, recorder = play.watch(script, args, learner, 1, args.seed)
    since = play.remember(script, args, recorder.steps)["since"]
    following = next(row for row in range(1, len(since) - 1) if (since[row] == row).sum() == 1)
    monkeypatch.setattr(page, "RUNS", tmp_path)
    monkeypatch.setattr(page, "ROW", following - 1)
    monkeypatch.setattr(page, "NEXT", following)
    made = page.make_blocks()
    assert list(made) == [name for _, name, _, _ in page.BLOCK.findall(page.PAGE.read_text())]
    cells = [line.split() for line in made["mixers"].splitlines()[1:]]
    best = {model: max(float(line[5]) for line in cells if line[0] == model) for model in page.MODELS}
    fed = made["fed"].splitlines()[1].split()
    assert [float(value) for value in fed[-2:]] == pytest.approx([best["avf_qmix"], best["avf_qplex"]], abs=0.002)
    following_value = float(made["target"].splitlines()[0].split()[-1])
    assert following_value == pytest.approx(best["avf_qplex"], abs=0.002), "the conditional argmax is the best"


def test_how_it_works_has_the_numbers_of_its_models(page):
    made = page.make_blocks()
    found = {name: text for _, name, text, _ in page.BLOCK.findall(page.PAGE.read_text())}
    assert list(found) == list(made), "python docs/how_it_works.py"
    for name, text in found.items():
        assert not differences(text, made[name]), f"{name}: python docs/how_it_works.py"
    told = made["rows"].splitlines()
    (row,) = [number for number, line in enumerate(told) if line.startswith(f"{page.ROW:4} ")]
    assert told[row].split()[:4] == ["4", "16", "2", "9.3050"], "the text takes this row as its example"
    assert [line.split("|")[1].split()[3] for line in told[row + 3 : row + 6]] == ["ongoing", "chosen", "ongoing"]
    fed = [[float(word) for word in line.split()[-2:]] for line in made["fed"].splitlines()[1:]]
    for own, later, earlier, target in zip(*fed, strict=True):
        assert earlier - target > abs(own - target) and abs(later - target) > abs(own - target), "the text says so"


def test_the_names_in_how_it_works_are_in_the_code(page):
    code = "\n".join(path.read_text() for path in [*DOCS.parent.glob("*.py"), *DOCS.parent.glob("envs/*.py")])
    for name in re.findall(r"`(?:\w+\.)*(\w+)`", page.PAGE.read_text()):
        if name not in ("md", "py", "models"):
            assert re.search(rf"\b{name}\b", code), name


def test_the_verdicts_in_short_are_those_of_the_claims():
    text = (DOCS / "claims.md").read_text()
    short = dict(re.findall(r"^\| (C\d+[a-z]?) \| .* \| (.*) \|$", text, re.M))
    parts = re.split(r"^\*\*(C\d+[a-z]?)\.", text, flags=re.M)[1:]  # name, section, name, section, ...
    told = [re.search(r"Verdict:\s+\*\*(.*?)\*\*", section)[1] for section in parts[1::2]]
    assert short == dict(zip(parts[::2], told, strict=True))


def test_differences():
    assert not differences("a 1.234  -0.000 b 7\n", "a   1.235 0.000  b 7\n")
    assert differences("1.234", "1.236") and differences("7", "8") and differences("row 1.2", "now 1.2")
    assert differences("1.23", "1.230") and differences("1.0\n", "1.0\n2.0\n") and differences("-0.3", "0.3")
