"""Definitions of one name are the same in every algorithm script that has it, but for the tables below.

    python tests/sync.py                                shows where scripts differ that should not
    python tests/sync.py copy avf_vdn.py evaluate       copies a definition from one script to the others of its group

What can be copied: a top-level function or assignment, a class's head with its docstring (`Agents`), a method
(`Agents.forward`), a field (`Args.gamma`), a row of DEFAULTS (`DEFAULTS.bp-`). `train` is compared without the lines
that OWN_LINES lists. What stands between definitions is compared as "the rest".
"""

import ast
import difflib
import re
import sys
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
AVF = "avf_vdn avf_qmix avf_qplex"
WITH_MIXER = "avf_qmix avf_qplex"
Q_LEARNING = f"{AVF} dec_maddrqn cen_maddrqn"
SCRIPTS = (*Q_LEARNING.split(), "mac_iaicc")
OTHER_NAMES = {"EpisodeBuffer": "ReplayBuffer"}  # mac_iaicc.py keeps no old episodes, but its buffer is the same

# Where definitions of one name differ: groups within which they are the same. All others are the same in all scripts.
GROUPS = {
    "AT_MOST_1": [Q_LEARNING, "mac_iaicc"],  # names of settings that the others do not have
    "Agents": [f"{AVF} dec_maddrqn", "mac_iaicc"],  # utilities, or outputs of actors and of critics
    "Agents.forward": [f"{AVF} dec_maddrqn", "mac_iaicc"],
    "ReplayBuffer": [Q_LEARNING, "mac_iaicc"],
    "ReplayBuffer.__init__": ["avf_vdn dec_maddrqn cen_maddrqn", WITH_MIXER, "mac_iaicc"],  # states are for a mixer
    "ReplayBuffer.begin_rows": ["avf_vdn dec_maddrqn cen_maddrqn mac_iaicc", WITH_MIXER],
    "ReplayBuffer.add_step": ["avf_vdn dec_maddrqn cen_maddrqn mac_iaicc", WITH_MIXER],
    "make_batch": ["avf_vdn dec_maddrqn cen_maddrqn mac_iaicc", WITH_MIXER],
    "td_loss": ["avf_vdn", WITH_MIXER, "cen_maddrqn"],
    "own_returns": ["dec_maddrqn", "mac_iaicc"],  # Q(lambda) returns, n-step returns
    "act": [f"{AVF} dec_maddrqn", "cen_maddrqn", "mac_iaicc"],  # agents, the team, policies
    "make_learner": ["avf_vdn dec_maddrqn", "avf_qmix", "avf_qplex", "cen_maddrqn", "mac_iaicc"],
    "train": ["avf_vdn", WITH_MIXER, "dec_maddrqn", "cen_maddrqn", "mac_iaicc"],  # but for OWN_LINES it is the same
    "Args.__post_init__": [Q_LEARNING, "mac_iaicc"],
    "Args.seed": [Q_LEARNING, "mac_iaicc"],  # no replay
    "Args.total_timesteps": [Q_LEARNING, "mac_iaicc"],
    "Args.num_envs": [Q_LEARNING, "mac_iaicc"],
    "Args.gamma": [Q_LEARNING, "mac_iaicc"],
    "Args.batch_size": [Q_LEARNING, "mac_iaicc"],
    "Args.polyak": [Q_LEARNING, "mac_iaicc"],
    "Args.exploration_timesteps": [Q_LEARNING, "mac_iaicc"],
    "Args.end_e": [Q_LEARNING, "mac_iaicc"],
    "Args.reward_scale": [Q_LEARNING, "mac_iaicc"],
    "Args.hysteresis": [Q_LEARNING, "mac_iaicc"],
    "DEFAULTS.bp-": [Q_LEARNING, "mac_iaicc"],
    "DEFAULTS.wtd-t": [Q_LEARNING, "mac_iaicc"],
    "DEFAULTS.ct-": [Q_LEARNING, "mac_iaicc"],
}

# Lines of `train` that the named scripts have, in pieces with an empty line between them. Without these, `train` is the
# same in all scripts. A comment behind a piece's last line stays, unless it is listed, too.
OWN_LINES = {
    "avf_vdn dec_maddrqn cen_maddrqn mac_iaicc": """
        buffer.add_step(args.reward_scale * rewards, np.where(terminations, 0.0, args.gamma))
""",
    WITH_MIXER: """
        state = infos["state"]

        buffer.add_step(state, args.reward_scale * rewards, np.where(terminations, 0.0, args.gamma))

    mixer = learner["mixer"]

            loss, q, _ = td_loss(utilities, target_utilities, mixer, target["mixer"], batch, args, hysteresis)
""",
    "avf_vdn": """
            loss, q, _ = td_loss(utilities, target_utilities, batch, args, hysteresis)
""",
    "dec_maddrqn": """
            loss, q, _ = own_loss(utilities, target_utilities, batch, args, hysteresis)
""",
    f"{AVF} dec_maddrqn": """
            utilities = utilities_at_rows(agents, batch)
            target_utilities = utilities_at_rows(target["agents"], batch)
""",
    "cen_maddrqn": """
            values = values_at_rows(agents, batch)
            target_values = values_at_rows(target["agents"], batch)
            loss, q, _ = td_loss(values, target_values, agents, batch, args, hysteresis)
""",
    Q_LEARNING: """
    seeds = np.random.SeedSequence(args.seed).generate_state(5, np.uint64).tolist()
    network_seed, explore_seed, replay_seed, env_seed, eval_seed = seeds

    replay_rng = np.random.default_rng(replay_seed)

    target = copy.deepcopy(learner).requires_grad_(False)  # the target networks, without gradients

    buffer = ReplayBuffer(env, args.buffer_size)

            explore_rng.bit_generator.state, replay_rng.bit_generator.state = saved["rngs"]

        phase = (step - args.learning_starts) / args.exploration_timesteps

        epsilon = np.interp(phase, [0, 1], [1.0, args.end_e])

        # ---- learn: an update for each multiple of train_frequency that was just passed ----
        due = step // args.train_frequency - (step - args.num_envs) // args.train_frequency
        can_learn = step > args.learning_starts and buffer.ended
        for _ in range(due if can_learn else 0):

            batch = make_batch(buffer.sample(args.batch_size, replay_rng), args.device)

            for slow, fast in zip(target.parameters(), learner.parameters(), strict=True):

            if not step // args.train_frequency % 100:  # one in a hundred
                writer.add_scalar("losses/td_loss", loss, step)
                writer.add_scalar("losses/q_values", q.mean(), step)

                rngs=(explore_rng.bit_generator.state, replay_rng.bit_generator.state),
""",
    "mac_iaicc": """
    seeds = np.random.SeedSequence(args.seed).generate_state(4, np.uint64).tolist()
    network_seed, explore_seed, env_seed, eval_seed = seeds

    target = copy.deepcopy(learner["critics"]).requires_grad_(False)  # the target critics, without gradients

    buffer = EpisodeBuffer(env)

            explore_rng.bit_generator.state = saved["explore_rng"]

        phase = (step - args.random_timesteps) / args.exploration_timesteps

        epsilon = np.interp(phase, [0, 1], [args.start_e, args.end_e]) if phase >= 0 else 1.0

        # ---- learn: an update on the episodes that have ended, once there are batch_size ----
        if len(buffer.ended) >= args.batch_size:

            batch = make_batch(buffer.ended, args.device)
            buffer.ended.clear()
            policy = soft_policy(logits_at_rows(agents, batch), batch["available"], epsilon)
            values = learner["critics"](batch)  # [B, T, n]
            returns = own_returns(target(batch), batch, args.n_step)
            losses = actor_critic_loss(policy, values, returns, batch, args.entropy_coef, hysteresis)
            loss, actor_loss, critic_loss, entropy = losses
            if phase < 0:  # all policies are uniform, so only the critics learn
                loss = critic_loss

            for slow, fast in zip(target.parameters(), learner["critics"].parameters(), strict=True):

            writer.add_scalar("losses/actor_loss", actor_loss, step)
            writer.add_scalar("losses/critic_loss", critic_loss, step)
            writer.add_scalar("losses/entropy", entropy, step)
            writer.add_scalar("losses/values", values[batch["valid"]].mean(), step)

                explore_rng=explore_rng.bit_generator.state,
""",
}


def scripts():
    """The algorithm scripts: {name: text}."""
    return {name: (ROOT / f"{name}.py").read_text() for name in SCRIPTS}


@cache
def definitions(text):
    """Where definitions stand: {name: (first, last line)}, from 1 on; with the imports and, as "", the docstring."""
    where = {}

    def note(name, node, last=None):
        first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
        if name in where:
            raise ValueError(f"{name} is defined twice")
        where[name] = first, last or node.end_lineno

    for node in ast.parse(text).body:
        match node:
            case ast.ClassDef():
                name = OTHER_NAMES.get(node.name, node.name)
                note(name, node, node.body[0].end_lineno if ast.get_docstring(node) else node.lineno)
                for member in node.body:
                    if isinstance(member, ast.AnnAssign):
                        note(f"{name}.{member.target.id}", member)
                    elif isinstance(member, ast.FunctionDef):
                        note(f"{name}.{member.name}", member)
            case ast.FunctionDef():
                note(node.name, node)
            case ast.Assign(targets=[ast.Name(id="DEFAULTS")]):
                for key, value in zip(node.value.keys, node.value.values, strict=True):
                    note(f"DEFAULTS.{key.value}", key, value.end_lineno)
            case ast.Assign(targets=[ast.Name(id=name)]):
                note(name, node)
            case ast.Import() | ast.ImportFrom():
                note(f"import {ast.unparse(node)}", node)
            case ast.Expr():
                note("", node)  # the module's docstring
    return where


@cache
def parts(text):
    """{name: source} of a script's definitions, and "the rest": what stands between them, without blank lines."""
    lines = text.splitlines()
    found = {}
    inside = set()
    for name, (first, last) in definitions(text).items():
        inside.update(range(first, last + 1))
        if name and not name.startswith("import "):
            found[name] = "\n".join(lines[first - 1 : last])
    rest = [line for number, line in enumerate(lines, 1) if number not in inside and line.strip()]
    return found | {"the rest": "\n".join(rest)}


def groups(name, having):
    """The groups of scripts, of those that have it, within which a definition is the same."""
    found = [group.split() for group in GROUPS.get(name, [" ".join(having)])]
    if sorted(script for group in found for script in group) != sorted(having):
        raise ValueError(f"the table has other scripts for {name} than have it: {' '.join(having)}")
    return found


def pieces(own):
    """The pieces of code in an entry of OWN_LINES: an empty line stands between them."""
    return [piece for piece in own.strip("\n").split("\n\n") if piece]


def common_train(script, train):
    """A script's `train` without its own lines. If these have comments that the table does not have, they stay."""
    for names, own in OWN_LINES.items():
        if script in names.split():
            for piece in pieces(own):
                train, count = re.subn(rf"^{re.escape(piece)}(\n|(?=  #))", "", train, flags=re.M)
                if count != 1:
                    raise ValueError(f"OWN_LINES has lines that are not once in train of {script}.py:\n{piece}")
    return train


def compared(name, sources):
    """The lines of a diff between the first of several sources, {script: text}, and each of the others."""
    (first, source), *others = sources.items()
    lines = []
    for other, other_source in others:
        labels = f"{first}.py {name}", f"{other}.py {name}"
        lines += difflib.unified_diff(source.splitlines(), other_source.splitlines(), *labels, lineterm="", n=1)
    return lines


def train_differences(trains):
    """Where `train` differs between scripts, {script: text}, but for their own lines; the lines of a diff."""
    try:
        return compared("train, what is common", {script: common_train(script, trains[script]) for script in trains})
    except ValueError as error:
        return [str(error)]


def differences(texts):
    """Where scripts differ that should not, as a diff; empty if nowhere. texts: {name: text}."""
    split = {script: parts(text) for script, text in texts.items()}
    found = []
    for name in dict.fromkeys(name for script in split.values() for name in script):
        for group in groups(name, [script for script in split if name in split[script]]):
            found += compared(name, {script: split[script][name] for script in group})
    found += train_differences({script: split[script]["train"] for script in split})
    return "\n".join(found)


def copied(texts, source, name):
    """{script: text} of the scripts that change when a definition of the source is copied to its group."""
    split = {script: parts(text) for script, text in texts.items()}
    if name not in definitions(texts[source]):
        raise ValueError(f"{source}.py has no definition {name}")
    having = [script for script in split if name in split[script]]
    (group,) = (group for group in groups(name, having) if source in group)
    changed = {}
    for script in group:
        if split[script][name] != split[source][name]:
            first, last = definitions(texts[script])[name]
            lines = texts[script].splitlines(keepends=True)
            changed[script] = "".join([*lines[: first - 1], split[source][name] + "\n", *lines[last:]])
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
