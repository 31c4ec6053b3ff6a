"""README.md names tests that exist."""

import re
from pathlib import Path

HERE = Path(__file__).parent


def test_readme_names_tests_that_exist():
    """In full, or in part with dots where something is left out."""
    tests = []
    for path in HERE.glob("test_*.py"):
        tests.extend(re.findall(r"^def (test_\w+)", path.read_text(), re.M))
    readme = (HERE / "README.md").read_text()
    named = re.findall(r"`(test_\w+(?:\.\.\.)?|\.\.\._\w+(?:\.\.\.)?)`", readme)
    assert len(named) > 40
    for name in named:
        pattern = name.replace("...", r"\w*")
        assert any(re.fullmatch(pattern, test) for test in tests), name
