"""A report of runs in Markdown and PNG: the figures and tables of the paper, with its numbers beside ours.

    python benchmark/report.py                    of benchmark/results, into it
    python benchmark/report.py runs -o report     of run folders

RUNS are folders with a runs.csv (see record.py), run folders, or folders of them. Only finished runs count. A section
of paper.json says which algorithms and variants it compares on which tasks; what is in none of them comes last.
"""

import argparse
import itertools
import json
import sys
from functools import partial
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

HERE = Path(__file__).parent
PAPER = json.loads((HERE / "paper.json").read_text())  # what it compares, its numbers, and our styles
REFERENCES = json.loads((HERE / "references.json").read_text())  # made by scripted.py
RESAMPLES = 5_000
LAST = 5  # evaluations at the end of a run whose mean is its final performance, so that no lucky point decides
KEPT = 3  # a run solves a task when so many evaluations in a row have at least the share NEAR of the optimum
NEAR = 0.95
EQUAL = 0.02  # of the range from random to optimum: returns that differ by less are equal


def iqm(*samples, axis=-1):
    """Interquartile mean of the runs of all samples: a quarter of them, rounded down, is left out at either end."""
    return stats.trim_mean(np.concatenate(samples, axis), 0.25, axis=axis)


def gap(*samples, axis=-1):
    """Optimality gap of Agarwal et al. 2021: how far scaled returns are below 1 on average; those above count as 1."""
    return np.mean(np.maximum(0, 1 - np.concatenate(samples, axis)), axis)


def difference(x, y, axis=-1):
    """Of the means of two samples."""
    return np.mean(x, axis) - np.mean(y, axis)


def interval(statistic, samples):
    """The 95% percentile interval of a statistic, runs being redrawn within each sample; nan for single runs."""
    if min(map(len, samples)) < 2:
        return np.nan, np.nan
    options = dict(n_resamples=RESAMPLES, vectorized=True, axis=-1, method="percentile", rng=0)
    return stats.bootstrap(samples, statistic, **options).confidence_interval


def with_interval(statistic, samples, digits):
    """A statistic with its interval, as text; of single runs without."""
    low, high = interval(statistic, samples)
    text = f"{statistic(*samples):z,.{digits}f}"
    return text if np.isnan(low) else f"{text} [{low:z,.{digits}f}, {high:z,.{digits}f}]"


def holm(p):
    """p-values of several tests, float64 [tests], corrected: the chance that any is below 0.05 by accident is 5%."""
    order = np.argsort(p)
    corrected = np.empty(len(p))
    corrected[order] = np.maximum.accumulate(np.arange(len(p), 0, -1) * np.sort(p))
    return np.minimum(corrected, 1.0)


def check(run, evaluations):
    """The numbers of a run that can be shown, a DataFrame; raises ValueError for any other, with the reason."""
    if not all(isinstance(run[name], str) for name in (*record.KEY, "variant", "commit", "date")):
        raise ValueError("its description is not of text")
    numbers = evaluations[["step", *record.VALUES]].apply(pd.to_numeric, errors="coerce").astype(float)
    if not np.isfinite(numbers).all(axis=None):
        raise ValueError("an evaluation has a number missing, or something that is no finite number")
    if f"{numbers['step'].max():.0f}" != run["steps"]:
        raise ValueError(f"its evaluations do not go up to step {run['steps']}: cut short")
    return numbers


def read_runs(paths):
    """Two DataFrames, runs and evaluations (`run` is the index of the first), and notes on runs that are left out.

    The columns of VALUES are a run's final performance; `scaled` is 0 for the random policy and 1 for the scripted.
    `solved_at` is the step of the last of KEPT evaluations, nan for never; `needed` is the budget then.
    """
    found = []
    kept = []
    notes = []
    for path in map(Path, paths):
        try:
            kept += record.load_runs(path.resolve(strict=True))
        except (OSError, ValueError) as error:
            sys.exit(f"report: cannot read {path}: {error}")
        for folder in sorted(file.parent for file in path.rglob("args.json")):
            try:
                if not record.is_finished(folder):
                    raise ValueError("not finished")
                run, evaluations = record.read_folder(folder)
                found.append((run, check(run, evaluations)))
            except (OSError, ValueError, KeyError, TypeError, SystemExit) as error:
                notes.append(f"{folder.name}: left out, {error}")
    for run, evaluations in kept:
        try:
            found.append((run, check(run, evaluations)))
        except ValueError as error:
            notes.append(f"{run['algorithm']} on {run['env']}, seed {run['seed']}: left out, {error}")
    if not found:
        sys.exit("report: no finished run found")
    runs = pd.DataFrame([run for run, _ in found])
    evaluations = pd.concat([values.assign(run=i) for i, (_, values) in enumerate(found)])
    evaluations = evaluations.sort_values(["run", "step"])
    last = evaluations.groupby("run").tail(LAST).groupby("run")
    runs = runs.join(last[record.VALUES].mean().round(6)).join(last["step"].max())  # rounded: ties stay ties
    for column, kind in (("floor", "random"), ("ceiling", "scripted")):
        returns = {env: reference[kind]["return"] for env, reference in REFERENCES.items()}
        runs[column] = runs["env"].map(returns)  # nan for a task of one's own
    runs["scaled"] = (runs["return"] - runs["floor"]) / (runs["ceiling"] - runs["floor"])
    runs["optimal"] = [REFERENCES.get(env, {"scripted": {}})["scripted"].get("optimal", False) for env in runs["env"]]
    optimum = evaluations["run"].map(runs["ceiling"].where(runs["optimal"]))  # nan where none is known
    near = (evaluations["return"] >= NEAR * optimum).groupby(evaluations["run"])
    kept = evaluations[near.transform(lambda of: of.rolling(KEPT).sum()) == KEPT]
    runs["solved_at"] = kept.groupby("run")["step"].min()
    runs["needed"] = runs["solved_at"].fillna(runs["step"])
    same = ["env", "algorithm", "variant", "seed"]
    newest = runs.sort_values("date", kind="stable").drop_duplicates(same, keep="last")
    for run in runs.drop(newest.index).itertuples():
        notes.append(f"{run.algorithm} on {run.env}, seed {run.seed} of {run.date}: left out, there is a newer one")
    rank = {name: f"{i:02}" for i, name in enumerate([*envs.IDS, *PAPER["names"]])}
    return newest.sort_values(same, key=lambda column: column.replace(rank)), evaluations, notes


def panels_of(section, runs):
    """{title: runs, with a column `label`} of the panels of a section of paper.json.

    A panel is a task, where algorithms are compared, or a task and an algorithm, of which variants are compared.
    """
    names = PAPER["names"]
    panels = {}
    variants = section.get("variants") or {variant: f" {variant}".rstrip() for variant in runs["variant"]}
    for panel in itertools.chain.from_iterable(section["panels"]):
        env, _, kind = panel.partition(" ")
        on = runs[runs["env"] == env]
        algorithms = [kind] if kind else section.get("algorithms", runs["algorithm"])
        of = on[on["variant"].isin(variants) & on["algorithm"].isin(algorithms)]
        labels = ("" if kind else of["algorithm"].replace(names)) + of["variant"].map(variants)
        panels[f"{env} {names.get(kind, kind)}".strip()] = of.assign(label=labels)
    return panels


def plot(path, widths, panels, draw_panel, empty):
    """A PNG of panels, so many in each row, with one legend.

    draw_panel: a function of (axes, runs, {label: style}). empty: what the title of a panel without runs says.
    """
    plt.rcParams.update(PAPER["matplotlib"])
    figure = plt.figure(figsize=(max(9, 3.5 * max(widths)), 1 + 3.2 * len(widths)))
    titles = iter(panels)
    others = itertools.cycle(PAPER["other styles"])
    mosaic = [[*itertools.islice(titles, width), *["."] * (max(widths) - width)] for width in widths]
    labels = {label for runs in panels.values() for label in runs["label"]}
    styles = PAPER["styles"] | {label: next(others) for label in sorted(labels - PAPER["styles"].keys())}
    legend = {}
    for title, ax in figure.subplot_mosaic(mosaic).items():
        ax.set_title(title if len(panels[title]) else f"{title}: {empty}")
        if not len(panels[title]):
            ax.axis("off")
            continue
        draw_panel(ax, panels[title], styles)
        legend |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    columns = max(1, int(11 * figure.get_figwidth()) // (max(map(len, legend)) + 9))  # as many as fit side by side
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=columns)
    record.replace(path, lambda new: figure.savefig(new, format="png"))
    plt.close(figure)


def draw(ax, runs, styles, evaluations, shares=False):
    """A panel of learning curves: the mean with standard errors at the steps that all runs have.

    shares: against the share of the run, for runs of different lengths that take the same time.
    """
    groups = runs.groupby("label", sort=False)
    floor, ceiling = runs[["floor", "ceiling"]].iloc[0]  # nan for a task of one's own
    lowest = floor - (ceiling - floor) / 2  # early curves may go far down; a band is not drawn without its curve
    for i, (label, of) in enumerate(groups):
        curves = evaluations[evaluations["run"].isin(of.index)].pivot(index="run", columns="step", values="return")
        middle = curves.dropna(axis=1).mean()
        error = curves.dropna(axis=1).sem()
        if middle.empty:  # no two of these runs were evaluated at the same steps
            continue
        x = middle.index / (middle.index[-1] / 100 if shares else 1000)
        every = max(1, len(middle) // 8)
        colour, marker = styles[label]
        marks = dict(marker=marker, ms=4.5, markevery=(i * every // len(groups), every))
        band = dict(where=~(middle < lowest), color=colour, alpha=0.15, lw=0, zorder=2)
        ax.fill_between(x, middle - error, middle + error, **band)
        ax.plot(x, middle, color=colour, lw=1.7, label=label, zorder=3 + len(groups) - i, **marks)
    for level, line, label in ((floor, ":", "random policy"), (ceiling, "--", "scripted policy")):
        if np.isfinite(level):
            ax.axhline(level, color="#444444", lw=1.2, ls=line, label=label, zorder=1)
    bottom = np.fmax(ax.get_ylim()[0], lowest)
    top = max((np.max(line.get_ydata()) for line in ax.lines), default=bottom + 1)
    ax.set_ylim(bottom, top + 0.05 * (top - bottom))
    usual = runs[runs["variant"] == ""]  # a variant may go on for longer
    ax.set_xlim(0, 100 if shares else (usual if len(usual) else runs)["step"].max() / 1000)
    x = "share of the run's steps (%)" if shares else "environment steps (thousands)"
    ax.set(xlabel=x, ylabel="return of greedy episodes")


def draw_solved(ax, runs, styles):
    """A panel of the share of runs that have solved the task; below, the IQM of the steps needed, with its interval."""
    end = runs["step"].max() / 1000
    for i, (label, of) in enumerate(runs.groupby("label", sort=False), 1):
        colour, marker = styles[label]
        solved_at = np.sort(of["solved_at"].dropna()) / 1000
        share = np.arange(len(solved_at) + 1) / len(of)
        ax.step([0, *solved_at, end], [*share, share[-1]], where="post", color=colour, lw=1.7)
        needed = [of["needed"].to_numpy() / 1000]
        ax.plot(interval(iqm, needed), [-0.07 * i] * 2, color=colour, lw=1.7)
        ax.plot(iqm(*needed), -0.07 * i, color=colour, marker=marker, ms=4.5, ls="", label=label)
    ax.set(xlim=(0, end), ylim=(-0.07 * (i + 1), 1.05), yticks=[0, 0.5, 1])
    ax.set(xlabel="environment steps (thousands)", ylabel="share of runs that solve it")


def table(rows):
    """A Markdown table of rows, {column: cell} each; cells that a row does not have are empty, as are whole columns."""
    names = dict.fromkeys(name for row in rows for name in row)
    columns = [name for name in names if any(row.get(name) not in (None, "") for row in rows)]
    cells = [["" if row.get(name) is None else row[name] for name in columns] for row in rows]
    lines = [columns, ["---"] * len(columns), *cells]
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in lines) + "\n"


def compare(a, b, digits):
    """What a table says of the runs of two labels on a task, {column: cell}, and the p-value of their difference.

    If half of the runs of each solve it, the steps needed decide, otherwise the returns at the end.
    """
    solve = min(a["solved_at"].notna().mean(), b["solved_at"].notna().mean()) >= 0.5
    returns, needed = ([of[column].to_numpy() for of in (a, b)] for column in ("return", "needed"))
    row = {"return: A - B [95%]": with_interval(difference, returns, digits)}
    row["steps: A - B [95%]"] = with_interval(difference, needed, 0) if solve else ""
    x, y = (-needed[0], -needed[1]) if solve else returns
    test = stats.mannwhitneyu(x, y)
    share = test.statistic / (len(x) * len(y))
    row["P(A better)"] = f"{share:.2f}"
    low, high = interval(difference, returns)
    margin = EQUAL * (a["ceiling"] - a["floor"]).iloc[0]
    equal = -margin < low and high < margin
    row["verdict"] = "equal returns" if equal else "cannot be told"
    if solve or not equal:
        row["if certain"] = f"{'A' if share > 0.5 else 'B'} {'sooner' if solve else 'higher'}"
    return row, test.pvalue


def tables(panels, paper):
    """Two tables: what the runs of each label end with and the paper's number, and what pairs of labels differ by."""
    rows = []
    pairs = []
    p = []
    scaled = {}
    for panel, runs in panels.items():
        env = runs["env"].iloc[0]
        digits = 1 if env.startswith(("bp", "wtd")) else 3
        groups = dict(list(runs.groupby("label", sort=False)))
        for label, of in groups.items():
            k = of["solved_at"].count()
            n = len(of)
            low, high = stats.binomtest(k, n).proportion_ci(method="exact")
            row = {"task": panel, "": label, "paper": paper.get(env, {}).get(label), "runs": n}
            for column, x in (("return: mean ± SE", of["return"]), ("discounted", of["discounted_return"])):
                row[column] = f"{x.mean():.{digits}f} ± {x.sem():.{digits}f}".removesuffix(" ± nan")
            row["IQM [95%]"] = with_interval(iqm, [of["return"].to_numpy()], digits)
            if of["optimal"].all():
                row["solved [95%]"] = f"{k} of {n} [{low:.2f}, {high:.2f}]"
                row["steps needed: IQM [95%]"] = with_interval(iqm, [of["needed"].to_numpy()], 0)
            if env in REFERENCES:
                row |= {kind: f"{of[kind].iloc[0]:.{digits}f}" for kind in ("floor", "ceiling")}
                scaled.setdefault(label, []).append(of["scaled"].to_numpy())
            rows.append(row | {"steps": f"{of['step'].max():,.0f}"})
        usual, *others = groups
        of_panel = itertools.product([usual], others) if " " in panel else itertools.combinations(groups, 2)
        for a, b in of_panel:
            cells, value = compare(groups[a], groups[b], digits)
            pairs.append({"A": a, "B": b, "task": panel, **cells})
            p.append(value)
    for label, values in scaled.items():
        if 1 < len(values) == len(panels):
            row = {"task": "all, scaled", "": label, "IQM [95%]": with_interval(iqm, values, 3)}
            rows.append(row | {"optimality gap [95%]": with_interval(gap, values, 3)})
    for pair, value in zip(pairs, holm(p), strict=True):
        certain = pair.pop("if certain", None)
        pair["p (Holm)"] = f"{value:.3f}"
        pair["verdict"] = certain if certain and value < 0.05 else pair["verdict"]
    return table(rows) + (table(pairs) if pairs else "")


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"report: {message}")
    add = parser.add_argument
    results = record.RESULTS
    add("runs", nargs="*", default=[results], metavar="RUNS", help="default: benchmark/results")
    add("-o", "--output", type=record.folder, default=results, help="folder (default: benchmark/results)")
    args = parser.parse_args(argv)
    try:
        record.make_folder(args.output)
        runs, evaluations, notes = read_runs(args.runs)
        for note in notes:
            record.tell(f"report: {note}")
        shown = set()
        missing = []
        text = ""
        for title, section in PAPER["sections"].items():
            rest = list(runs.drop(shown)["env"].unique())  # tasks of runs that no section before has shown
            rows = section["panels"] or [rest[i : i + 4] for i in range(0, len(rest), 4)]
            rows = [row for row in rows if any(map(len, panels_of(section | {"panels": [row]}, runs).values()))]
            panels = panels_of(section | {"panels": rows}, runs)
            new = set().union(*(of.index for of in panels.values())) - shown
            if not new:  # nothing that was not to be seen in a section before
                missing += [title] if section["panels"] else []
                continue
            shown |= new
            name = title.lower().replace(" ", "-")
            widths = [len(row) for row in rows]
            shares = section.get("shares", False)
            curves = partial(draw, evaluations=evaluations, shares=shares)
            plot(args.output / f"{name}.png", widths, panels, curves, "no runs yet")
            text += f"## {title}\n\n{section['about']}\n\n![{title}]({name}.png)\n\n"
            known = {panel: of[of["optimal"]] for panel, of in panels.items()}
            if any(map(len, known.values())):
                plot(args.output / f"{name}-solved.png", widths, known, draw_solved, "no runs, or no optimum known")
                text += f"![{title}: solved]({name}-solved.png)\n\n"
            text += tables({panel: of for panel, of in panels.items() if len(of)}, section.get("paper", {}))
        sources = runs.groupby(["algorithm", "variant", "flags", "checksum"], sort=False)
        sources = sources[["env", "seed", "commit"]].agg(lambda x: " ".join(x.unique())).reset_index()
        record.replace_text(args.output / "sources.csv", sources.to_csv(index=False, lineterminator="\n"))
        values = dict(sections=text, missing="; ".join(missing) or "none", resamples=RESAMPLES)
        values |= dict(last=LAST, kept=KEPT, near=NEAR, equal=EQUAL, notes="".join(f"- {note}\n" for note in notes))
        text = (HERE / "report.md").read_text().format(**values).strip()
        record.replace_text(args.output / "README.md", f"{text}\n")
    except OSError as error:
        sys.exit(f"report: cannot write to {args.output}: {error.strerror or error}")
    print(args.output / "README.md")


if __name__ == "__main__":
    main()
