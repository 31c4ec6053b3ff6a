"""A report of runs in Markdown, PNG and CSV: learning curves, final performance, comparisons.

    python benchmark/report.py RUNS... -o report/

RUNS are run folders, folders of them, or an evaluations.csv of an earlier report, from which the same report is made
again without event files. It writes README.md, evaluations.csv (every evaluation), runs.csv (flags and commit of every
run) and, with matplotlib, figures.

A run counts with the mean of its last evaluations (--last), so that no lucky point decides. Runs of an algorithm on a
task whose flags are not those of the others are kept apart as *variants*, named by the flags.
"""

import argparse
import csv
import functools
import importlib.util
import json
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
from tensorboard.compat.proto.event_pb2 import Event, SessionLog

ROOT = Path(__file__).resolve().parents[1]
VALUES = ("step", "return", "discounted_return", "length", "success", "wall_clock_s")
RUNS = ("algorithm", "task", "variant", "seed", "total_timesteps", "started", "commit", "flags")
RESAMPLES = 5_000

# Flags that say where a run stands or how often it is saved; that do not change what is learned; that make a variant
# only beside runs of the same algorithm, because scripts may differ in their defaults
PLUMBING = {"algorithm", "env", "seed", "runs_dir", "resume", "evaluate", "model", "gif", "checkpoint_frequency"}
NO_VARIANT = {"device", "torch_threads", "eval_episodes"}
OF_THE_RUN = {"total_timesteps", "eval_frequency"}

# Name, colour (of Okabe and Ito, which the colour-blind can tell apart) and marker, in the order of the tables
ALGORITHMS = {
    "avf_qplex": ("AVF-QPLEX", "#D55E00", "o"),
    "avf_qmix": ("AVF-QMIX", "#0072B2", "s"),
    "avf_vdn": ("AVF-VDN", "#009E73", "^"),
    "dec_maddrqn": ("Dec-MADDRQN", "#E69F00", "v"),
    "cen_maddrqn": ("Cen-MADDRQN", "#CC79A7", "D"),
    "mac_iaicc": ("Mac-IAICC", "#56B4E9", "P"),
}
OTHERS = [("#332288", "X"), ("#882255", "*"), ("#999933", "p"), ("#44AA99", "h"), ("#661100", "<"), ("#777777", ">")]
GREY, DASHED, DOTTED, DASH_DOT = "#444444", (0, (5, 2)), (0, (1, 1.5)), (0, (6, 2, 1, 2))

# The paper's numbers and what stands behind their +-; its figures give none. On primitive tasks, where every
# macro-action lasts a step, avf_*.py is the primitive algorithm.
PAPER = {
    "ct-10": dict(dec_maddrqn=(0.05, 0.02), cen_maddrqn=(0.35, 0.09), avf_vdn=(0.13, 0.05), avf_qmix=(0.26, 0.08),
                  avf_qplex=(0.61, 0.09), mac_iaicc=(0.29, 0.06), table="Table 1"),
    "bp-10-primitive": dict(avf_vdn=(-4.1, 10.5), avf_qmix=(-2.0, 9.3), avf_qplex=(13.4, 2.6), table="Table 3"),
    "wtd-s-primitive": dict(avf_vdn=(32, 4.5), avf_qmix=(44, 6.2), avf_qplex=(61, 5.3), table="Table 3"),
    "ct-10-primitive": dict(avf_vdn=(0.04, 0.01), avf_qmix=(0.09, 0.03), avf_qplex=(0.20, 0.04), table="Table 3"),
}  # fmt: skip

# When a run has solved its task: from this final return on, or from this share of the scripted policy's. Box Pushing
# ends with +10 for a small box or +100 for the big one. "Always Move-to-T" on ct-10 is no ceiling: it counts in full.
# Also the order of the tasks.
BIG_BOX = {"return": 90.0}
SOLVED = {"bp-10": BIG_BOX, "bp-20": BIG_BOX, "bp-30": BIG_BOX, "wtd-s": {"share": 0.95}, "wtd-d": {"share": 0.95},
          "wtd-t": {"share": 0.95}, "wtd-t1": {"share": 0.95}, "ct-10": {"share": 1.0}, "bp-10-primitive": BIG_BOX,
          "wtd-s-primitive": {"share": 0.95}, "ct-10-primitive": {"share": 0.95}}  # fmt: skip


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"report: {message}")


# Statistics


def standard_error(x):
    """Standard error of the mean over the first axis (n - 1); nan for a single run."""
    return x.std(0, ddof=1) / len(x) ** 0.5 if len(x) > 1 else np.full(x.shape[1:], np.nan)


def iqm(x, axis=0):
    """Interquartile mean: the mean without the lowest and the highest quarter, values on the edge counting in part.

    Where 4 divides the number of values this is SciPy's trim_mean(x, 0.25), which rliable uses. That one rounds a
    quarter of the number down, so it cuts nothing from three runs; here three have the weights 1/6, 4/6, 1/6.
    """
    n, ordered = x.shape[axis], np.moveaxis(np.sort(x, axis), axis, -1)
    edges = np.clip(np.arange(n + 1), n / 4, 3 * n / 4)
    return ordered @ np.diff(edges) / (n / 2)


def bootstrap(strata, statistic, level=0.95):
    """Percentile interval of a statistic under stratified resampling: runs are redrawn within their stratum.

    Args:
        strata: list of float arrays [n_k, ...]. statistic: a function of a list of arrays [resamples, n_k, ...] that
            returns [resamples, ...].

    Returns:
        float array [2, ...], the ends. The same strata give the same interval.
    """
    rng = np.random.default_rng(0)
    drawn = [x[rng.integers(len(x), size=(RESAMPLES, len(x)))] for x in strata]
    return np.quantile(statistic(drawn), [(1 - level) / 2, (1 + level) / 2], axis=0)


def pooled_iqm(strata):
    """For `bootstrap`: the interquartile mean over the runs of all strata."""
    return iqm(np.concatenate(strata, 1), 1)


def improvement(strata):
    """P(X > Y) of Agarwal et al. 2021: the mean over tasks of the share of pairs of runs with x > y, ties count half.

    strata: x and y of the first task, of the second and so on, float [..., n_x] and [..., n_y]. Also for `bootstrap`.
    """
    pairs = zip(strata[::2], strata[1::2], strict=True)
    return np.mean([(np.sign(x[..., :, None] - y[..., None, :]) / 2 + 0.5).mean((-2, -1)) for x, y in pairs], 0)


# Reading


@dataclass
class Run:
    """A run: how it was made, and its evaluations.

    flags: those that differ from the script's defaults, as text. started: seconds since 1970. values: float [E, 6], the
    columns are VALUES. place: where it was read, in words.
    """

    algorithm: str
    task: str
    seed: int
    total_timesteps: int
    started: int
    commit: str
    flags: dict
    values: np.ndarray
    place: str
    variant: str = ""

    def learning_flags(self):
        return {k: v for k, v in self.flags.items() if k not in NO_VARIANT}


@functools.cache
def script_defaults(algorithm, task, warn):
    """The flags in force for a task by default, by name; none, with a warning, if the script does not tell."""
    if not (ROOT / f"{algorithm}.py").exists():
        warn(f"there is no {algorithm}.py to compare with, so all flags of its runs are named")
        return {}
    sys.path.insert(0, str(ROOT))
    try:
        return vars(importlib.import_module(algorithm).defaults(task))
    except Exception as error:  # whatever a script may raise when it is imported
        warn(f"{algorithm}.py does not tell its defaults, so all flags of its runs are named: {error!r}")
        return {}
    finally:
        sys.path.pop(0)


def read_events(folder, warn):
    """The evaluations in a run folder's event files, float [E, 6].

    A resumed run has several: each says from which step on it replaces the earlier ones. The wall-clock leaves out the
    time between stop and resume, and work that was lost and done again.
    """
    files = []
    for path in folder.glob("events.out.tfevents.*"):
        records = list(RawEventFileLoader(str(path)).Load())
        read, size = sum(len(record) + 16 for record in records), path.stat().st_size  # 16: length and checksums
        if read < size:
            warn(f"{folder.name}: an event file is damaged from byte {read:,} on; what stands before counts", path)
        files += [[Event.FromString(record) for record in records]] if records else []
    points, clock = {}, {}  # by step: values, and seconds of work so far
    for events in sorted(files, key=lambda events: events[0].wall_time):
        earlier = None
        for event in events:
            if event.session_log.status == SessionLog.START:
                points, clock = ({s: x for s, x in of.items() if s < event.step} for of in (points, clock))
            for value in event.summary.value:
                if earlier is None:
                    earlier = max(clock.values(), default=0.0)
                clock[event.step] = earlier + event.wall_time - events[0].wall_time
                kind, _, name = value.tag.partition("/")
                if kind == "eval" and name in VALUES:  # seven digits: those of float32, and the CSV's
                    points.setdefault(event.step, {})[name] = float(f"{value.simple_value:.7g}")
    rows = [{"step": step, "wall_clock_s": round(clock[step], 1), **points[step]} for step in sorted(points)]
    return np.array([[row.get(name, np.nan) for name in VALUES] for row in rows]).reshape(-1, len(VALUES))


def read_folder(folder, commit, warn):
    """The Run of a run folder; None, with a warning, if there is nothing to read."""
    try:
        saved = json.loads((folder / "args.json").read_text())
        about = [saved[key] for key in ("algorithm", "env", "seed", "total_timesteps")]
    except (OSError, ValueError, KeyError, TypeError) as error:
        return warn(f"{folder.name}: left out, args.json is damaged: {error!r}", folder)
    values = read_events(folder, warn)
    if not len(values):
        return warn(f"{folder.name}: left out, no evaluations", folder)
    algorithm, task, seed, steps = about
    usual = script_defaults(algorithm, task, warn)
    ours = {k: v for k, v in saved.items() if k not in PLUMBING and not k.startswith(("track", "wandb"))}
    flags = {k: str(v) for k, v in ours.items() if k not in usual or usual[k] != v}
    time = folder.name.rpartition("__")[2].partition("-")[0]
    started = int(time) if time.isdigit() else 0
    return Run(algorithm, task, seed, steps, started, commit, flags, values, folder.name)


def read_csv(path, warn):
    """The Runs of an evaluations.csv. Their flags and commits come from the runs.csv beside it."""
    try:
        found, known, runs = {}, {}, []
        with open(path, newline="") as file:
            for row in csv.DictReader(file):
                values = [float(row[name] or "nan") for name in VALUES]
                found.setdefault(tuple(row[k] for k in RUNS[:4]), []).append(values)
        if (path.parent / "runs.csv").exists():
            with open(path.parent / "runs.csv", newline="") as file:
                known = {tuple(row[k] for k in RUNS[:4]): row for row in csv.DictReader(file)}
        if unknown := len(found.keys() - known.keys()):
            warn(f"{path.name}: {unknown} of {len(found)} runs are in no runs.csv beside it; their flags are not known")
        for key, values in found.items():
            algorithm, task, variant, seed = key
            if not (row := known.get(key)):
                flags = json.dumps(dict(flag.split("=", 1) for flag in variant.split()))
                row = {"total_timesteps": 0, "started": 0, "commit": "not known, nor are all flags", "flags": flags}
            about = int(seed), int(row["total_timesteps"]), int(row["started"]), row["commit"], json.loads(row["flags"])
            place = f"{algorithm} on {task}, seed {seed}, of {path.name}"
            runs.append(Run(algorithm, task, *about, np.array(sorted(values)), place))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        fail(f"{path} or the runs.csv beside it is damaged: {error!r}")
    return runs


def read_runs(paths, commit, unfinished, warn):
    """The runs below the paths, finished ones only and of duplicates the newest, sorted, with their variants."""
    runs = []
    for path in map(Path, paths):
        folders = sorted(file.parent for file in path.rglob("args.json"))
        table = path if path.suffix == ".csv" else path / "evaluations.csv"
        if not folders and table.is_file():
            runs += read_csv(table, warn)
        elif not folders:
            fail(f"no runs found in {path}")
        runs += filter(None, (read_folder(folder, commit, warn) for folder in folders))
    newest = {}
    for run in sorted(runs, key=lambda run: run.started):
        key, end = (run.task, run.algorithm, run.seed, *sorted(run.learning_flags().items())), int(run.values[-1, 0])
        if end < run.total_timesteps:
            how = "counts, but" if unfinished else "left out (--unfinished counts it),"
            warn(f"{run.place}: {how} only {end:,} of {run.total_timesteps:,} steps are done")
            if not unfinished:
                continue
        if key in newest:
            warn(f"{newest[key].place}: left out, {run.place} is newer and of the same flags and seed")
        newest[key] = run
    if not newest:
        fail("no finished run found")
    runs = list(newest.values())
    for run in runs:
        beside = [other for other in runs if other.task == run.task]
        same = [other for other in beside if other.algorithm == run.algorithm]
        run.variant = " ".join(
            f"{k}={v}"
            for k, v in run.learning_flags().items()
            if any(other.flags.get(k) != v for other in (same if k in OF_THE_RUN else beside))
        )
    order = [*SOLVED, *ALGORITHMS]  # others follow, by name

    def place(name):
        return (order.index(name) if name in order else len(order), name)

    return sorted(runs, key=lambda run: (place(run.task), place(run.algorithm), run.variant, run.seed))


# Groups of runs, which are the rows of tables, and sections, which are what is compared


class Group:
    """The runs of one algorithm, task and variant, at the steps at which all of them were evaluated.

    curves: by name in VALUES, float [runs, steps]; final: float [runs], the means of the last evaluations. label: the
    name, or a short one for a section of variants.
    """

    def __init__(self, runs, last, short):
        self.runs, self.algorithm, self.variant = runs, runs[0].algorithm, runs[0].variant
        plain = ALGORITHMS.get(self.algorithm, (self.algorithm,))[0]
        self.name = f"{plain}, {self.variant}" if self.variant else plain
        self.label = (self.variant or plain) if short else self.name
        steps = sorted(set.intersection(*(set(run.values[:, 0]) for run in runs)))
        if not steps:
            fail(f"the runs of {self.label} on {runs[0].task} have no step of evaluation in common")
        values = np.stack([run.values[np.searchsorted(run.values[:, 0], steps)] for run in runs], 2)
        self.curves = dict(zip(VALUES, values.transpose(1, 2, 0), strict=True))
        self.steps = self.curves["step"][0]
        # rounded, so that means of the same returns in another order are ties
        self.final = {name: curve[:, -last:].mean(1).round(6) for name, curve in self.curves.items()}
        self.paper = None if self.variant else PAPER.get(runs[0].task, {}).get(self.algorithm)


class Section:
    """What one figure and its tables compare: the algorithms on a task, or an algorithm's variants on it."""

    def __init__(self, task, groups, references, variants_of=None):
        self.task, self.groups, self.variants_of = task, groups, variants_of
        self.title = task + (f": variants of {ALGORITHMS.get(variants_of, (variants_of,))[0]}" if variants_of else "")
        self.file = f"{task}__{variants_of}.png" if variants_of else f"{task}.png"
        known = references.get(task, {})
        self.note = known.get("note")
        self.references = {k: known[k] for k in ("scripted", "random") if "return" in known.get(k, {})}
        largest = max(np.abs(group.final["return"]).max() for group in groups)
        self.digits = 3 if largest < 2 else 1
        # Early curves may go far down; the figure ends below the random policy by half of what the script is above it
        random, script = (self.references.get(k, {}).get("return", math.nan) for k in ("random", "scripted"))
        lowest = min(group.curves["return"].min() for group in groups)
        floor = random - (script - random) / 2
        self.cut = floor if lowest < floor else None

        rule = SOLVED.get(task, {})
        self.bar, self.bar_text = rule.get("return"), "which takes the big box"
        if "share" in rule and "scripted" in self.references:
            self.bar = rule["share"] * script
            self.bar_text = f"{rule['share']:.0%} of the scripted policy's"

    def reference_name(self, kind):
        name = self.references[kind].get("name")
        return f"{kind}: {name}" if name else f"{kind} policy"


def make_sections(runs, last, references):
    """The sections of a report; an algorithm that has variants gets a section of its own for them."""
    tasks = {}
    for run in runs:
        tasks.setdefault(run.task, {}).setdefault(run.algorithm, {}).setdefault(run.variant, []).append(run)
    for task, algorithms in tasks.items():
        several = [name for name, variants in algorithms.items() if len(variants) > 1]
        plain = [Group(variants.get("") or next(iter(variants.values())), last, False)
                 for variants in algorithms.values() if "" in variants or len(variants) == 1]  # fmt: skip
        if plain and list(algorithms) != several:
            yield Section(task, plain, references)
        for name in several:
            yield Section(task, [Group(x, last, True) for x in algorithms[name].values()], references, name)


def first_sections(sections):
    """The first section of each task, which is the one of its algorithms if it has one."""
    return list({section.task: section for section in reversed(sections)}.values())[::-1]


# Figures


def draw(ax, section, kind, named=True):
    """A panel of learning curves: the "mean" with standard errors, or the "IQM" with 95% bootstrap intervals."""
    for policy, reference in section.references.items():
        style = DASHED if policy == "scripted" else DOTTED
        name = section.reference_name(policy) if named else f"{policy} policy"
        ax.axhline(reference["return"], color=GREY, lw=1.2, ls=style, label=name, zorder=1)
    others, n = iter(OTHERS * len(section.groups)), len(section.groups)
    for i, group in enumerate(section.groups):
        own = group.algorithm in ALGORITHMS and not (section.variants_of and group.variant)
        colour, marker = ALGORITHMS[group.algorithm][1:] if own else next(others)
        x, y = group.steps / 1000, group.curves["return"]
        if kind == "mean":
            middle, error = y.mean(0), standard_error(y)
            low, high = middle - error, middle + error
        else:
            middle, (low, high) = iqm(y), bootstrap([y], pooled_iqm)
        if len(y) > 1:
            ax.fill_between(x, low, high, color=colour, alpha=0.15, lw=0, zorder=2)
        every = max(1, len(x) // 8)
        ax.plot(x, middle, color=colour, lw=1.7, marker=marker, ms=4.5, markevery=(i * every // n, every),
                label=group.label, zorder=3 + n - i)  # fmt: skip
        if group.paper:
            ax.axhline(group.paper[0], color=colour, lw=1.1, ls=DASH_DOT, alpha=0.75, zorder=1)
            ax.plot([], [], color=GREY, lw=1.1, ls=DASH_DOT, label="paper (algorithm's colour)")
    ax.margins(x=0.01)
    ax.set_xlim(0)
    if section.cut is not None:
        tops = [group.curves["return"].max() for group in section.groups] + [section.references["scripted"]["return"]]
        ax.set_ylim(section.cut, max(tops) + 0.05 * (max(tops) - section.cut))
    ax.set_xlabel("environment steps (thousands)")
    ax.grid(alpha=0.25, lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def write_figures(sections, output):
    """A figure for each section, and overview.png with the first section of each task."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    def finish(figure, axes, file):
        legend = {}
        for ax in axes:
            for handle, text in zip(*ax.get_legend_handles_labels(), strict=True):
                legend.setdefault(text, handle)
        texts = sorted(legend, key=lambda text: legend[text].get_color() == GREY)  # the algorithms first
        for columns in range(min(6, len(texts)), 0, -1):  # as many columns as fit, a column being as wide as its texts
            rows = math.ceil(len(texts) / columns)
            widths = [max(map(len, texts[i : i + rows])) + 9 for i in range(0, len(texts), rows)]
            if sum(widths) < 11 * figure.get_figwidth():
                break
        figure.set_figheight(figure.get_figheight() + 0.22 * rows)
        handles = [legend[text] for text in texts]
        figure.legend(handles, texts, loc="outside lower center", ncols=len(widths), frameon=False)
        figure.savefig(output / file, dpi=150)
        plt.close(figure)

    for section in sections:
        figure, axes = plt.subplots(1, 2, figsize=(10, 4.5), sharey=True, layout="constrained")
        for ax, kind, title in zip(axes, ("mean", "IQM"), ("mean ± standard error", "IQM, 95% interval"), strict=True):
            draw(ax, section, kind)
            ax.set_title(title, fontsize=10)
        axes[0].set_ylabel("return of greedy episodes")
        figure.suptitle(section.title)
        finish(figure, axes, section.file)

    first = first_sections(sections)
    columns = min(4, len(first))
    rows = math.ceil(len(first) / columns)
    size = (1 + 3.5 * columns, 0.6 + 2.9 * rows)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for ax, section in zip(axes.flat, first, strict=False):
        draw(ax, section, "mean", named=False)
        ax.set_title(section.title)
    for ax in axes[:, 0]:
        ax.set_ylabel("return, mean ± SE")
    for ax in axes.flat[len(first) :]:
        ax.set_visible(False)
    finish(figure, axes.flat, "overview.png")


# Text


def table(head, rows):
    """A Markdown table."""
    return "".join("| " + " | ".join(line) + " |\n" for line in (head, ["---"] * len(head), *rows))


def plus_minus(value, error, digits):
    return f"{value:.{digits}f}" + ("" if error is None or np.isnan(error) else f" ± {error:.{digits}f}")


def with_interval(strata, statistic, digits):
    """The statistic of the runs and its interval, which single runs do not have."""
    text = f"{statistic([x[None] for x in strata])[0]:.{digits}f}"
    if all(len(x) == 1 for x in strata):
        return text
    low, high = bootstrap(strata, statistic)
    return f"{text} [{low:.{digits}f}, {high:.{digits}f}]"


def solved(group, section):
    """How many runs solved the task, "" where that is not defined."""
    return f"{(group.final['return'] >= section.bar).sum()} of {len(group.runs)}" if section.bar is not None else ""


def summary_table(sections):
    """One row per algorithm, one column per task."""
    cells = {group.name: {} for section in sections for group in section.groups}
    for section in sections:
        for group in section.groups:
            text = with_interval([group.final["return"]], pooled_iqm, section.digits)
            cells[group.name][section.task] = ", ".join(filter(None, (text, solved(group, section))))
        for kind, reference in section.references.items():
            cells.setdefault(f"*{kind} policy*", {})[section.task] = f"{reference['return']:.{section.digits}f}"
    tasks = [section.task for section in sections]
    return table(["", *tasks], [[name, *(of.get(task, "") for task in tasks)] for name, of in cells.items()])


def performance_table(section):
    """The final performance of a section's groups, and below them what it can be compared with."""
    rows, digits, paper = [], section.digits, PAPER.get(section.task, {})
    for group in section.groups:
        cells = [group.label, str(len(group.runs)), f"{group.steps[-1]:,.0f}"]
        for name in ("return", "discounted_return"):
            x = group.final[name]
            cells += [plus_minus(x.mean(), standard_error(x), digits), with_interval([x], pooled_iqm, digits)]
            cells += [f"{np.median(x):.{digits}f}"]
        cells.insert(6, solved(group, section))
        cells.append(f"{group.paper[0]:g} ± {group.paper[1]:g} ({paper['table']})" if group.paper else "")
        seconds = group.curves["wall_clock_s"][:, -1].mean()
        rows.append([*cells, f"{seconds / 60:.1f} min" if seconds < 5_400 else f"{seconds / 3600:.1f} h"])
    for kind, reference in section.references.items():
        episodes = f"{reference['episodes']:,} episodes" if "episodes" in reference else ""
        discounted = f"{reference['discounted_return']:.{digits}f}" if "discounted_return" in reference else ""
        value = plus_minus(reference["return"], reference.get("se"), digits)
        rows.append([f"*{section.reference_name(kind)}*", "", episodes, value, *[""] * 3, discounted, *[""] * 4])
    head = ["", "runs", "steps", "return: mean ± SE", "IQM [95%]", "median", "solved", "discounted: mean ± SE",
            "IQM [95%]", "median", "paper", "time per run"]  # fmt: skip
    return table(head, rows)


def comparison_table(named):
    """P(X > Y) for all pairs. named: by label a list with the final returns on each task, float [runs]."""
    rows = []
    for x, of_x in named.items():
        pairs = {y: [a for pair in zip(of_x, of_y, strict=True) for a in pair] for y, of_y in named.items()}
        rows.append([x, *("" if x == y else with_interval(strata, improvement, 2) for y, strata in pairs.items())])
    return table(["P(row > column)", *named], rows)


def over_tasks(sections):
    """The part on all tasks together, "" if there are less than two with both references."""
    sections = [section for section in sections if len(section.references) == 2]
    scaled = {}
    for section in sections:
        high, low = (reference["return"] for reference in section.references.values())
        for group in section.groups:
            scaled.setdefault(group.name, []).append((group.final["return"] - low) / (high - low))
    everywhere = {name: strata for name, strata in scaled.items() if len(strata) == len(sections)}
    if len(sections) < 2 or not everywhere:
        return ""
    text = f"## All tasks together\n\nFinal returns on {', '.join(section.task for section in sections)}, scaled so "
    text += "that the random policy has 0 and the scripted policy 1. Intervals redraw the runs within each task.\n\n"
    rows = [[name, " + ".join(str(len(x)) for x in strata), with_interval(strata, pooled_iqm, 3),
             f"{np.mean([x.mean() for x in strata]):.3f}"] for name, strata in everywhere.items()]  # fmt: skip
    text += table(["", "runs", "IQM [95%]", "mean of the tasks' means"], rows) + "\n"
    if missing := [name for name in scaled if name not in everywhere]:
        text += f"Not run on all of these tasks and so left out: {', '.join(missing)}.\n\n"
    return text + (comparison_table(everywhere) + "\n" if len(everywhere) > 1 else "")


def caution(groups):
    """What few runs cannot tell, in plain words."""
    sizes, text = {len(group.runs) for group in groups}, ""
    if 1 in sizes:
        text += "**Rows of one run** have no spread to show: they say what can happen, not how often.\n\n"
    if n := min((size for size in sizes if 1 < size < 10), default=None):
        text += f"**Few seeds.** The intervals of rows of {n} runs are resampled from {n} numbers: they tend to be too "
        text += f"narrow and know nothing of outcomes that none of the {n} had. {n} of {n} solved is still what one "
        text += f"sees one time in twenty if only {0.05 ** (1 / n):.0%} of all runs would. Of two equally good "
        text += f"algorithms with {n} runs each, all runs of one end above all of the other in "
        text += f"{200 / math.comb(2 * n, n):.2g}% of cases.\n\n"
    return text


def commands(sections):
    """A table of the command lines behind the rows, with SEED in place of the seed."""
    seeds = {}
    for section in sections:
        for run in (run for group in section.groups for run in group.runs):
            words = [f"python {run.algorithm}.py --env {run.task} --seed SEED"]
            for name, value in run.flags.items():
                flag = name.replace("_", "-")
                words.append({"True": f"--{flag}", "False": f"--no-{flag}"}.get(value, f"--{flag} {value}"))
            seeds.setdefault((" ".join(words), run.commit), {})[str(run.seed)] = True
    rows = [[f"`{line}`", " ".join(of), commit] for (line, commit), of in seeds.items()]
    return table(["command", "seeds", "commit"], rows)


def markdown(sections, notes, last, figures):
    """The report's text."""
    text = f"""# Results

Returns of greedy policies. A run's final performance is the mean of its last {last} evaluations; a row is over its
runs, one for each seed. SE: standard error. IQM: interquartile mean, with the 95% interval of {RESAMPLES:,} stratified
bootstrap resamples. Discounted returns use the run's gamma. The paper says neither whether its returns are discounted
nor what its ± is. Time per run is wall-clock, beside whatever else the machine did.

"""
    text += caution([group for section in sections for group in section.groups])
    text += "![Learning curves of all tasks](overview.png)\n\n" if figures else ""
    text += "IQM of the final returns [95%], and how many runs solved the task:\n\n"
    text += summary_table(first_sections(sections)) + "\n"
    for section in sections:
        text += f"## {section.title}\n\n" + (f"![{section.title}]({section.file})\n\n" if figures else "")
        if section.cut is not None and figures:
            text += f"The figure is cut off at {section.cut:.0f}; some evaluations lie below.\n\n"
        text += performance_table(section) + "\n"
        if section.bar is not None:
            text += f"Solved: a final return of at least {section.bar:.4g}, {section.bar_text}.\n"
        text += f"References: {section.note}\n" if section.note else ""
        ends = [group.steps[-1] for group in section.groups]  # a run may go on to a whole step of its environments
        if max(ends) > 1.01 * min(ends):
            text += "**The rows differ in their environment steps**: this is not a comparison at equal budgets.\n"
        seeds = {group.label: {run.seed for run in group.runs} for group in section.groups}
        lacking = {name: sorted(set.union(*seeds.values()) - of) for name, of in seeds.items()}
        lacking = [f"{name} {' '.join(map(str, of))}" for name, of in lacking.items() if of]
        text += f"Missing seeds: {', '.join(lacking)}.\n" if lacking else ""
        if len(section.groups) > 1:
            text += "\nProbability that a run of the row ends above one of the column; ties count half:\n\n"
            text += comparison_table({group.label: [group.final["return"]] for group in section.groups})
        text += "\n"
    text += over_tasks(first_sections(sections)) + f"## Commands\n\n{commands(sections)}\n"
    option = "" if last == 5 else f" --last {last}"
    text += f"This report again from its own data: `python benchmark/report.py evaluations.csv -o FOLDER{option}`\n"
    return text + ("\n## Notes on the data\n\n" + "".join(f"- {note}\n" for note in notes) if notes else "")


def write_csv(runs, output):
    """evaluations.csv and runs.csv."""
    with open(output / "evaluations.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["algorithm", "task", "seed", *VALUES, "variant"])
        for run in runs:
            for values in run.values:
                values = ["" if math.isnan(x) else f"{x:.10g}" for x in values]
                writer.writerow([run.algorithm, run.task, run.seed, *values, run.variant])
    with open(output / "runs.csv", "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(RUNS)
        for run in runs:
            writer.writerow([*(getattr(run, name) for name in RUNS[:-1]), json.dumps(run.flags)])


def checked_out():
    """The commit that is checked out, in words."""

    def git(*words):
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()

    try:
        commit, changes = git("rev-parse", "--short", "HEAD"), git("status", "--porcelain", "--untracked-files=no")
    except (OSError, subprocess.CalledProcessError):
        return "not known"
    return f"{commit}{' and changes' if changes else ''} (when the report was made)"


def main(argv=None):
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUNS", help="run folders, folders of them, or an evaluations.csv")
    parser.add_argument("-o", "--output", required=True, type=Path, help="folder for the report")
    parser.add_argument("--last", type=int, default=5, help="evaluations at the end of a run that count (default 5)")
    parser.add_argument("--unfinished", action="store_true", help="count unfinished runs too, rows cut to the shortest")
    parser.add_argument("--commit", help="commit the run folders were made with (default: the one checked out)")
    parser.add_argument("--references", type=Path, default=Path(__file__).with_name("references.json"),
                        help="returns of the random and the scripted policies, as JSON")  # fmt: skip
    args = parser.parse_args(argv)
    if args.last < 1:
        fail(f"--last must be at least 1, got {args.last}")
    notes = []

    def warn(note, path=None):
        print(f"report: {note}" + (f" ({path})" if path else ""), file=sys.stderr)
        notes.append(note)

    try:
        references = json.loads(args.references.read_text()) if args.references.exists() else {}
    except (OSError, ValueError) as error:
        fail(f"{args.references} is damaged: {error}")
    runs = read_runs(args.runs, args.commit or checked_out(), args.unfinished, warn)
    sections, figures = list(make_sections(runs, args.last, references)), importlib.util.find_spec("matplotlib")
    try:
        args.output.mkdir(parents=True, exist_ok=True)
        write_csv(runs, args.output)
        if figures:
            write_figures(sections, args.output)
        else:
            print("report: no figures; they need: pip install -e '.[report]'", file=sys.stderr)
        (args.output / "README.md").write_text(markdown(sections, notes, args.last, figures))
    except OSError as error:
        fail(f"cannot write to {args.output}: {error.strerror}")
    print(args.output / "README.md")


if __name__ == "__main__":
    main()
