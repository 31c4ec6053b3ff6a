"""benchmark/report.py: its statistics by hand, and reports of runs that were written for the purpose."""

import itertools
import json
import re
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pandas as pd
import pytest
from matplotlib import pyplot as plt
from matplotlib.figure import Figure
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

from benchmark import record, report

ROOT = Path(__file__).parents[1]
STEPS = range(100_000, 700_000, 100_000)  # as far as the longest task goes by default, so that no flag is changed
REFERENCES = {
    "wtd-s": {
        "random": {"return": -40.0, "se": 1.5, "discounted_return": -20.0, "success": 0.25},
        "scripted": {"name": "fixed loads", "optimal": True, "return": 60.0, "se": 0.0, "discounted_return": 30.0,
                     "success": 1.0},
    },
    "ct-10": {
        "random": {"return": 0.0, "se": 0.0, "discounted_return": 0.0, "success": 0.0},
        "scripted": {"name": "x", "optimal": False, "return": 0.5, "se": 0.0, "discounted_return": 0.1, "success": 0.5},
    },
}  # fmt: skip
REFERENCES["bp-20"] = REFERENCES["bp-10-primitive"] = REFERENCES["wtd-s"]


@pytest.fixture(autouse=True)
def quick(request, monkeypatch):
    """Figures are drawn where they are what is tested; few resamples do, where the runs have few different means."""
    monkeypatch.setattr(report, "REFERENCES", REFERENCES)
    monkeypatch.setattr(report, "RESAMPLES", 1_000)
    if "figure" not in request.node.name:
        monkeypatch.setattr(report, "plot", lambda *_: None)


# Statistics


def test_interquartile_mean():
    assert report.iqm(np.array([8.0, 1, 7, 2, 6, 3, 5, 4])) == 4.5
    assert report.iqm(np.array([9.0, 0, 3])) == 4.0, "a quarter of three, rounded down, is none"
    assert report.iqm(np.array([0.0, 1, 2]), np.array([9.0, 9])) == 4.0, "of all samples together: 0 | 1 2 9 | 9"
    assert report.iqm(np.arange(8.0).reshape(4, 2), axis=0).tolist() == [3, 4]


def test_intervals_redraw_within_samples():
    """Of three runs 0, 0, 1 the mean is 1 in 1/27 = 3.7% of the resamples, more than the 2.5% above the interval."""
    assert report.with_interval(report.iqm, [np.array([0.0, 0, 1])], 1) == "0.3 [0.0, 1.0]"
    # two tasks with equal runs each: nothing varies, unless runs are redrawn across tasks
    assert report.with_interval(report.iqm, [np.zeros(2), np.ones(2)], 2) == "0.50 [0.50, 0.50]"
    assert report.with_interval(report.iqm, [np.array([3.0])], 1) == "3.0"
    noise = np.random.default_rng(1).normal(size=20)
    assert report.with_interval(report.iqm, [noise], 6) == report.with_interval(report.iqm, [noise], 6)


def test_optimality_gap():
    """Runs above the optimum do not make up for others: (1 + 0.25 + 0 + 0) / 4."""
    assert report.gap(np.array([0.0, 0.75]), np.array([1.0, 1.5])) == 0.3125
    assert report.gap(np.array([[0.0, 1.0], [1.0, 1.0]])).tolist() == [0.5, 0.0]


def test_holms_correction():
    """By hand: 3 * 0.01, then 2 * 0.02, then the third is not below the second; and none is above 1."""
    assert report.holm([0.02, 0.01, 0.03]) == pytest.approx([0.04, 0.03, 0.04])
    assert report.holm([0.01, 0.2, 0.04, 0.9]) == pytest.approx([0.04, 0.4, 0.12, 0.9])
    assert report.holm([0.7, 0.8]) == pytest.approx([1, 1])
    assert len(report.holm([])) == 0


def some_runs(returns, needed=None, budget=600_000.0):
    """Runs on a task with the floor 0 and the ceiling 100; `needed` are steps, nan for never."""
    runs = pd.DataFrame({"return": np.array(returns, float), "floor": 0.0, "ceiling": 100.0})
    runs["solved_at"] = np.nan if needed is None else needed
    return runs.assign(needed=runs["solved_at"].fillna(budget))


def test_comparisons_by_hand():
    """The steps needed decide where half of the runs of both solve the task, the returns elsewhere."""
    fast = some_runs([99, 100, 99, 100], [100_000.0, 120_000, 110_000, np.nan])
    slow = some_runs([100, 99, 100, 99], [300_000.0, 320_000, np.nan, np.nan])
    row, p = report.compare(fast, slow, 1)
    assert row["return: A - B [95%]"].startswith("0.0 [") and row["verdict"] == "equal returns"
    assert row["steps: A - B [95%]"].startswith("-222,500 [") and row["if certain"] == "A sooner"
    # 3 runs are sooner than all 4, one ties with 2 that never do: (3 * 4 + 0 + 2 / 2) / 16
    assert row["P(A better)"] == "0.81" and 0.05 < p < 0.5
    row, _ = report.compare(slow, fast, 1)
    assert row["P(A better)"] == "0.19" and row["if certain"] == "B sooner"

    never = some_runs([50.0, 52, 54, 56])
    row, p = report.compare(fast, never, 1)
    assert row["return: A - B [95%]"].startswith("46.5 [") and row["steps: A - B [95%]"] == ""
    assert (row["verdict"], row["if certain"], row["P(A better)"]) == ("cannot be told", "A higher", "1.00")
    assert p == pytest.approx(2 / 70, abs=0.01), "of 70 ways to divide 8 runs one is as extreme, on either side"
    row, _ = report.compare(never, some_runs([51.0, 53, 54, 55]), 1)
    assert row["verdict"] == "cannot be told", "the interval is wider than 2% of the range"
    row, _ = report.compare(some_runs([50.0] * 4), some_runs([51.0] * 4), 1)
    assert row["verdict"] == "equal returns" and "if certain" not in row, "1 is below 2% of 100, however certain"
    row, _ = report.compare(some_runs([50.0]), some_runs([50.0]), 1)
    assert row["verdict"] == "cannot be told", "single runs have no interval"


def test_a_task_is_solved_when_it_is_kept_for_three_evaluations(tmp_path):
    """95% of 60 is 57. Two good evaluations are not enough, and what is lost later was solved."""
    for seed, values in enumerate(([57, 57, 0, 57, 57, 57], [60, 60, 60, 0, 0, 0], [0, 57, 60, 56.9, 60, 60])):
        write_run(tmp_path, "avf_qplex", "wtd-s", seed, dict(zip(STEPS, values, strict=True)))
    write_run(tmp_path, "avf_qplex", "ct-10", 1, dict.fromkeys(STEPS, 1.0))
    runs, *_ = report.read_runs([tmp_path])
    runs = runs.set_index(["env", "seed"])
    found = [runs.loc[("wtd-s", seed), ["solved_at", "needed"]].tolist() for seed in "012"]
    assert found[:2] == [[600_000] * 2, [300_000] * 2] and np.isnan(found[2][0]) and found[2][1] == 600_000
    assert np.isnan(runs.loc[("ct-10", "1"), "solved_at"]), "no optimum is known"


# Reports


def write_run(root, algorithm, task, seed, returns, started=1_000, **flags):
    """A run folder as the scripts write it, with an evaluation at each step of returns: {step: value}."""
    folder = root / f"{task}__{algorithm}__{seed}__{started}"
    folder.mkdir(parents=True)
    script = record.load_script(algorithm if (ROOT / f"{algorithm}.py").exists() else "avf_qplex")
    usual = vars(script.parse_args([f"--env={task}", f"--seed={seed}", f"--runs-dir={root}"]))
    (folder / "args.json").write_text(json.dumps({"algorithm": algorithm, **usual, **flags}))
    write_events(folder, returns, start=float(started))
    return folder


def write_events(folder, returns, seconds=60, resume_after=0, start=1e6):
    """An event file, begun at the time start, with evaluations; each 100,000 steps take that many seconds."""
    with patch("time.time", return_value=start), SummaryWriter(folder, purge_step=resume_after + 1) as writer:
        for step, value in returns.items():
            at = start + seconds * (step - resume_after) / 100_000
            values = {"return": value, "discounted_return": value / 2, "length": 100, "success": value > 50}
            for tag, x in values.items():
                writer.add_scalar(f"eval/{tag}", x, step, walltime=at)
            writer.add_scalar("losses/td_loss", 0.1, step, walltime=at)


def rising(end, first=-1000.0):
    """Evaluations whose last five are end - 2, end + 1, end, end - 1, end + 2."""
    return dict(zip(STEPS, [first, *(end + x for x in (-2.0, 1.0, 0.0, -1.0, 2.0))], strict=True))


def make(output, *arguments):
    """Runs the program; returns its README."""
    report.main([*map(str, arguments), "-o", str(output)])
    return (output / "README.md").read_text()


def section(text, title):
    """The text of a section."""
    return text.split(f"## {title}\n")[1].split("\n## ")[0]


def rows(text, *start):
    """The rows of tables that start with these cells, the rest of each as {column: cell}."""
    found, columns = [], None
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")] if line[:1] == "|" else None
        columns = (cells and columns) or cells
        if cells and tuple(cells[: len(start)]) == start:
            found.append(dict(zip(columns, cells, strict=True)))
    return found


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two algorithms on wtd-s, and a variant of the second, of which two seeds are missing."""
    root = tmp_path_factory.mktemp("runs")
    for seed, end in ((1, 10), (2, 20), (3, 62)):
        write_run(root, "avf_qplex", "wtd-s", seed, rising(end))
    for seed, end in ((1, 20), (2, 5), (3, 60)):
        write_run(root, "avf_qmix", "wtd-s", seed, rising(end))
    write_run(root / "more", "avf_qmix", "wtd-s", 1, rising(-10), mixer_state="single")
    return root


def test_a_report_by_hand(runs, tmp_path, capsys):
    """Solved is 57, 95% of 60, or more three times: rising(62) and rising(60) have it at 200,000 to 400,000 steps."""
    text = make(tmp_path, runs)
    assert capsys.readouterr() == (f"{tmp_path / 'README.md'}\n", "")
    assert [line[3:] for line in text.splitlines() if line[:3] == "## "] == ["Figure 4", "Figure 5", "Sources"]
    figure_4, figure_5 = section(text, "Figure 4"), section(text, "Figure 5")
    # 10, 20, 62: mean 30.667, squares 427.1 + 113.8 + 981.8 = 1522.7, / 2 = 761.3, root 27.59, / root 3 = 15.93;
    # one of three: 1 - (1 - p)^3 = 0.025 at p = 0.0084, and 0.025 = (1 - p)^3 + 3 p (1 - p)^2 at p = 0.906
    assert rows(figure_4, "wtd-s", "AVF-QPLEX") == [{
        "task": "wtd-s", "": "AVF-QPLEX", "runs": "3", "return: mean ± SE": "30.7 ± 15.9", "discounted": "15.3 ± 8.0",
        "IQM [95%]": "30.7 [10.0, 62.0]", "solved [95%]": "1 of 3 [0.01, 0.91]",
        "steps needed: IQM [95%]": "533,333 [400,000, 600,000]",
        "floor": "-40.0", "ceiling": "60.0", "steps": "600,000",
    }]  # fmt: skip
    assert rows(figure_4, "wtd-s", "AVF-QMIX")[0]["solved [95%]"] == "1 of 3 [0.01, 0.91]"
    # against 20, 5, 60: 10 wins once, 20 wins once and ties once, 62 wins three times: 5.5 of 9 pairs
    (pair,) = rows(figure_4, "AVF-QPLEX", "AVF-QMIX")
    assert pair["return: A - B [95%]"].startswith("2.3 [") and pair["P(A better)"] == "0.61"
    assert (pair["task"], pair["p (Holm)"], pair["verdict"]) == ("wtd-s", "0.825", "cannot be told")
    (single,) = rows(figure_5, "wtd-s AVF-QMIX", "single")
    assert (single["runs"], single["return: mean ± SE"], single["IQM [95%]"]) == ("1", "-10.0", "-10.0")
    assert single["solved [95%]"] == "0 of 1 [0.00, 0.97]" and single["steps needed: IQM [95%]"] == "600,000"
    assert rows(figure_5, "wtd-s AVF-QMIX", "joint")[0]["return: mean ± SE"] == "28.3 ± 16.4"
    assert rows(figure_5, "joint", "single")[0]["P(A better)"] == "1.00"
    sources = pd.read_csv(tmp_path / "sources.csv", keep_default_na=False)
    assert sources[["algorithm", "flags", "env", "seed"]].values.tolist() == [
        ["avf_qplex", "", "wtd-s", "1 2 3"], ["avf_qmix", "", "wtd-s", "1 2 3"],
        ["avf_qmix", "mixer_state=single", "wtd-s", "1"],
    ]  # fmt: skip
    missing = "No runs yet: Table 1; Figure 8; Figure 8 with as much time; Table 3; "
    assert missing in text, "and the others of which nothing is new"


def test_every_run_is_in_a_section_once_it_is_in_none_of_the_papers(tmp_path):
    """Half of the grid is a report of that half, and runs of one's own are beside the others on their task."""
    write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 1, rising(20))
    write_run(tmp_path / "runs", "avf_qmix", "ct-10", 1, rising(0.5), gamma=0.5)
    write_run(tmp_path / "runs", "cen_maddrqn", "wtd-s", 1, rising(10))
    text = make(tmp_path, tmp_path / "runs")
    assert [row["task"] for row in rows(section(text, "Figure 4"), "wtd-s")] == ["wtd-s"]
    titles = [line[3:] for line in text.splitlines() if line[:3] == "## "]
    assert titles == ["Figure 4", "Other runs", "Sources"], "the others would show nothing new"
    own = section(text, "Other runs")
    assert [row[""] for row in rows(own, "wtd-s")] == ["AVF-QPLEX", "Cen-MADDRQN"]
    assert rows(own, "ct-10", "AVF-QMIX gamma=0.5")
    assert rows(own, "AVF-QPLEX", "Cen-MADDRQN")[0]["P(A better)"] == "1.00"
    assert "Other runs" not in text.split("No runs yet")[1]


def test_the_papers_numbers_stand_beside_ours(tmp_path):
    for algorithm in ("avf_vdn", "mac_iaicc"):
        write_run(tmp_path / "runs", algorithm, "ct-10", 1, dict.fromkeys(STEPS, 0.25))
    write_run(tmp_path / "runs", "avf_qplex", "bp-10-primitive", 1, dict.fromkeys(STEPS, 25.0))
    text = make(tmp_path, tmp_path / "runs")
    papers = {name: row["paper"] for name in ("AVF-VDN", "Mac-IAICC") for row in rows(text, "ct-10", name)}
    assert papers == {"AVF-VDN": "0.13 ± 0.05", "Mac-IAICC": "0.29 ± 0.06"}
    (primitive,) = rows(text, "bp-10-primitive", "AVF-QPLEX")
    assert primitive["paper"] == "13.4 ± 2.6" and primitive["return: mean ± SE"] == "25.0"
    ct = rows(text, "ct-10", "AVF-VDN")[0]
    assert ct["IQM [95%]"] == "0.250" and "solved [95%]" not in ct, "no optimum is known"


def test_the_papers_numbers_are_the_papers():
    """Of Table 1 and Table 3, by rows."""
    one, three = (report.PAPER["sections"][title]["paper"] for title in ("Table 1", "Table 3"))
    names = ["Dec-MADDRQN", "Cen-MADDRQN", "AVF-VDN", "AVF-QMIX", "AVF-QPLEX", "Mac-IAICC"]
    assert " ".join(one["ct-10"][name] for name in names) == (
        "0.05 ± 0.02 0.35 ± 0.09 0.13 ± 0.05 0.26 ± 0.08 0.61 ± 0.09 0.29 ± 0.06"
    )
    lines = {env: " | ".join(by[name] for name in names[2:5]) for env, by in three.items()}
    assert lines == {
        "bp-10-primitive": "-4.1 ± 10.5 | -2.0 ± 9.3 | 13.4 ± 2.6",
        "wtd-s-primitive": "32 ± 4.5 | 44 ± 6.2 | 61 ± 5.3",
        **dict.fromkeys(("ct-10-primitive", "ct-10-onestep"), "0.04 ± 0.01 | 0.09 ± 0.03 | 0.20 ± 0.04"),
    }


def test_the_grid_has_the_runs_of_every_panel():
    """grid.sh records what paper.json compares, under the names of its variants, and nothing else."""
    grid = set()
    for words in re.findall(r"^python benchmark/sweep.py (.*)$", (ROOT / "benchmark" / "grid.sh").read_text(), re.M):
        own, _, flags = words.partition(" -- ")
        given = {name: values for name, *values in (part.split() for part in own.split("--")[1:])}
        for algorithm, env in itertools.product(given["algos"], given["envs"]):
            args = vars(record.load_script(algorithm).parse_args([f"--env={env}", *flags.split()]))
            flags_now = record.flags_of(record.values_of(algorithm, env), args)
            grid.add((env, algorithm, *given.get("variant", [flags_now])))
    compared = {("bp-30", "mac_iaicc", "same-time"), ("wtd-t1", "mac_iaicc", "same-time")}
    for panels in report.PAPER["sections"].values():
        for panel in itertools.chain.from_iterable(panels["panels"]):
            env, _, kind = panel.partition(" ")
            compared |= {(env, name, "") for name in ([kind] if kind else panels["algorithms"])}
            longer = "paper-longer" if env != "wtd-s" else None  # only there
            compared |= {(env, kind, variant) for variant in panels["variants"] if kind and variant != longer}
    assert grid == compared


@pytest.fixture
def kept(runs, tmp_path):
    for folder in sorted(file.parent for file in runs.rglob("args.json")):
        run, evaluations = record.read_folder(folder)
        record.add(tmp_path / "kept", run | {"variant": "mine" if "single" in run["flags"] else ""}, evaluations)
    return tmp_path / "kept"


def test_recorded_runs_give_the_report_of_their_folders(runs, kept, tmp_path):
    text, again = make(tmp_path / "a", runs), make(tmp_path / "b", kept)
    assert section(again, "Figure 4") == section(text, "Figure 4")
    assert [row[""] for row in rows(section(again, "Other runs"), "wtd-s")][2:] == ["AVF-QMIX mine"], (
        "its variant's name"
    )
    write_run(tmp_path / "runs", "avf_vdn", "wtd-s", 1, rising(40))
    both = make(tmp_path / "c", kept, tmp_path / "runs")
    assert rows(section(both, "Figure 4"), "wtd-s", "AVF-VDN")
    assert rows(both, "wtd-s", "AVF-QPLEX")[0] == rows(text, "wtd-s", "AVF-QPLEX")[0]


def test_a_resumed_run(tmp_path):
    """It stopped after 450,000 steps and was taken up again from the checkpoint of 300,000: 400,000 is replaced."""
    folder = write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 1, {})
    for path in folder.glob("events*"):
        path.unlink()
    write_events(folder, {100_000: 1, 200_000: 2, 300_000: 3, 400_000: 400, 450_000: 450}, seconds=10)
    write_events(folder, {400_000: 4, 500_000: 5, 600_000: 6}, seconds=100, resume_after=300_000, start=2e6)
    run, evaluations = record.read_folder(folder)
    assert evaluations["step"].tolist() == [str(step) for step in STEPS]
    assert evaluations["return"].tolist() == list("123456")
    assert run["seconds"] == "345", "45 and 300, without the pause"
    assert run["date"] == "1970-01-12 13:46:40" and run["steps"] == "600000"
    assert rows(make(tmp_path, folder), "wtd-s", "AVF-QPLEX")[0]["return: mean ± SE"] == "4.0"


def test_what_is_left_out_is_said(tmp_path, capsys):
    root = tmp_path / "runs"
    share = record.load_script("avf_qplex").parse_args(["--env=wtd-s"]).total_timesteps / STEPS[-1]

    def whole(end):
        """Evaluations whose last is that of a whole run, not one more."""
        return {int(step * share): value for step, value in rising(end).items()}

    write_run(root, "avf_qplex", "wtd-s", 1, whole(10), started=1_000)
    write_run(root, "avf_qplex", "wtd-s", 1, whole(30), started=2_000)
    write_run(root, "avf_qplex", "wtd-s", 2, dict(list(whole(70).items())[:3]))
    damaged = write_run(root, "avf_qplex", "wtd-s", 3, whole(50))
    for path in damaged.glob("events*"):
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 0xFF
        path.write_bytes(data)
    for path in write_run(root, "avf_qplex", "wtd-s", 4, whole(50)).glob("events*"):
        path.write_bytes(b"no event file" * 10)
    (write_run(root, "avf_qplex", "wtd-s", 5, whole(50)) / "args.json").write_text("{")
    write_run(root, "no_such_script", "wtd-s", 6, whole(50))
    (write_run(root, "avf_qplex", "wtd-s", 7, whole(90)) / "checkpoint.pt").write_text("there is more to do")
    write_run(root, "avf_qplex", "wtd-s", 8, whole(40))
    text = make(tmp_path, root)
    notes = [line for line in text.splitlines() if line.startswith("- ") and "left out, " in line]
    assert [note.split(":")[0] for note in notes[:-1]] == [
        *(f"- wtd-s__avf_qplex__{seed}__1000" for seed in (2, 3, 4, 5, 7)), "- wtd-s__no_such_script__6__1000",
    ]  # fmt: skip
    assert sum("left out, not finished" in note for note in notes) == 4
    assert "seed 1 of 1970-01-01 00:16:40: left out, there is a newer one" in notes[-1]
    assert capsys.readouterr().err.count("report: ") == len(notes) == 7
    assert str(tmp_path) not in text
    (row,) = rows(text, "wtd-s", "AVF-QPLEX")
    assert (row["runs"], row["return: mean ± SE"]) == ("2", "35.0 ± 5.0"), "30 and 40"


def test_over_all_tasks(tmp_path):
    """Scaled: on wtd-s 10 and 35 are 0.5 and 0.75 of the way from -40 to 60, on bp-20 -15 and 35 are 0.25 and 0.75."""
    for seed, wtd, bp in ((1, 10.0, -15.0), (2, 35.0, 35.0)):
        write_run(tmp_path / "runs", "avf_qplex", "wtd-s", seed, dict.fromkeys(STEPS, wtd))
        write_run(tmp_path / "runs", "avf_qplex", "bp-20", seed, dict.fromkeys(STEPS, bp))
    write_run(tmp_path / "runs", "avf_qmix", "wtd-s", 1, dict.fromkeys(STEPS, 0.0))
    text = make(tmp_path, tmp_path / "runs")
    # 0.25 0.5 0.75 0.75 without the lowest and the highest
    (both,) = rows(text, "all, scaled")
    assert both[""] == "AVF-QPLEX", "there are no runs of AVF-QMIX on bp-20"
    assert both["IQM [95%]"] == "0.625 [0.375, 0.750]" and both["optimality gap [95%]"].startswith("0.438 [")
    (pair,) = rows(text, "AVF-QPLEX", "AVF-QMIX")
    assert (pair["task"], pair["P(A better)"]) == ("wtd-s", "1.00")


def write_kept(place, seed, **changed):
    """A run as the sweep records it, with changed cells: of runs.csv or, under a VALUES name, of one evaluation."""
    key = {"algorithm": "avf_qplex", "env": "wtd-s", "flags": "", "seed": str(seed), "checksum": "c"}
    run = dict.fromkeys(record.RUNS, "") | key | {"steps": "600000"} | changed
    rows = [{**run, "step": str(step), **dict.fromkeys(record.VALUES, "10")} for step in STEPS]
    rows[2] |= {name: changed[name] for name in changed if name in record.VALUES}
    record.add(place, run, pd.DataFrame(rows)[record.TABLES["evaluations.csv"]])


def test_a_bad_recorded_run_does_not_take_the_others_down(tmp_path):
    kept = tmp_path / "kept"
    write_kept(kept, 1)
    write_kept(kept, 2, **{"return": "nan"})
    write_kept(kept, 3, length="long")
    write_kept(kept, 4, success="")
    write_kept(kept, 5, steps="700000")
    write_kept(kept, 6, steps="many")
    write_kept(kept, 7, discounted_return="inf")
    write_kept(kept, 8)
    lines = (kept / "evaluations.csv").read_text().splitlines(keepends=True)
    (kept / "evaluations.csv").write_text("".join(lines[:-6]))  # that of seed 8 is gone
    text = make(tmp_path, kept)
    assert rows(text, "wtd-s", "AVF-QPLEX")[0]["runs"] == "1"
    notes = [line for line in text.splitlines() if line.startswith("- ") and "left out, " in line]
    starts = [f"- avf_qplex on wtd-s, seed {seed}: left out, " for seed in range(2, 9)]
    assert [note[: len(start)] for note, start in zip(notes, starts, strict=True)] == starts
    assert [note.endswith("no finite number") for note in notes] == [True, True, True, False, False, True, False]
    assert notes[3].endswith("its evaluations do not go up to step 700000: cut short")


def test_a_bad_run_folder_does_not_take_the_others_down(tmp_path):
    write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 1, rising(10))
    write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 2, rising(float("nan")))
    write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 3, rising(10), total_timesteps="many")
    origin = write_run(tmp_path / "runs" / "more", "avf_qplex", "wtd-s", 4, rising(10)).parent / record.ORIGIN
    origin.write_text('{"flags": 5, "checksum": null}')
    text = make(tmp_path, tmp_path / "runs")
    assert rows(text, "wtd-s", "AVF-QPLEX")[0]["runs"] == "1"
    assert sum(line.startswith("- wtd-s__avf_qplex__") for line in text.splitlines()) == 3


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda text: text.replace("\n", "\n<<<<<<< HEAD\n", 1), "line 2 of runs.csv is no row of 11 columns: <<<<<<<"),
        (lambda text: text + "=======\n", "line 3 of runs.csv is no row of 11 columns: ======="),
        (lambda text: text.replace("\n", ",mine\n"), "runs.csv must begin with the columns algorithm,env,variant,"),
        (lambda text: text.replace("steps,", "", 1), "runs.csv must begin with the columns"),
        (lambda text: "", "runs.csv must begin with the columns"),
        (lambda text: text + '"', "runs.csv: unexpected end of data"),
        (lambda text: text[:-5], "line 2 of runs.csv is no row of 11 columns: avf_qplex,wtd-s,,1,"),
    ],
)
def test_tables_that_were_spoilt_are_refused_and_stay(tmp_path, change, message):
    write_kept(tmp_path / "kept", 1)
    path = tmp_path / "kept" / "runs.csv"
    path.write_text(change(path.read_text()))
    before = path.read_text()
    with pytest.raises(SystemExit) as error:
        make(tmp_path, tmp_path / "kept")
    assert str(error.value).startswith(f"report: cannot read {tmp_path / 'kept'}: {message}")
    assert "\n" not in str(error.value)
    with pytest.raises(ValueError, match=re.escape(message)):
        write_kept(tmp_path / "kept", 2)
    assert path.read_text() == before


def test_nothing_is_imported_that_a_run_folder_names(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "payload.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 1, rising(10))
    write_run(tmp_path / "runs", "payload", "wtd-s", 2, rising(10))
    own = write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 3, rising(10), env="payload:wtd-s", gamma=0.5)
    text = make(tmp_path, tmp_path / "runs")
    assert not (tmp_path / "ran").exists() and "payload" not in sys.modules
    assert "'payload' is none of the scripts" in text
    (row,) = rows(section(text, "Other runs"), "payload:wtd-s")
    assert row["runs"] == "1" and "gamma=0.5" in row[""] and "floor" not in row, own


# Figures


def test_a_figure_that_fails_leaves_the_old_one(runs, tmp_path, monkeypatch):
    make(tmp_path, runs)
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def full(figure, path, **options):
        Path(path).write_bytes(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full)
    with pytest.raises(SystemExit, match=r"^report: cannot write to .*: No space left on device$"):
        make(tmp_path, runs)
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_figures_show_every_curve(runs, tmp_path):
    text = make(tmp_path, runs)
    others = [colour for colour, _ in report.PAPER["other styles"]]
    expected = {"figure-4.png": ["#D55E00", "#0072B2"], "figure-5.png": others[:2]}
    expected |= {name.replace(".", "-solved."): colours for name, colours in expected.items()}
    assert {path.name for path in tmp_path.glob("*.png")} == expected.keys()
    for name, colours in expected.items():
        assert f"({name})" in text
        pixels = np.asarray(Image.open(tmp_path / name).convert("RGB"), int)
        for colour in colours:
            rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
            assert (np.abs(pixels - rgb).max(2) < 8).sum() > 200, (name, colour)


def test_figure_4_has_the_papers_layout(tmp_path, monkeypatch):
    """3 + 4 panels, those without runs empty, and rows without runs not there."""
    made = []
    monkeypatch.setattr(plt, "close", made.append)
    write_run(tmp_path / "runs", "avf_qplex", "bp-20", 1, rising(10))
    make(tmp_path, tmp_path / "runs")
    write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 1, rising(10))
    make(tmp_path, tmp_path / "runs")
    one, solved, two, _ = ([ax.get_title() for ax in figure.axes] for figure in made)
    assert solved[0] == "bp-10: no runs, or no optimum known"
    assert one == ["bp-10: no runs yet", "bp-20", "bp-30: no runs yet"]
    assert two == [*one, "wtd-s", *(f"wtd-{name}: no runs yet" for name in ("d", "t", "t1"))]


def test_curves_of_figures_by_hand(tmp_path):
    """Of 0.1, 0.2, 0.6: mean 0.3, standard error 0.15275. A variant may go on for longer than is shown."""
    for seed, value in ((1, 0.1), (2, 0.2), (3, 0.6)):
        write_run(tmp_path, "avf_qplex", "ct-10", seed, dict.fromkeys(STEPS, value))
    longer = dict.fromkeys([*STEPS, 900_000], 0.5)
    write_run(tmp_path, "avf_qplex", "ct-10", 1, longer, started=2_000, total_timesteps=900_000)
    runs, evaluations, notes = report.read_runs([tmp_path])
    panels = report.panels_of({"panels": [["ct-10"]]}, runs)
    labels = ["AVF-QPLEX", "AVF-QPLEX total_timesteps=900000"]
    assert not notes and list(panels["ct-10"]["label"].unique()) == labels
    ax = Figure().subplots()
    report.draw(ax, panels["ct-10"], dict.fromkeys(labels, ("red", "o")), evaluations)
    lines = {line.get_label(): line for line in ax.lines}
    assert lines["AVF-QPLEX"].get_xdata() == pytest.approx(range(100, 700, 100))
    assert lines["AVF-QPLEX"].get_ydata() == pytest.approx([0.3] * 6)
    assert lines["random policy"].get_ydata()[0] == 0 and lines["scripted policy"].get_ydata()[0] == 0.5
    assert ax.get_xlim() == (0, 600) and lines[labels[1]].get_xdata()[-1] == 900
    band = ax.collections[0].get_paths()[0].vertices[:, 1]
    assert (band.min(), band.max()) == pytest.approx((0.14725, 0.45275), abs=1e-5)
    ax = Figure().subplots()
    report.draw(ax, panels["ct-10"], dict.fromkeys(labels, ("red", "o")), evaluations, shares=True)
    lines = {line.get_label(): line for line in ax.lines}
    assert ax.get_xlim() == (0, 100) and {lines[label].get_xdata()[-1] for label in labels} == {100}
    assert lines[labels[1]].get_xdata()[0] == pytest.approx(100 / 9)


def test_the_share_of_runs_that_solve_it_by_hand():
    """Of four runs two are solved, after 100,000 and 300,000 steps; the IQM of 100, 300, 600 and 600 is 450."""
    runs = some_runs([99, 99, 0, 0], [300_000.0, 100_000, np.nan, np.nan]).assign(label="x", step=600_000.0)
    ax = Figure().subplots()
    report.draw_solved(ax, runs, {"x": ("red", "o")})
    share, band, middle = ax.lines
    assert share.get_xdata().tolist() == [0, 100, 300, 600] and share.get_ydata().tolist() == [0, 0.25, 0.5, 0.5]
    assert middle.get_xdata() == 450 and middle.get_label() == "x"
    assert band.get_xdata()[0] < 450 < band.get_xdata()[1] == 600


# The command line


def test_bad_input_is_one_line(runs, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "runs.csv").write_text("algorithm,task\na,b\n")
    (tmp_path / "file").write_text("")
    write_run(tmp_path / "cut", "avf_qplex", "wtd-s", 1, {1000: 0.0})
    for arguments, message in [
        ([tmp_path / "empty"], "no finished run found"),
        ([runs, tmp_path / "nowhere"], "cannot read"),
        ([tmp_path / "bad"], "cannot read"),
        ([tmp_path / "cut"], "no finished run found"),
        ([runs, "-o", tmp_path / "file"], "cannot write to"),
    ]:
        with pytest.raises(SystemExit) as error:
            report.main(["-o", str(tmp_path / "out"), *map(str, arguments)])
        assert str(error.value).startswith("report: ") and message in str(error.value), arguments
        assert "\n" not in str(error.value)


@pytest.mark.slow
def test_the_program(tmp_path):
    run, evaluations = record.read_folder(write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 1, rising(10)))
    record.add(tmp_path / "kept", run, evaluations)
    command = [sys.executable, ROOT / "benchmark" / "report.py", "kept", "-o", "new/report"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "new/report/README.md\n", "")
    assert {path.name for path in (tmp_path / "new" / "report").iterdir()} == {
        "README.md", "sources.csv", "figure-4.png", "figure-4-solved.png",
    }  # fmt: skip


@pytest.mark.slow
def test_the_report_in_this_repository_is_that_of_its_results(tmp_path, monkeypatch):
    """But for numbers, since resamples may differ in a digit from one version of NumPy to the next, and for what the
    grid has got since and has not been recorded yet."""
    monkeypatch.setattr(report, "REFERENCES", json.loads((ROOT / "benchmark" / "references.json").read_text()))
    if not (record.RESULTS / "runs.csv").exists():
        pytest.skip("no runs are recorded yet")
    monkeypatch.setattr(report, "RESAMPLES", 5_000)
    again, kept = make(tmp_path, record.RESULTS), (record.RESULTS / "README.md").read_text()
    again, kept = (
        re.sub(r"[-\d.,]+|!\[.*\n\n|No runs yet: .*", "#", text).replace("##", "#") for text in (again, kept)
    )
    assert again == kept, "make it again: python benchmark/report.py"
