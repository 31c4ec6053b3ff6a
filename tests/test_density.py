"""Code is read at one sitting, by a reader who does not stop: ceilings on its length and on its density.

Comments, docstrings and empty lines are not counted. CONTRIBUTING.md says what the numbers are for.
"""

import ast
import io
import tokenize
from typing import NamedTuple

from tests.sync import ROOT, SCRIPTS

MOST_LINES = 620  # of a script
MOST_TOKENS = {"avf_vdn.py": 4_300}  # of a script, 5,000 of the others
TOKENS_PER_LINE = 11.0
LONG = 105  # characters
MOST_LONG_LINES = 20
MOST_TUPLE_ASSIGNMENTS = 8
ENVS = "__init__ box_pushing capture_target checks core options overcooked warehouse".split()  # not rendering
LAYOUT = {"COMMENT", "NL", "NEWLINE", "INDENT", "DEDENT", "ENDMARKER", "ENCODING"}  # not tokens


class Counts(NamedTuple):
    lines: int  # all of them
    code: int  # lines of code
    tokens: int
    long: int  # lines of code over LONG characters
    tuples: int  # tuple-to-tuple assignments, a, b = c, d
    chains: int  # chained assignments, a = b = c


def count_tokens(names):
    """The number of tokens in a list of their types' names. An f-string is one, as it was before Python 3.12."""
    count = 0
    depth = 0  # of f-strings in f-strings
    for name in names:
        if depth == 0 and name not in LAYOUT:
            count += 1
        if name.endswith("STRING_START"):
            depth += 1
        if name.endswith("STRING_END"):
            depth -= 1
    return count


def count(text):
    """The Counts of a program."""
    nodes = list(ast.walk(ast.parse(text)))
    in_docstrings = set()
    for node in nodes:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            in_docstrings.update(range(node.lineno, node.end_lineno + 1))
    lines = text.splitlines()
    code = [line for number, line in enumerate(lines, 1) if number not in in_docstrings and line.strip()]
    code = [line for line in code if not line.strip().startswith("#")]
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    names = [tokenize.tok_name[token.type] for token in tokens if token.start[0] not in in_docstrings]
    assignments = [(node.targets, node.value) for node in nodes if isinstance(node, ast.Assign)]
    of_tuples = [isinstance(to[0], ast.Tuple) and isinstance(value, ast.Tuple) for to, value in assignments]
    return Counts(
        lines=len(lines),
        code=len(code),
        tokens=count_tokens(names),
        long=sum(len(line) > LONG for line in code),
        tuples=sum(of_tuples),
        chains=sum(len(targets) > 1 for targets, _ in assignments),
    )


def problems(name, counts):
    """What is above its ceiling, a list of lines. name: a path; files in folders have no ceiling on their length."""
    most_tokens = MOST_TOKENS.get(name, 5_000)
    found = {
        f"{counts.lines} lines, {MOST_LINES} at most": "/" not in name and counts.lines > MOST_LINES,
        f"{counts.tokens} tokens, {most_tokens} at most": "/" not in name and counts.tokens > most_tokens,
        f"{counts.tokens / counts.code:.2f} tokens per line": counts.tokens > TOKENS_PER_LINE * counts.code,
        f"{counts.long} lines over {LONG} characters": counts.long > MOST_LONG_LINES,
        f"{counts.tuples} tuple-to-tuple assignments": counts.tuples > MOST_TUPLE_ASSIGNMENTS,
        f"{counts.chains} chained assignments": counts.chains > 0,
    }
    return [f"{name}: {problem}" for problem, is_above in found.items() if is_above]


def test_code_is_short_and_not_dense():
    """Prints a table of all files (pytest -s shows it) and fails with it."""
    table = [f"{'':22} {'lines':>6} {'code':>5} {'tokens':>7} {'per line':>9} {'long':>5} {'tuples':>7} {'chains':>7}"]
    above = []
    names = [f"{script}.py" for script in (*SCRIPTS, "play", "timeline")] + [f"envs/{module}.py" for module in ENVS]
    for name in names:
        counts = count((ROOT / name).read_text())
        lines, code, tokens, *others = counts
        row = f"{name:22} {lines:6} {code:5} {tokens:7,} {tokens / code:9.2f} {others[0]:5} {others[1]:7} {others[2]:7}"
        table.append(row)
        above += problems(name, counts)
    print("\n".join(table))
    assert not above, "\n".join([*above, *table])


SAMPLE = '''"""A docstring
of two lines."""

# A comment is not a line of code.
x = 1  # one

def f(a, b):
    """This does nothing."""
    a, b = b, a
    c = d = f"{a + 1} and {b:{c}} and {f'{d}'}"
    e, g = f(c, d)
    return "a string" + """another one,
    of two lines"""  # xxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxxx
'''


def test_a_sample_is_counted_right():
    """Seven lines of code: x, def, four in the function and the string's second. Tokens: 3 + 8 + 7 + 5 + 10 + 4."""
    assert count(SAMPLE) == Counts(lines=13, code=7, tokens=37, long=1, tuples=1, chains=1)


def test_an_f_string_is_one_token():
    """Here is how Python 3.12 takes `x = f"{a + f'{b}'} c"` apart, and how Python 3.11 does not."""
    apart = ["NAME", "OP", "FSTRING_START", "OP", "NAME", "OP", "FSTRING_START", "OP", "NAME", "OP", "FSTRING_END"]
    apart += ["OP", "FSTRING_MIDDLE", "FSTRING_END", "NEWLINE", "ENDMARKER"]
    assert count_tokens(apart) == count_tokens(["NAME", "OP", "STRING", "NEWLINE", "ENDMARKER"]) == 3


def test_a_dense_sample_fails():
    """Every ceiling is one that a file can break."""
    dense = Counts(lines=621, code=450, tokens=5_001, long=21, tuples=9, chains=1)
    assert len(problems("avf_qplex.py", dense)) == 6
    assert len(problems("envs/core.py", dense)) == 4, "a domain's length has no ceiling"
    fits = Counts(lines=620, code=460, tokens=5_000, long=20, tuples=8, chains=0)
    assert not problems("avf_qplex.py", fits)
    assert problems("avf_vdn.py", fits) == ["avf_vdn.py: 5000 tokens, 4300 at most"]
    assert problems("dense.py", count("a, b = f(x[1:], y[:, None])[0], {key: value for key, value in z.items()}\n"))
