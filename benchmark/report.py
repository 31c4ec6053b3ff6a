"""A report of runs in Markdown and PNG: the figures and tables of the paper, with its numbers beside ours.

    python benchmark/report.py                    of benchmark/results, into it
    python benchmark/report.py runs -o report     of run folders

RUNS are folders with a runs.csv (see record.py), run folders, or folders of them. Only finished runs count. A section
of paper.json says which algorithms and variants it compares on which tasks; what is in none of them comes last. A
section that is "older" shows runs of older code, whose flags or defaults are no longer there: the grid does not make
them.
"""

import argparse
import itertools
import json
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

HERE = Path(__file__).parent
PAPER = json.loads((HERE / "paper.json").read_text())  # what it compares, its numbers, and our styles
REFERENCES = json.loads((HERE / "references.json").read_text())  # made by scripted.py
RESAMPLES = 5_000
LAST = 5  # evaluations at the end of a run whose mean is its final performance, so that no lucky point decides
SOLVED = 0.98  # of the optimum, in each of these evaluations


def iqm(*samples, axis=-1):
    """Interquartile mean of the runs of all samples: a quarter of them, rounded down, is left out at either end."""
    return stats.trim_mean(np.concatenate(samples, axis), 0.25, axis=axis)


def improvement(*samples, axis=-1):
    """P(X > Y) of Agarwal et al. 2021, ties count half, a mean over tasks. samples: x of each task, then y of each."""
    pairs = zip(samples[: len(samples) // 2], samples[len(samples) // 2 :], strict=True)  # float [..., runs] each
    return np.mean([(np.sign(x[..., :, None] - y[..., None, :]) / 2 + 0.5).mean((-2, -1)) for x, y in pairs], axis=0)


def with_interval(statistic, samples, digits):
    """A statistic with its 95% percentile interval, runs being redrawn within each sample; of single runs without."""
    text = f"{statistic(*samples):.{digits}f}"
    if min(map(len, samples)) < 2:
        return text
    options = dict(n_resamples=RESAMPLES, vectorized=True, axis=-1, method="percentile", rng=0)
    low, high = stats.bootstrap(samples, statistic, **options).confidence_interval
    return f"{text} [{low:.{digits}f}, {high:.{digits}f}]"


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
    """
    found, kept, notes = [], [], []
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
    last = evaluations.sort_values("step").groupby("run").tail(LAST).groupby("run")
    runs = runs.join(last[record.VALUES].mean().round(6)).join(last["step"].max())  # rounded: ties stay ties
    for column, kind in (("floor", "random"), ("ceiling", "scripted")):
        returns = {env: reference[kind]["return"] for env, reference in REFERENCES.items()}
        runs[column] = runs["env"].map(returns)  # nan for a task of one's own
    runs["scaled"] = (runs["return"] - runs["floor"]) / (runs["ceiling"] - runs["floor"])
    runs["solved"] = last["return"].min() >= SOLVED * runs["ceiling"]
    same = ["env", "algorithm", "variant", "seed"]
    newest = runs.sort_values("date", kind="stable").drop_duplicates(same, keep="last")
    for run in runs.drop(newest.index).itertuples():
        notes.append(f"{run.algorithm} on {run.env}, seed {run.seed} of {run.date}: left out, there is a newer one")
    rank = {name: f"{i:02}" for i, name in enumerate([*envs.IDS, *PAPER["names"]])}
    return newest.sort_values(same, key=lambda column: column.replace(rank)), evaluations, notes


def panels_of(section, runs):
    """{title: runs, with a column `label`} of the panels of a section of paper.json.

    A panel is a task, where algorithms are compared, a task and an algorithm, of which variants are compared, or a
    task and one of the section's groups, {algorithm: variant}, where algorithms are compared, each as that variant.
    """
    names, panels = PAPER["names"], {}
    variants = section.get("variants") or {variant: f" {variant}".rstrip() for variant in runs["variant"]}
    for panel in itertools.chain.from_iterable(section["panels"]):
        env, _, kind = panel.partition(" ")
        on = runs[runs["env"] == env]
        if group := section.get("groups", {}).get(kind):
            of = on[on["algorithm"].map(group) == on["variant"]]
            labels = of["algorithm"].replace(names)
        else:
            algorithms = [kind] if kind else section.get("algorithms", runs["algorithm"])
            of = on[on["variant"].isin(variants) & on["algorithm"].isin(algorithms)]
            labels = ("" if kind else of["algorithm"].replace(names)) + of["variant"].map(variants)
        panels[f"{env} {names.get(kind, kind)}".strip()] = of.assign(label=labels)
    return panels


def plot(path, widths, panels, evaluations, shares):
    """A PNG of panels, so many in each row, with one legend; those without runs stay empty. shares: as for `draw`."""
    plt.rcParams.update(PAPER["matplotlib"])
    figure = plt.figure(figsize=(max(9, 3.5 * max(widths)), 1 + 3.2 * len(widths)))
    titles, others = iter(panels), itertools.cycle(PAPER["other styles"])
    mosaic = [[*itertools.islice(titles, width), *["."] * (max(widths) - width)] for width in widths]
    labels = {label for runs in panels.values() for label in runs["label"]}
    styles = PAPER["styles"] | {label: next(others) for label in sorted(labels - PAPER["styles"].keys())}
    legend = {}
    for title, ax in figure.subplot_mosaic(mosaic).items():
        ax.set_title(title if len(panels[title]) else f"{title}: no runs yet")
        if not len(panels[title]):
            ax.axis("off")
            continue
        draw(ax, panels[title], evaluations, styles, shares)
        legend |= dict(zip(*reversed(ax.get_legend_handles_labels()), strict=True))
    columns = max(1, int(11 * figure.get_figwidth()) // (max(map(len, legend)) + 9))  # as many as fit side by side
    figure.legend(legend.values(), legend, loc="outside lower center", ncols=columns)
    record.replace(path, lambda new: figure.savefig(new, format="png"))
    plt.close(figure)


def draw(ax, runs, evaluations, styles, shares=False):
    """A panel of learning curves: the mean with standard errors at the steps that all runs have.

    shares: against the share of the run, for runs of different lengths that take the same time.
    """
    groups = runs.groupby("label", sort=False)
    floor, ceiling = runs[["floor", "ceiling"]].iloc[0]  # nan for a task of one's own
    lowest = floor - (ceiling - floor) / 2  # early curves may go far down; a band is not drawn without its curve
    for i, (label, of) in enumerate(groups):
        curves = evaluations[evaluations["run"].isin(of.index)].pivot(index="run", columns="step", values="return")
        middle, error = curves.dropna(axis=1).mean(), curves.dropna(axis=1).sem()
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


def table(rows):
    """A Markdown table of rows, {column: cell} each; cells that a row does not have are empty, as are whole columns."""
    frame = pd.DataFrame(rows, dtype=object).replace("", None).dropna(axis=1, how="all").fillna("")
    lines = [frame.columns, ["---"] * frame.shape[1], *frame.to_numpy()]
    return "".join("| " + " | ".join(map(str, line)) + " |\n" for line in lines) + "\n"


def samples(panels, column):
    """{label: [the runs' values in each panel]} of the labels that have runs in all panels."""
    found = {}
    for runs in panels.values():
        for label, values in runs.groupby("label", sort=False)[column]:
            found.setdefault(label, []).append(values.to_numpy())
    return {label: values for label, values in found.items() if len(values) == len(panels)}


def tables(panels, paper):
    """What the runs of each label end with and the paper's number, and P(A > B), in each panel and over all of them."""
    rows, pairs = [], {}
    for panel, runs in panels.items():
        env = runs["env"].iloc[0]
        digits = 1 if env.startswith(("bp", "wtd")) else 3
        optimal = env in REFERENCES and REFERENCES[env]["scripted"]["optimal"]
        for label, of in runs.groupby("label", sort=False):
            k, n = of["solved"].sum(), len(of)
            low, high = stats.binomtest(k, n).proportion_ci(method="exact")
            row = {"task": panel, "": label, "paper": paper.get(env, {}).get(label), "runs": n}
            for column, x in (("return: mean ± SE", of["return"]), ("discounted", of["discounted_return"])):
                row[column] = f"{x.mean():.{digits}f} ± {x.sem():.{digits}f}".removesuffix(" ± nan")
            row["IQM [95%]"] = with_interval(iqm, [of["return"].to_numpy()], digits)
            row["solved [95%]"] = f"{k} of {n} [{low:.2f}, {high:.2f}]" if optimal else "no optimum known"
            known = {kind: of[kind].iloc[0] for kind in ("floor", "ceiling") if env in REFERENCES}
            row |= {kind: f"{value:.{digits}f}" for kind, value in known.items()}
            rows.append(row | {"steps": f"{of['step'].max():,.0f}"})
    columns = {panel: {panel: runs} for panel, runs in panels.items()}
    if len(panels) > 1:
        columns["all"] = panels
        for label, scaled in samples(panels, "scaled").items():
            rows.append({"task": "all, scaled", "": label, "IQM [95%]": with_interval(iqm, scaled, 3)})
    for column, of in columns.items():
        returns = samples(of, "return")
        for a, b in itertools.combinations(returns, 2):
            pair = pairs.setdefault((a, b), {"P(A > B)": f"{a} > {b}"})
            pair[column] = with_interval(improvement, returns[a] + returns[b], 2)
    return table(rows) + (table(pairs.values()) if pairs else "")


def main(argv=None):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.error = lambda message: sys.exit(f"report: {message}")
    add, results = parser.add_argument, record.RESULTS
    add("runs", nargs="*", default=[results], metavar="RUNS", help="default: benchmark/results")
    add("-o", "--output", type=record.folder, default=results, help="folder (default: benchmark/results)")
    args = parser.parse_args(argv)
    try:
        record.make_folder(args.output)
        runs, evaluations, notes = read_runs(args.runs)
        for note in notes:
            record.tell(f"report: {note}")
        shown, missing, text = set(), [], ""
        for title, section in PAPER["sections"].items():
            rest = list(runs.drop(shown)["env"].unique())  # tasks of runs that no section before has shown
            rows = section["panels"] or [rest[i : i + 4] for i in range(0, len(rest), 4)]
            rows = [row for row in rows if any(map(len, panels_of(section | {"panels": [row]}, runs).values()))]
            panels = panels_of(section | {"panels": rows}, runs)
            new = set().union(*(of.index for of in panels.values())) - shown
            if not new:  # nothing that was not to be seen in a section before
                missing += [title] if section["panels"] and not section.get("older") else []
                continue
            shown |= new
            name = title.lower().replace(" ", "-")
            widths, shares = [len(row) for row in rows], section.get("shares", False)
            plot(args.output / f"{name}.png", widths, panels, evaluations, shares)
            text += f"## {title}\n\n{section['about']}\n\n![{title}]({name}.png)\n\n"
            text += tables({panel: of for panel, of in panels.items() if len(of)}, section.get("paper", {}))
        sources = runs.groupby(["algorithm", "variant", "flags", "checksum"], sort=False)
        sources = sources[["env", "seed", "commit"]].agg(lambda x: " ".join(x.unique())).reset_index()
        values = dict(sections=text, missing="; ".join(missing) or "none", sources=table(sources.to_dict("records")))
        values |= dict(notes="".join(f"- {note}\n" for note in notes), last=LAST, solved=SOLVED, resamples=RESAMPLES)
        text = (HERE / "report.md").read_text().format(**values).strip()
        record.replace_text(args.output / "README.md", f"{text}\n")
    except OSError as error:
        sys.exit(f"report: cannot write to {args.output}: {error.strerror or error}")
    print(args.output / "README.md")


if __name__ == "__main__":
    main()
