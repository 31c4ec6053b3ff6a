"""The pages of docs/ say what the code does."""

import re
import sys
from pathlib import Path

import pytest

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
