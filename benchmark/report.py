"""A report of runs in Markdown and PNG: learning curves, final performance, comparisons.

    python benchmark/report.py                    of benchmark/results, into it
    python benchmark/report.py runs -o report     of run folders

RUNS are folders with a runs.csv (see record.py), run folders, or folders of them. Only finished runs count. Algorithms
with the same variant are compared, and the variants of an algorithm.
"""

import argparse
import itertools
import json
import re
import sys
from pathlib import Path

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

# As rows of tasks; made when there are runs of every row
FIGURE_4 = [["bp-10", "bp-20", "bp-30"], ["wtd-s", "wtd-d", "wtd-t", "wtd-t1"]]


def fail(message):
    """Ends the program with one line."""
    raise SystemExit(f"report: {message}")


def iqm(*samples, axis=-1):
    """Interquartile mean of the runs of all samples: a quarter of them, rounded down, is left out at either end."""
    return stats.trim_mean(np.concatenate(samples, axis), 0.25, axis=axis)


def improvement(*samples, axis=-1):
    """P(X > Y) of Agarwal et al. 2021: the mean over tasks of the share of pairs of runs with x > y, ties count half.

    samples: x of each task, then y of each task, float [..., runs].
    """
    pairs = zip(samples[: len(samples) // 2], samples[len(samples) // 2 :], strict=True)
    return np.mean([(np.sign(x[..., :, None] - y[..., None, :]) / 2 + 0.5).mean((-2, -1)) for x, y in pairs], axis=0)


def interval(samples, statistic):
    """The ends of a statistic's 95% percentile interval, runs being redrawn within each sample, float [..., runs]."""
    if min(x.shape[-1] for x in samples) < 2:
        return np.full((2, *samples[0].shape[:-1]), np.nan)
    options = dict(n_resamples=RESAMPLES, vectorized=True, axis=-1, method="percentile", rng=0)
    return np.stack(stats.bootstrap(samples, statistic, **options).confidence_interval)


def read_runs(paths):
    """Two DataFrames, runs and evaluations (`run` is the index of the first), and notes on runs that are left out.

    The columns of VALUES are a run's final performance; `scaled` is 0 for the random policy and 1 for the scripted.
    """
    found, notes = [], []
    for path in map(Path, paths):
        try:
            recorded = record.load_runs(path)
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
                notes.append(f"{folder.name}: left out, {error}")
    if not found:
        fail("no finished run found")
    runs = pd.DataFrame([run for run, _ in found]).astype({"seed": int, "seconds": float})
    evaluations = pd.concat([values.assign(run=i) for i, (_, values) in enumerate(found)])
    evaluations = evaluations[["run", "step", *record.VALUES]].apply(pd.to_numeric)
    last = evaluations.sort_values("step").groupby("run").tail(LAST).groupby("run")
    runs = runs.join(last[record.VALUES].mean().round(6)).join(last["step"].max())  # rounded: ties stay ties
    levels = pd.DataFrame([{kind: x["return"] for kind, x in REFERENCES[env].items()} for env in runs["env"]])
    runs["scaled"] = (runs["return"] - levels["random"]) / (levels["scripted"] - levels["random"])
    runs["solved"] = last["return"].min() >= SOLVED * levels["scripted"]
    same = ["env", "algorithm", "variant", "seed"]
    newest = runs.sort_values("date", kind="stable").drop_duplicates(same, keep="last")
    for run in runs.drop(newest.index).itertuples():
        notes.append(f"{run.algorithm} on {run.env}, seed {run.seed} of {run.date}: left out, there is a newer one")
    rank = {name: (i, "") for i, name in enumerate([*envs.IDS, *ALGORITHMS])}
    return newest.sort_values(same, key=lambda x: x.map(lambda name: rank.get(name, (99, name)))), evaluations, notes


def make_sections(runs):
    """The runs that a figure and its tables compare, by the columns `section`, its title, and `label`.

    On each task first the algorithms by variant, then the variants of those that have some.
    """
    names = runs["algorithm"].map(lambda name: ALGORITHMS.get(name, (name,))[0])
    variants = runs.groupby(["env", "algorithm"])["variant"].transform("nunique")
    alike = runs.assign(section=(runs["env"] + ": " + runs["variant"]).str.removesuffix(": "), label=names)
    alike = alike[(alike.groupby("section")["algorithm"].transform("nunique") > 1) | (variants == 1)]
    others = runs.assign(section=runs["env"] + ": variants of " + names, label=runs["variant"].replace("", None))
    others = others[variants > 1].fillna({"label": names})
    return pd.concat([alike, others]).sort_values("env", key=lambda env: env.map(envs.IDS.index), kind="stable")


def draw(ax, runs, evaluations, kind):
    """A panel of learning curves: the "mean" with standard errors, or the "IQM" with 95% bootstrap intervals."""
    styles, others = {name: style for name, *style in ALGORITHMS.values()}, iter(OTHERS * 9)
    groups = runs.groupby("label", sort=False)
    for i, (label, of) in enumerate(groups):
        colour, marker = styles.get(label) or next(others)
        curves = evaluations[evaluations["run"].isin(of.index)].pivot(index="run", columns="step", values="return")
        curves = curves.dropna(axis=1)  # at the steps that all runs have
        if kind == "mean":
            middle, low, high = curves.mean(), curves.mean() - curves.sem(), curves.mean() + curves.sem()
        else:
            middle, (low, high) = iqm(curves, axis=0), interval([curves.to_numpy().T], iqm)
        x, every = curves.columns / 1000, max(1, curves.shape[1] // 8)
        marks = dict(marker=marker, ms=4.5, markevery=(i * every // len(groups), every))
        ax.fill_between(x, low, high, color=colour, alpha=0.15, lw=0, zorder=2)
        ax.plot(x, middle, color=colour, lw=1.7, label=label, zorder=3 + len(groups) - i, **marks)
    floor, ceiling = (REFERENCES[runs["env"].iloc[0]][kind]["return"] for kind in ("random", "scripted"))
    ax.axhline(floor, color=GREY, lw=1.2, ls=":", label="random policy", zorder=1)
    ax.axhline(ceiling, color=GREY, lw=1.2, ls="--", label="scripted policy", zorder=1)
    # Early curves may go far down: half of the way from random to scripted below random will do
    bottom = max(ax.get_ylim()[0], floor - (ceiling - floor) / 2)
    top = max(np.max(line.get_ydata()) for line in ax.lines)
    ax.set_ylim(bottom, top + 0.05 * (top - bottom))
    ax.set(xlim=0, xlabel="environment steps (thousands)")
    ax.grid(alpha=0.25, lw=0.6)
    ax.spines[["top", "right"]].set_visible(False)


def plot(path, rows, evaluations):
    """A PNG of rows of panels, (title, runs, kind) each, with one legend; panels without runs stay empty."""
    size = len(rows), max(map(len, rows))
    figure, axes = plt.subplots(*size, figsize=(max(10, 3.5 * size[1]), 1 + 3.4 * size[0]), squeeze=False,
                                layout="constrained")  # fmt: skip
    legend = {}
    for row, panels in zip(axes, rows, strict=True):
        row[0].set_ylabel("return of greedy episodes")
        for ax, (title, runs, kind) in itertools.zip_longest(row, panels, fillvalue=("", [], "")):
            ax.set_title(title, fontsize=10)
            if len(runs):
                draw(ax, runs, evaluations, kind)
                legend |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
            else:
                ax.axis("off")
    columns = max(1, int(11 * figure.get_figwidth()) // (max(map(len, legend)) + 9))  # as many as fit side by side
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=columns, frameon=False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def file_of(title):
    """The name of a section's figure."""
    return re.sub(r"[^\w=.-]+", "_", title)


def make_figures(sections, first):
    """Rows of panels, see `plot`, by the name of the figure: all tasks, the paper's figure, and each section."""
    panels = {env: (f"{env}: no runs", [], "") for row in FIGURE_4 for env in row}
    panels |= {env: (env, runs, "mean") for env, runs in first.groupby("env")}
    tasks = list(first["env"].unique())
    figures = {"overview": [[panels[env] for env in tasks[i : i + 4]] for i in range(0, len(tasks), 4)]}
    if all(set(tasks) & set(row) for row in FIGURE_4):
        figures["figure-4"] = [[panels[env] for env in row] for row in FIGURE_4]
    for title, runs in sections.groupby("section", sort=False):
        row = [(f"{title}: mean ± standard error", runs, "mean"), ("IQM, 95% interval", runs, "IQM")]
        figures[file_of(title)] = [row]
    return figures


def table(rows, columns=None):
    """A Markdown table of rows, {column: cell} each; cells that a row does not have are empty."""
    frame = pd.DataFrame(rows, columns=columns, dtype=object).fillna("")
    lines = [frame.columns, ["---"] * frame.shape[1], *frame.to_numpy()]
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in lines) + "\n"


def digits_of(env):
    return 3 if env.startswith("ct") else 1


def plus_minus(x, digits):
    """The mean of runs with its standard error, which one run does not have."""
    return f"{x.mean():.{digits}f}" + (f" ± {x.sem():.{digits}f}" if len(x) > 1 else "")


def with_interval(samples, statistic, digits):
    """A statistic with its interval, which single runs do not have."""
    samples = [np.asarray(x) for x in samples]
    low, high = interval(samples, statistic)
    return f"{statistic(*samples):.{digits}f}" + ("" if np.isnan(low) else f" [{low:.{digits}f}, {high:.{digits}f}]")


def performance_table(runs):
    """The final performance of each label, and below it the random and the scripted policy's."""
    env, rows = runs["env"].iloc[0], []
    digits = digits_of(env)
    for label, of in runs.groupby("label", sort=False):
        k, n, row = of["solved"].sum(), len(of), {"": label}
        row |= {"runs": n, "steps": f"{of['step'].max():,}", "return: mean ± SE": plus_minus(of["return"], digits)}
        row |= {"IQM [95%]": with_interval([of["return"]], iqm, digits), "solved [95%]": ""}
        if REFERENCES[env]["scripted"]["optimal"]:
            low, high = stats.binomtest(k, n).proportion_ci(method="exact")
            row["solved [95%]"] = f"{k} of {n} [{low:.2f}, {high:.2f}]"
        row |= {"discounted: mean ± SE": plus_minus(of["discounted_return"], digits)}
        row |= {"success": f"{of['success'].mean():.2f}", "time per run": f"{of['seconds'].mean() / 60:.1f} min"}
        rows.append(row)
    for kind, x in REFERENCES[env].items():
        row = {"": f"*{x.get('name', kind)}*", "return: mean ± SE": f"{x['return']:.{digits}f} ± {x['se']:.{digits}f}"}
        row |= {"discounted: mean ± SE": f"{x['discounted_return']:.{digits}f}", "success": f"{x['success']:.2f}"}
        rows.append(row)
    return table(rows)


def samples(runs, column):
    """{label: [the runs' values on each task]} of the labels that have runs on all tasks."""
    found = {}
    for label, of in runs.groupby("label", sort=False):
        if of["env"].nunique() == runs["env"].nunique():
            found[label] = [values.to_numpy() for _, values in of.groupby("env", sort=False)[column]]
    return found


def comparison_table(runs):
    """P(X > Y) over all tasks, for all pairs of labels that have runs on all of them."""
    returns, rows = samples(runs, "return"), []
    for x in returns:
        values = {y: with_interval(returns[x] + returns[y], improvement, 2) for y in returns if y != x}
        rows.append({"P(row > column)": x} | values)
    return table(rows, ["P(row > column)", *returns]) if len(rows) > 1 else ""


def overview_table(runs):
    """The IQM on each task and, of labels that have runs on all of several, over all tasks."""
    tasks, rows = list(runs["env"].unique()), []
    scaled = samples(runs, "scaled") if len(tasks) > 1 else {}
    for label, of in runs.groupby("label", sort=False):
        row = {env: with_interval([returns], iqm, digits_of(env)) for env, returns in of.groupby("env")["return"]}
        if label in scaled:
            row["all, scaled"] = with_interval(scaled[label], iqm, 3)
        rows.append({"": label, **row})
    for kind in ("random", "scripted"):
        row = {env: f"{REFERENCES[env][kind]['return']:.{digits_of(env)}f}" for env in tasks}
        rows.append({"": f"*{kind} policy*", **row})
    return table(rows, ["", *tasks, *(["all, scaled"] if scaled else [])])


def markdown(sections, first, figures, runs, notes):
    """The report's text."""
    text = f"""# Results

Returns of greedy policies. A run's final performance is the mean of its last {LAST} evaluations; a row is over its
runs, one for each seed. SE: standard error. IQM: interquartile mean, a quarter of the runs, rounded down, left out at
either end, with the 95% interval of {RESAMPLES:,} bootstrap resamples, stratified by task; of less than ten runs it
tends to be too narrow. Solved: runs with {SOLVED:.0%} of the optimal return or more in each of these {LAST}
evaluations, with the exact 95% interval of Clopper and Pearson. P(row > column): the probability that a run of the row
ends above one of the column; ties count half. Scaled: the random policy has 0 and the scripted policy 1. Time per run
is wall-clock, beside whatever else the machine did.

"""
    text += "".join(f"![{name}]({name}.png)\n\n" for name in ("overview", "figure-4") if name in figures)
    text += f"IQM of the final returns [95%]:\n\n{overview_table(first)}"
    if first["env"].nunique() > 1 and (comparison := comparison_table(first)):
        text += f"Over all tasks:\n\n{comparison}"
    for title, of in sections.groupby("section", sort=False):
        text += f"## {title}\n\n![{title}]({file_of(title)}.png)\n\n{performance_table(of)}"
        labels = of.groupby("label")
        steps = labels["step"].max()
        if steps.max() > 1.01 * steps.min():  # a run may go on to a whole step of its environments
            text += "**The rows differ in their environment steps**: this is not a comparison at equal budgets.\n\n"
        if labels["checksum"].nunique().max() > 1:
            text += "**Some rows have runs of several versions of the code.**\n\n"
        text += comparison_table(of)
    text += "## Sources\n\nA flag name=value is --name value on the command line of python ALGORITHM.py --env ENV "
    text += "--seed SEED. The checksum is of the script and envs/*.py.\n\n"
    sources = runs.groupby(["algorithm", "env", "flags", "commit", "checksum"], sort=False)["seed"]
    text += table(sources.agg(lambda seeds: " ".join(map(str, seeds))).reset_index())
    return text + "".join(f"- {note}\n" for note in notes)


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", default=[record.RESULTS], metavar="RUNS", help="default: benchmark/results")
    parser.add_argument("-o", "--output", type=Path, default=record.RESULTS, help="folder (default: benchmark/results)")
    args = parser.parse_args(argv)
    runs, evaluations, notes = read_runs(args.runs)
    for note in notes:
        print(f"report: {note}", file=sys.stderr)
    sections = make_sections(runs)
    first = sections[sections["section"] == sections.groupby("env")["section"].transform("first")]
    figures = make_figures(sections, first)
    try:
        args.output.mkdir(parents=True, exist_ok=True)
        for name, rows in figures.items():
            plot(args.output / f"{name}.png", rows, evaluations)
        (args.output / "README.md").write_text(markdown(sections, first, figures, runs, notes))
    except OSError as error:
        fail(f"cannot write to {args.output}: {error.strerror}")
    print(args.output / "README.md")


if __name__ == "__main__":
    main()
