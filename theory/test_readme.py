"""README.md names tests that exist."""

import re
from pathlib import Path

HERE = Path(__file__).parent


def test_readme_names_tests_that_exist():
    """In full, or in part with dots where something is left out."""
    tests = re.findall(r"^def (test_\w+)", "".join(path.read_text() for path in HERE.glob("test_*.py")), re.M)
    named = re.findall(r"`(test_\w+(?:\.\.\.)?|\.\.\._\w+(?:\.\.\.)?)`", (HERE / "README.md").read_text())
    assert len(named) > 40
    for name in named:
        pattern = name.replace("...", r"\w*")
        assert any(re.fullmatch(pattern, test) for test in tests), name
