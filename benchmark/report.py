"""A report of runs in Markdown and PNG: learning curves, final performance, comparisons.

    python benchmark/report.py                    of benchmark/results, into it
    python benchmark/report.py runs -o report     of run folders

RUNS are folders with a runs.csv (see record.py), run folders, or folders of them. Only finished runs count; a report of
half a grid is a report of that half. Algorithms with the same variant are compared, and the variants of an algorithm.
"""

import argparse
import json
import re
import sys
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import pandas as pd
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, Python looks in this folder only

import envs
from benchmark import record

matplotlib.use("Agg")
from matplotlib import pyplot as plt

REFERENCES = json.loads(Path(__file__).with_name("references.json").read_text())  # made by scripted.py
RESAMPLES = 5_000
LAST = 5  # evaluations at the end of a run whose mean is its final performance, so that no lucky point decides
SOLVED = 0.98  # of the optimum, in each of these evaluations

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
GREY = "#444444"

# The figures of the paper, as rows of tasks: each is made when there are runs of every row
FIGURES = {"figure-4": [["bp-10", "bp-20", "bp-30"], ["wtd-s", "wtd-d", "wtd-t", "wtd-t1"]]}

# The paper's numbers and what stands behind their +- (Tables 1 and 3); its figures give none. On primitive tasks, where
# every macro-action lasts a step, avf_*.py is the primitive algorithm.
PAPER = {
    "ct-10": dict(dec_maddrqn=(0.05, 0.02), cen_maddrqn=(0.35, 0.09), avf_vdn=(0.13, 0.05), avf_qmix=(0.26, 0.08),
                  avf_qplex=(0.61, 0.09), mac_iaicc=(0.29, 0.06)),
    "bp-10-primitive": dict(avf_vdn=(-4.1, 10.5), avf_qmix=(-2.0, 9.3), avf_qplex=(13.4, 2.6)),
    "wtd-s-primitive": dict(avf_vdn=(32, 4.5), avf_qmix=(44, 6.2), avf_qplex=(61, 5.3)),
    "ct-10-primitive": dict(avf_vdn=(0.04, 0.01), avf_qmix=(0.09, 0.03), avf_qplex=(0.20, 0.04)),
}  # fmt: skip


class Section(NamedTuple):
    """What a figure and its tables compare: runs on a task, as from `read_runs`, by their column `label`."""

    title: str
    env: str
    runs: pd.DataFrame

    @property
    def groups(self):
        return self.runs.groupby("label", sort=False)

    @property
    def digits(self):
        return 3 if self.runs["return"].abs().max() < 2 else 1


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"report: {message}")


def iqm(*samples, axis=-1):
    """Interquartile mean of the runs of all samples: a quarter of them, rounded down, is left out at either end."""
    return stats.trim_mean(np.concatenate(samples, axis), 0.25, axis=axis)


def improvement(*samples, axis=-1):
    """P(X > Y) of Agarwal et al. 2021: the mean over tasks of the share of pairs of runs with x > y, ties count half.

    samples: x and y of the first task, of the second and so on, float [..., runs].
    """
    pairs = zip(samples[::2], samples[1::2], strict=True)
    return np.mean([(np.sign(x[..., :, None] - y[..., None, :]) / 2 + 0.5).mean((-2, -1)) for x, y in pairs], axis=0)


def interval(samples, statistic):
    """The ends of a statistic's 95% percentile interval, runs being redrawn within each sample; nan for single runs.

    samples: float arrays [..., runs]. The same samples give the same interval.
    """
    if min(x.shape[-1] for x in samples) < 2:
        return np.full((2, *samples[0].shape[:-1]), np.nan)
    options = dict(n_resamples=RESAMPLES, vectorized=True, axis=-1, method="percentile", rng=0)
    return np.stack(stats.bootstrap(samples, statistic, **options).confidence_interval)


def read_runs(paths, warn):
    """Runs and evaluations of the paths: two DataFrames; the column `run` of the second is the index of the first.

    To the columns of runs.csv come the final performance, under the names of VALUES, and whether the run is `solved`.
    """
    found = []
    for path in map(Path, paths):
        try:
            recorded = list(record.load_runs(path))
        except (OSError, ValueError) as error:
            fail(f"cannot read {path}: {error}")
        folders = sorted(file.parent for file in path.rglob("args.json"))
        if not recorded and not folders:
            fail(f"no runs found in {path}")
        found += recorded
        for folder in folders:
            try:
                if not record.is_finished(folder):
                    raise ValueError("not finished")
                found.append(record.read_folder(folder))
            except (OSError, ValueError, KeyError, TypeError, ImportError, SystemExit) as error:
                warn(f"{folder.name}: left out, {error}")
    if not found:
        fail("no finished run found")
    runs = pd.DataFrame([run for run, _ in found])
    evaluations = pd.concat([values.assign(run=i) for i, (_, values) in enumerate(found)])
    evaluations = evaluations[["run", "step", *record.VALUES]].apply(pd.to_numeric)
    runs[["seed", "seconds"]] = runs[["seed", "seconds"]].apply(pd.to_numeric)
    last = evaluations.sort_values("step").groupby("run").tail(LAST).groupby("run")
    runs = runs.join(last[record.VALUES].mean().round(6)).join(last["step"].max())  # rounded: ties stay ties
    scripted = [REFERENCES.get(env, {}).get("scripted", {}) for env in runs["env"]]
    runs["optimum"] = [x["return"] if x.get("optimal") else np.nan for x in scripted]
    runs["solved"] = last["return"].min() >= SOLVED * runs["optimum"]
    same, order = ["env", "algorithm", "variant", "seed"], [*envs.IDS, *ALGORITHMS]
    newest = runs.sort_values("date", kind="stable").drop_duplicates(same, keep="last")
    for _, run in runs.drop(newest.index).iterrows():
        warn(f"{run['algorithm']} on {run['env']}, seed {run['seed']} of {run['date']}: left out, there is a newer one")
    return newest.sort_values(
        same, key=lambda x: x.map(lambda y: (order.index(y), "") if y in order else (99, y))
    ), evaluations


def make_sections(runs):
    """The sections of a report: on each task the algorithms by variant, then the variants of those that have some."""
    names = runs["algorithm"].map(lambda name: ALGORITHMS.get(name, (name,))[0])
    for env, on_task in runs.groupby("env", sort=False):
        variants = on_task.groupby("algorithm")["variant"].transform("nunique")
        for variant, alike in on_task.groupby("variant"):
            if alike["algorithm"].nunique() > 1 or variants[alike.index].min() == 1:
                yield Section(f"{env}: {variant}" if variant else env, env, alike.assign(label=names))
        for name, of in on_task[variants > 1].groupby(names, sort=False):
            labels = of["variant"].where(of["variant"] != "", name)
            yield Section(f"{env}: variants of {name}", env, of.assign(label=labels))


def draw(ax, section, evaluations, kind):
    """A panel of learning curves: the "mean" with standard errors, or the "IQM" with 95% bootstrap intervals."""
    levels = {name: x["return"] for name, x in REFERENCES.get(section.env, {}).items()}
    for name, level in levels.items():
        style = "--" if name == "scripted" else ":"
        ax.axhline(level, color=GREY, lw=1.2, ls=style, label=f"{name} policy", zorder=1)
    others, n = iter(OTHERS * 9), section.runs["label"].nunique()
    for i, (label, of) in enumerate(section.groups):
        colour, marker = next((style for name, *style in ALGORITHMS.values() if name == label), None) or next(others)
        curves = evaluations[evaluations["run"].isin(of.index)].pivot(index="run", columns="step", values="return")
        curves = curves.dropna(axis=1)  # at the steps that all runs have
        if kind == "mean":
            middle, error = curves.mean(), curves.sem()
            low, high = middle - error, middle + error
        else:
            middle, (low, high) = iqm(curves, axis=0), interval([curves.to_numpy().T], iqm)
        x, every = curves.columns / 1000, max(1, curves.shape[1] // 8)
        ax.fill_between(x, low, high, color=colour, alpha=0.15, lw=0, zorder=2)
        ax.plot(x, middle, color=colour, lw=1.7, marker=marker, ms=4.5, markevery=(i * every // n, every), label=label,
                zorder=3 + n - i)  # fmt: skip
    if len(levels) == 2:  # early curves may go far down: half of the way from random to scripted below random will do
        bottom = max(ax.get_ylim()[0], levels["random"] - (levels["scripted"] - levels["random"]) / 2)
        top = max(np.max(line.get_ydata()) for line in ax.lines)
        ax.set_ylim(bottom, top + 0.05 * (top - bottom))
    ax.set(xlim=0, xlabel="environment steps (thousands)")
    ax.grid(alpha=0.25, lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def write_figure(path, rows, evaluations):
    """A PNG of rows of panels, (section or None, kind, title) each, with one legend."""
    figure = plt.figure(figsize=(max(10, 3.5 * max(map(len, rows))), 1 + 3.4 * len(rows)), layout="constrained")
    legend = {}
    for row, part in zip(rows, np.atleast_1d(figure.subfigures(len(rows))), strict=True):
        for (section, kind, title), ax in zip(row, np.atleast_1d(part.subplots(1, len(row))), strict=True):
            ax.set_title(title, fontsize=10)
            if section:
                draw(ax, section, evaluations, kind)
                legend |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
            else:
                ax.set(xticks=[], yticks=[], xlabel="no runs")
        part.axes[0].set_ylabel("return of greedy episodes")
    names = sorted(legend, key=lambda name: legend[name].get_color() == GREY)  # the algorithms first
    columns = max(1, int(11 * figure.get_figwidth()) // (max(map(len, names)) + 9))  # as many as fit side by side
    figure.legend([legend[name] for name in names], names, loc="outside lower center", ncols=columns, frameon=False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def write_figures(sections, evaluations, output):
    """A figure of each section, one of all tasks, and those of the paper; returns the names of the last two kinds."""
    for section in sections:
        row = [(section, "mean", f"{section.title}: mean ± standard error"), (section, "IQM", "IQM, 95% interval")]
        write_figure(output / file_of(section), [row], evaluations)
    first = first_sections(sections)
    tasks = list(first)
    figures = {"overview": [tasks[i : i + 4] for i in range(0, len(tasks), 4)]}
    figures |= {name: rows for name, rows in FIGURES.items() if all(set(row) & set(tasks) for row in rows)}
    for name, rows in figures.items():
        panels = [[(first.get(env), "mean", env) for env in row] for row in rows]
        write_figure(output / f"{name}.png", panels, evaluations)
    return list(figures)


def first_sections(sections):
    """The first section of each task, by task."""
    last_first = {section.env: section for section in reversed(sections)}
    return dict(reversed(last_first.items()))


def file_of(section):
    """The name of a section's figure."""
    return re.sub(r"[^\w=.-]+", "_", section.title) + ".png"


def table(head, rows):
    """A Markdown table."""
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in (head, ["---"] * len(head), *rows)) + "\n"


def plus_minus(x, digits):
    """The mean of runs with its standard error, which one run does not have."""
    return f"{x.mean():.{digits}f}" + (f" ± {x.sem():.{digits}f}" if len(x) > 1 else "")


def with_interval(samples, statistic, digits):
    """A statistic with its interval, which single runs do not have."""
    samples = [np.asarray(x) for x in samples]
    low, high = interval(samples, statistic)
    return f"{statistic(*samples):.{digits}f}" + ("" if np.isnan(low) else f" [{low:.{digits}f}, {high:.{digits}f}]")


def performance_table(section):
    """The final performance of a section's groups, and below them what it can be compared with."""
    rows, digits = [], section.digits
    for label, of in section.groups:
        paper = PAPER.get(section.env, {}).get(of["algorithm"].iloc[0]) if (of["variant"] == "").all() else None
        k, n, solved = of["solved"].sum(), len(of), ""
        if of["optimum"].notna().all():
            low, high = stats.binomtest(k, n).proportion_ci(method="exact")
            solved = f"{k} of {n} [{low:.2f}, {high:.2f}]"
        rows.append([label, n, f"{of['step'].max():,}", plus_minus(of["return"], digits),
                     with_interval([of["return"]], iqm, digits), solved, plus_minus(of["discounted_return"], digits),
                     f"{of['success'].mean():.2f}", f"{paper[0]:g} ± {paper[1]:g}" if paper else "",
                     f"{of['seconds'].mean() / 60:.1f} min"])  # fmt: skip
    for kind, x in REFERENCES.get(section.env, {}).items():
        value = f"{x['return']:.{digits}f} ± {x['se']:.{digits}f}"
        discounted = f"{x['discounted_return']:.{digits}f}"
        rows.append([f"*{x.get('name', kind)}*", "", "", value, "", "", discounted, f"{x['success']:.2f}", "", ""])
    return table(["", "runs", "steps", "return: mean ± SE", "IQM [95%]", "solved [95%]", "discounted: mean ± SE",
                  "success", "paper", "time per run"], rows)  # fmt: skip


def comparison_table(samples):
    """P(X > Y) for all pairs. samples: by label a list with the final returns on each task."""
    rows = []
    for x, of_x in samples.items():
        pairs = {y: [a for pair in zip(of_x, of_y, strict=True) for a in pair] for y, of_y in samples.items()}
        rows.append([x, *("" if x == y else with_interval(both, improvement, 2) for y, both in pairs.items())])
    return table(["P(row > column)", *samples], rows) if len(samples) > 1 else ""


def over_tasks(sections):
    """IQM on each task and over all of them, for the algorithms that were run on all; and their comparison."""
    cells, scaled = {}, {}
    for env, section in sections.items():
        known = REFERENCES.get(env, {})
        low, high = (known.get(kind, {}).get("return", np.nan) for kind in ("random", "scripted"))
        for label, of in section.groups:
            cells.setdefault(label, {})[env] = with_interval([of["return"]], iqm, section.digits)
            scaled.setdefault(label, []).append(((of["return"] - low) / (high - low)).to_numpy())
        for kind, x in known.items():
            cells.setdefault(f"*{kind} policy*", {})[env] = f"{x['return']:.{section.digits}f}"
    everywhere = {name: samples for name, samples in scaled.items() if len(samples) == len(sections) > 1}
    for name, samples in everywhere.items():
        cells[name]["all, scaled"] = with_interval(samples, iqm, 3)
    columns = [*sections, *(["all, scaled"] if everywhere else [])]
    cells = {name: cells[name] for name in sorted(cells, key=lambda name: name[0] == "*")}  # the references last
    text = table(["", *columns], [[name, *(of.get(column, "") for column in columns)] for name, of in cells.items()])
    return text + (f"Over all tasks:\n\n{comparison_table(everywhere)}" if everywhere else "")


def sources(runs):
    """A table of what was run, by which code."""
    same = ["algorithm", "env", "flags", "commit", "checksum", "processor"]
    seeds = runs.groupby(same, sort=False)["seed"].agg(lambda of: " ".join(map(str, of))).reset_index()
    return table(list(seeds), seeds.to_numpy())


def markdown(sections, runs, notes, figures):
    """The report's text."""
    text = f"""# Results

Returns of greedy policies. A run's final performance is the mean of its last {LAST} evaluations; a row is over its
runs, one for each seed. SE: standard error. IQM: interquartile mean, a quarter of the runs, rounded down, left out at
either end, with the 95% interval of {RESAMPLES:,} bootstrap resamples, stratified by task. Solved: runs with
{SOLVED:.0%} of the optimal return or more in each of these {LAST} evaluations, with the exact 95% interval of Clopper
and Pearson. P(row > column): the probability that a run of the row ends above one of the column; ties count half.
Scaled: the random policy has 0 and the scripted policy 1. The paper says neither whether its returns are discounted
nor what its ± is. Time per run is wall-clock, beside whatever else the machine did.

"""
    if runs.groupby(["env", "algorithm", "variant"]).size().min() < 10:
        text += "**Few seeds.** Bootstrap intervals of less than ten runs know nothing of outcomes that none of the\n"
        text += "runs had, and tend to be too narrow.\n\n"
    text += "".join(f"![{name}]({name}.png)\n\n" for name in figures)
    text += f"IQM of the final returns [95%]:\n\n{over_tasks(first_sections(sections))}"
    for section in sections:
        text += f"## {section.title}\n\n![{section.title}]({file_of(section)})\n\n{performance_table(section)}"
        steps = section.groups["step"].max()
        if steps.max() > 1.01 * steps.min():  # a run may go on to a whole step of its environments
            text += "**The rows differ in their environment steps**: this is not a comparison at equal budgets.\n\n"
        if section.groups["checksum"].nunique().max() > 1:
            text += "**Some rows have runs of several versions of the code.**\n\n"
        text += comparison_table({label: [of["return"]] for label, of in section.groups})
    text += "## Sources\n\nA flag name=value is --name value on the command line of python ALGORITHM.py --env ENV "
    text += f"--seed SEED. The checksum is of the script and envs/*.py.\n\n{sources(runs)}"
    return text + "".join(f"- {note}\n" for note in notes)


def main(argv=None):
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", default=[record.RESULTS], metavar="RUNS", help="default: benchmark/results")
    parser.add_argument("-o", "--output", type=Path, default=record.RESULTS, help="folder (default: benchmark/results)")
    args = parser.parse_args(argv)
    notes = []

    def warn(note):
        print(f"report: {note}", file=sys.stderr)
        notes.append(note)

    runs, evaluations = read_runs(args.runs, warn)
    sections = list(make_sections(runs))
    try:
        args.output.mkdir(parents=True, exist_ok=True)
        figures = write_figures(sections, evaluations, args.output)
        (args.output / "README.md").write_text(markdown(sections, runs, notes, figures))
    except OSError as error:
        fail(f"cannot write to {args.output}: {error.strerror}")
    print(args.output / "README.md")


if __name__ == "__main__":
    main()
