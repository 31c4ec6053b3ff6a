"""A script is read at one sitting: ceilings on lines and on tokens, without comments and docstrings."""

import ast
import io
import tokenize

import pytest

from tests.sync import SCRIPTS, scripts

CEILING, LOWER = (480, 5_000), {"avf_vdn": (430, 4_500)}
LAYOUT = {"COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER", "ENCODING"}


def count(text):
    """Lines and tokens of a program. Not tokens: comments, docstrings (strings that are statements) and layout. An
    f-string is one, which is what it was before Python 3.12 took it apart."""
    strings = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            strings.update(range(node.lineno, node.end_lineno + 1))
    tokens, depth = 0, 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        kind = tokenize.tok_name[token.type]
        docstring = kind == "STRING" and token.start[0] in strings and not token.line[: token.start[1]].strip()
        tokens += depth == 0 and kind not in LAYOUT and not docstring
        depth += kind.endswith("STRING_START")
        depth -= kind.endswith("STRING_END")
    return len(text.splitlines()), tokens


def test_scripts_are_short():
    table, over = [f"{'':12} lines of      tokens of"], []
    for name, text in scripts().items():
        (lines, tokens), (most_lines, most_tokens) = count(text), LOWER.get(name, CEILING)
        table.append(f"{name:12} {lines:5} {most_lines:3} {tokens:8,} {most_tokens:6,}")
        over += [name] if lines > most_lines or tokens > most_tokens else []
    print("\n".join(table))
    assert not over, "\n".join([f"too long: {' '.join(over)}", *table])


@pytest.mark.parametrize(
    "text, tokens",
    [
        ("x = 1  # one\n\n", 3),
        ('"""Docstring."""\nx = "string"\n', 3),
        ('def f():\n    """Doc\n    string."""\n    return "a"\n', 7),
        ("f'a {b + 1} c {d!r:>{width}} {f(\"x\")}'\n", 1),  # one f-string, also where it is taken apart
        ("f(f'a {b}', r'c')\n", 6),
        ("for x in (1, 2):\n    pass\n", 10),
    ],
)
def test_counting(text, tokens):
    assert count(text) == (len(text.splitlines()), tokens)


def test_counting_a_script():
    """The sum over its top-level statements is the whole, so nothing is counted twice or left out."""
    for name in SCRIPTS:
        text = scripts()[name]
        lines = text.splitlines()
        first = [min([n.lineno, *(d.lineno for d in getattr(n, "decorator_list", []))]) for n in ast.parse(text).body]
        pieces = ["\n".join(lines[a - 1 : b - 1]) for a, b in zip(first, [*first[1:], len(lines) + 1], strict=True)]
        assert sum(count(piece)[1] for piece in pieces) == count(text)[1] > 4_000, name
