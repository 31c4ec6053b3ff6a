"""Definitions of one name are the same in every algorithm script that has it, but for the table below.

    python tests/sync.py                                shows where scripts differ that should not
    python tests/sync.py copy avf_vdn.py evaluate       copies a definition from one script to the others of its group

What can be copied: a top-level function or class, a field of Args (`Args.gamma`) or `Args.__post_init__`, a family's
row of DEFAULTS (`DEFAULTS.bp`). `train` has a few lines that are the algorithm's own: it is compared line by line, and
cannot be copied.
"""

import ast
import difflib
import re
import sys
from itertools import combinations
from pathlib import Path

ROOT = Path(__file__).parents[1]
Q_LEARNING = "avf_vdn avf_qmix avf_qplex dec_maddrqn cen_maddrqn"
SCRIPTS = (*Q_LEARNING.split(), "mac_iaicc")

# Where definitions of one name differ: groups within which they are the same. All others are the same in all scripts.
GROUPS = {
    "Agents": ["avf_vdn avf_qmix avf_qplex dec_maddrqn", "mac_iaicc"],  # logits, and a docstring that says so
    "over_rows": [Q_LEARNING, "mac_iaicc"],  # the same code, a docstring of logits
    "ReplayBuffer": ["avf_qmix avf_qplex", "avf_vdn dec_maddrqn cen_maddrqn"],  # with states for a mixer, without
    "td_loss": ["avf_qmix avf_qplex", "avf_vdn", "cen_maddrqn"],  # with a mixer, the sum, the team's own value
    "own_returns": ["dec_maddrqn", "mac_iaicc"],  # lambda-returns within a window, n-step returns
    "act": ["avf_vdn avf_qmix avf_qplex dec_maddrqn", "cen_maddrqn", "mac_iaicc"],
    "make_learner": ["avf_vdn dec_maddrqn", "avf_qmix", "avf_qplex", "cen_maddrqn", "mac_iaicc"],
    "Args.__post_init__": [Q_LEARNING, "mac_iaicc"],  # names of settings that the others do not have
    "DEFAULTS.bp": [Q_LEARNING, "mac_iaicc"],
    "DEFAULTS.wtd-t": [Q_LEARNING, "mac_iaicc"],
    "DEFAULTS.ct": [Q_LEARNING, "mac_iaicc"],
    "Args.td_lambda": ["avf_vdn avf_qmix avf_qplex", "dec_maddrqn cen_maddrqn"],  # docs/defaults.md, Warehouse
    **{f"Args.{field}": [Q_LEARNING, "mac_iaicc"] for field in (  # other values, or other words
        "num_envs", "gamma", "batch_size", "polyak", "end_e", "exploration_timesteps", "reward_scale", "hidden_size")},
}  # fmt: skip

# Lines of `train` that may differ between any two scripts: what is stored and the loss.
OWN_LINES = [
    r'state = infos\["state"\]',
    r'buffer\.add\(obs, actions, infos\["macro_done"\](, state)?\)',
    r"buffer\.step\((state, )?args\.reward_scale \* rewards, step_gamma \* ~terminations, over, obs, infos\)",
    r"batch = (team_batch\()?buffer\.sample\(args\.batch_size, args\.window, (args\.mixer_state, )?rng, args\.device\)"
    r"(, agents\))?",
    r'loss, (joint_q, _|q, _, _) = (td|own)_loss\(\*utilities, (learner\["mixer"\], target\["mixer"\], )?batch, '
    r"args\.td_lambda, beta\)",
    r'log\("losses", td_loss=loss, q_values=(joint_q|q\[batch\["valid"\]\])\.mean\(\), grad_norm=grad_norm\)',
]
# And those between mac_iaicc.py, an actor-critic that learns from whole episodes, and the others.
IAICC_LINES = [
    r"target, agents = copy\.deepcopy\(learner(\[\"critics\"\])?\)\.requires_grad_\(False\), learner\[\"agents\"\]",
    r"buffer = (ReplayBuffer\(env, args\.buffer_size\)|EpisodeBuffer\(env, args\.batch_size \+ args\.num_envs\))",
    r"epsilon = np\.interp\(step( - args\.learning_starts)?, \[0, args\.exploration_timesteps\], "
    r"\[(1\.0|args\.start_e), args\.end_e\]\)",
    r"# Learn( from the episodes that ended, once)?",
    r"while updates < \(step - args\.learning_starts\) // args\.train_frequency "
    r"and buffer\.rows\[buffer\.queue\]\.any\(\):",
    r"if np\.count_nonzero\(buffer\.rows\[buffer\.queue\]\) >= args\.batch_size:",
    r"batch = buffer\.take\(args\.device\)",
    r'utilities = over_rows\(batch, agents, target\["agents"\]\)',
    r"beta = np\.interp\(\(step - args\.learning_starts\) / args\.exploration_timesteps, \[1, 2\], "
    r"\[args\.hysteresis, 1\.0\]\)",
    r"joint = joint_batch\(batch, max\(env\.n_actions\)\)",
    r'values, target_values = \(x\[\.\.\., 0\] for x in over_rows\(joint, learner\["critics"\], target\)\)  # .*',
    r"policy = soft_policy\(over_rows\(batch, agents\)\[0\], epsilon\)  # .*",
    r"returns = own_returns\(batch, target_values, args\.n_step\)",
    r"losses = actor_critic_loss\(policy, values, returns, batch, args\.entropy_coef\)",
    r"loss(es\[0\])?\.backward\(\)",
    r'critics = list\(learner\["critics"\]\.parameters\(\)\)',
    r"torch\.optim\.swa_utils\.get_ema_multi_avg_fn\(args\.polyak\)\(slow, (fast|critics), None\)",
    r"if updates % (100|10) == 0:",
    r'q_values = values\[batch\["valid"\]\]\.mean\(\)',
    r'log\("losses", td_loss=losses\[2\], q_values=q_values, grad_norm=grad_norm\)',
    r'log\("losses", actor_loss=losses\[1\], entropy=losses\[3\]\)',
]


def scripts(root=ROOT):
    """The algorithm scripts: {name: text}."""
    return {name: (root / f"{name}.py").read_text() for name in SCRIPTS}


def definitions(text):
    """Where definitions stand: {name: (first, last line)}, from 1 on; with the imports and, as "", the docstring."""
    where = {}

    def note(name, node, last=None):
        first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
        if name in where:
            raise ValueError(f"{name} is defined twice")
        where[name] = first, last or node.end_lineno

    for node in ast.parse(text).body:
        if isinstance(node, ast.ClassDef) and node.name == "Args":
            for part in node.body:
                if isinstance(part, ast.AnnAssign):
                    note(f"Args.{part.target.id}", part)
                elif isinstance(part, ast.FunctionDef):
                    note(f"Args.{part.name}", part)
        elif isinstance(node, ast.ClassDef | ast.FunctionDef):
            note(node.name, node)
        elif isinstance(node, ast.Assign) and node.targets[0].id == "DEFAULTS":
            for key, value in zip(node.value.keys, node.value.values, strict=True):
                note(f"DEFAULTS.{key.value}", key, value.end_lineno)
        elif isinstance(node, ast.Import | ast.ImportFrom):
            note(f"import {ast.unparse(node)}", node)
        elif isinstance(node, ast.Expr):
            note("", node)  # the module's docstring
    return where


def cut(text, where):
    return "\n".join(text.splitlines()[where[0] - 1 : where[1]])


def parts(text):
    """{name: source} of a script's definitions, with "the rest": what stands between them, without blank lines."""
    where, lines = definitions(text), text.splitlines()
    inside = {number for first, last in where.values() for number in range(first, last + 1)}
    rest = [line for number, line in enumerate(lines, 1) if number not in inside and line.strip()]
    found = {name: cut(text, place) for name, place in where.items() if name and not name.startswith("import ")}
    return found | {"the rest": "\n".join(rest)}


def groups(name, having):
    """The groups of scripts, of those that have it, within which a definition is the same."""
    found = [set(group.split()) for group in GROUPS.get(name, [" ".join(having)])]
    if set().union(*found) != set(having) or sum(map(len, found)) != len(having):
        raise ValueError(f"the table has other scripts for {name} than have it: {' '.join(having)}")
    return [[script for script in having if script in group] for group in found]


def diff(one, other, from_name, to_name):
    return list(difflib.unified_diff(one.splitlines(), other.splitlines(), from_name, to_name, lineterm="", n=1))


def stray_lines(one, other, between):
    """Lines of two versions of `train` that differ and are no script's own; between: the two scripts' names."""
    allowed = OWN_LINES + (IAICC_LINES if "mac_iaicc" in between else [])
    lines = [line for line in difflib.ndiff(one.splitlines(), other.splitlines()) if line[0] in "+-"]
    return [line for line in lines if line[2:].strip() and not any(re.fullmatch(r, line[2:].strip()) for r in allowed)]


def differences(texts):
    """Where scripts differ that should not, as a diff; empty if nowhere. texts: {name: text}."""
    split, found = {script: parts(text) for script, text in texts.items()}, []
    for name in dict.fromkeys(name for script in split.values() for name in script):
        having = [script for script in split if name in split[script]]
        if name == "train":
            for one, other in combinations(having, 2):
                stray = stray_lines(split[one][name], split[other][name], (one, other))
                found += [f"train, {one}.py (-) and {other}.py (+):", *stray] if stray else []
            continue
        for group in groups(name, having):
            for other in group[1:]:
                labels = f"{group[0]}.py {name}", f"{other}.py {name}"
                found += diff(split[group[0]][name], split[other][name], *labels)
    return "\n".join(found)


def copied(texts, source, name):
    """{script: text} of the scripts that change when a definition of the source is copied to its group."""
    split = {script: parts(text) for script, text in texts.items()}
    if name == "train" or name not in definitions(texts[source]):
        raise ValueError(f"{source}.py has no definition {name} that could be copied")
    (group,) = (g for g in groups(name, [s for s in split if name in split[s]]) if source in g)
    changed = {}
    for script in group:
        if split[script][name] != split[source][name]:
            first, last = definitions(texts[script])[name]
            lines = texts[script].splitlines(keepends=True)
            new = split[source][name] + "\n"
            changed[script] = "".join([*lines[: first - 1], new, *lines[last:]])
    return changed


def main(argv):
    if not argv:
        found = differences(scripts())
        print(found or "the scripts are in sync")
        return 1 if found else 0
    if len(argv) != 3 or argv[0] != "copy" or Path(argv[1]).stem not in SCRIPTS:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        changed = copied(scripts(), Path(argv[1]).stem, argv[2])
    except ValueError as error:
        print(error, file=sys.stderr)
        return 2
    for script, text in changed.items():
        (ROOT / f"{script}.py").write_text(text)
    print(f"rewrote {' '.join(f'{script}.py' for script in changed)}" if changed else "nothing to copy")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
