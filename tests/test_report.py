"""benchmark/report.py: its statistics by hand, and reports of runs that were written for the purpose."""

import json
import re
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
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
REFERENCES["bp-20"] = REFERENCES["wtd-s"]


@pytest.fixture(autouse=True)
def quick(request, monkeypatch):
    """Figures are drawn where they are what is tested."""
    monkeypatch.setattr(report, "REFERENCES", REFERENCES)
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
    assert report.interval([np.array([0.0, 0, 1])], report.iqm).tolist() == [0, 1]
    # two tasks with equal runs each: nothing varies, unless runs are redrawn across tasks
    assert report.interval([np.zeros(2), np.ones(2)], report.iqm).tolist() == [0.5, 0.5]
    assert np.isnan(report.interval([np.array([3.0])], report.iqm)).all()
    curves = np.random.default_rng(1).normal(size=(3, 20))
    whole = report.interval([curves], report.iqm)
    assert whole.shape == (2, 3) and (whole == report.interval([curves], report.iqm)).all()


def test_probability_of_improvement():
    """1 loses against 2 and 3, 3 wins against 2 and ties with 3: (0 + 0 + 1 + 1/2) / 4."""
    x, y = np.array([1.0, 3.0]), np.array([2.0, 3.0])
    assert report.improvement(x, y) == 0.375
    assert report.improvement(y, x) == 0.625
    assert report.improvement(x, np.array([5.0]), y, y) == (0.375 + 1) / 2
    # x is redrawn as 1 1 in 1/4 of the resamples, which wins nothing, and as 3 3 in 1/4: against 2 2 it wins all
    assert report.interval([x, y], report.improvement).tolist() == [0, 1]


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


def rows(text, label):
    """The cells of the table rows that start with a label."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return [line[1:] for line in lines if line[0] == label]


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
    """Solved is 58.8, 98% of 60, or more five times: rising(62) is, at 60 and above, and rising(60) is not, at 58."""
    text = make(tmp_path, runs)
    assert capsys.readouterr() == (f"{tmp_path / 'README.md'}\n", "")
    main, variants = text.split("## wtd-s\n")[1].split("## wtd-s: variants of AVF-QMIX\n")
    # 10, 20, 62: mean 30.667, squares 427.1 + 113.8 + 981.8 = 1522.7, / 2 = 761.3, root 27.59, / root 3 = 15.93;
    # one of three: 1 - (1 - p)^3 = 0.025 at p = 0.0084, and 0.025 = (1 - p)^3 + 3 p (1 - p)^2 at p = 0.906
    performance, matrix = rows(main, "AVF-QPLEX")
    assert performance[:4] == ["3", "600,000", "30.7 ± 15.9", "30.7 [10.0, 62.0]"]
    assert performance[4:] == ["1 of 3 [0.01, 0.91]", "15.3 ± 8.0", "0.33", "6.0 min"]
    assert rows(main, "AVF-QMIX")[0][4] == "0 of 3 [0.00, 0.71]"
    # against 20, 5, 60: 10 wins once, 20 wins once and ties once, 62 wins three times: 5.5 of 9 pairs
    assert matrix[0] == "" and matrix[1].startswith("0.61 [")
    assert rows(main, "*random*") == [["", "", "-40.0 ± 1.5", "", "", "-20.0", "0.25", ""]]
    assert rows(main, "*fixed loads*")[0][2] == "60.0 ± 0.0"
    single = rows(variants, "mixer_state=single")[0]
    assert single[:5] == ["1", "600,000", "-10.0", "-10.0", "0 of 1 [0.00, 0.97]"]
    assert rows(variants, "AVF-QMIX")[0][:3] == ["3", "600,000", "28.3 ± 16.4"]
    assert rows(text.split("## wtd-s\n")[0], "AVF-QPLEX") == [["30.7 [10.0, 62.0]"]]
    sources = [row for row in rows(text, "avf_qmix") if row[0] == "wtd-s"]
    assert [row[1] for row in sources] == ["", "mixer_state=single"]
    assert [row[-1] for row in sources] == ["1 2 3", "1"]


@pytest.fixture
def kept(runs, tmp_path):
    for folder in sorted(file.parent for file in runs.rglob("args.json")):
        run, evaluations = record.read_folder(folder)
        record.add(tmp_path / "kept", run | {"variant": "real" if "single" in run["flags"] else ""}, evaluations)
    return tmp_path / "kept"


def test_recorded_runs_give_the_report_of_their_folders(runs, kept, tmp_path):
    text = make(tmp_path / "a", runs).replace("mixer_state=single", "real")
    again = make(tmp_path / "b", kept)
    assert again.replace("mixer_state=single", "real") == text
    write_run(tmp_path / "runs", "avf_vdn", "wtd-s", 1, rising(40))
    both = make(tmp_path / "c", kept, tmp_path / "runs")
    assert rows(both, "AVF-VDN") and rows(both, "AVF-QPLEX")[1] == rows(text, "AVF-QPLEX")[1]


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
    assert rows(make(tmp_path, folder), "AVF-QPLEX")[1][2] == "4.0"


def test_what_is_left_out_is_said(tmp_path, capsys):
    root = tmp_path / "runs"
    write_run(root, "avf_qplex", "wtd-s", 1, rising(10), started=1_000)
    write_run(root, "avf_qplex", "wtd-s", 1, rising(30), started=2_000)
    write_run(root, "avf_qplex", "wtd-s", 2, dict(list(rising(70).items())[:3]))
    damaged = write_run(root, "avf_qplex", "wtd-s", 3, rising(50))
    for path in damaged.glob("events*"):
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 0xFF
        path.write_bytes(data)
    for path in write_run(root, "avf_qplex", "wtd-s", 4, rising(50)).glob("events*"):
        path.write_bytes(b"no event file" * 10)
    (write_run(root, "avf_qplex", "wtd-s", 5, rising(50)) / "args.json").write_text("{")
    write_run(root, "no_such_script", "wtd-s", 6, rising(50))
    (write_run(root, "avf_qplex", "wtd-s", 7, rising(90)) / "checkpoint.pt").write_text("there is more to do")
    write_run(root, "avf_qplex", "wtd-s", 8, rising(40))
    text = make(tmp_path, root)
    notes = [line for line in text.splitlines() if line.startswith("- ")]
    assert [note.split(":")[0] for note in notes[:-1]] == [
        *(f"- wtd-s__avf_qplex__{seed}__1000" for seed in (2, 3, 4, 5, 7)), "- wtd-s__no_such_script__6__1000",
    ]  # fmt: skip
    assert sum("left out, not finished" in note for note in notes) == 4
    assert "seed 1 of 1970-01-01 00:16:40: left out, there is a newer one" in notes[-1]
    assert capsys.readouterr().err.count("report: ") == len(notes) == 7
    assert str(tmp_path) not in text
    assert rows(text, "AVF-QPLEX")[1][:3] == ["2", "600,000", "35.0 ± 5.0"], "30 and 40"


def test_half_a_grid_and_all_tasks(tmp_path):
    """Scaled: wtd-s 10 and 35 are 0.5 and 0.75 of the way from -40 to 60, ct-10 0.25 and 0.75 of the way to 0.5."""
    for seed, wtd, ct in ((1, 10.0, 0.125), (2, 35.0, 0.375)):
        write_run(tmp_path / "runs", "avf_qplex", "wtd-s", seed, dict.fromkeys(STEPS, wtd))
        write_run(tmp_path / "runs", "avf_qplex", "ct-10", seed, dict.fromkeys(STEPS, ct))
    write_run(tmp_path / "runs", "avf_qmix", "wtd-s", 1, dict.fromkeys(STEPS, 0.0))
    text = make(tmp_path, tmp_path / "runs")
    # 0.25 0.5 0.75 0.75 without the lowest and the highest
    assert rows(text, "AVF-QPLEX")[0][0::2] == ["22.5 [10.0, 35.0]", "0.625 [0.375, 0.750]"]
    assert rows(text, "AVF-QMIX")[0] == ["0.0", "", ""], "no runs on ct-10, so no number for both tasks"
    ct = rows(text.split("## ct-10")[1], "AVF-QPLEX")[0]
    assert ct[2] == "0.250 ± 0.125" and ct[4] == "", "no optimum is known"


def test_variants(tmp_path):
    """Algorithms are compared where they have the same variant, and unequal numbers of steps are pointed out."""
    for algorithm, flags in (("avf_qplex", {}), ("avf_qmix", {}), ("avf_qmix", {"gamma": 0.9}), ("avf_vdn", {})):
        flags |= {"gamma": 0.8} if algorithm == "avf_vdn" else {}
        write_run(tmp_path / "runs", algorithm, "wtd-s", 1, rising(10), 1_000 + len(flags), **flags)
    text = make(tmp_path, tmp_path / "runs")
    titles = [line[3:] for line in text.splitlines() if line.startswith("## ")]
    assert titles == ["wtd-s", "wtd-s: gamma=0.8", "wtd-s: variants of AVF-QMIX", "Sources"]
    assert "budgets" not in text
    write_run(tmp_path / "runs", "avf_vdn", "wtd-s", 1, dict.fromkeys([*STEPS, 700_000], 1.0), gamma=0.9)
    text = make(tmp_path, tmp_path / "runs")
    titles = [line[3:] for line in text.splitlines() if line.startswith("## ")]
    assert titles[1:3] == ["wtd-s: gamma=0.9", "wtd-s: variants of AVF-QMIX"] and "variants of AVF-VDN" in titles[3]
    assert text.count("**The rows differ in their environment steps**") == 2


def test_runs_of_changed_code_are_pointed_out(kept, tmp_path):
    assert "several versions" not in make(tmp_path, kept)
    text = (kept / "runs.csv").read_text().splitlines()
    one = next(i for i, line in enumerate(text) if line.startswith("avf_qplex"))
    cells = text[one].split(",")
    cells[record.RUNS.index("checksum")] = "other"
    (kept / "runs.csv").write_text("\n".join([*text[:one], ",".join(cells), *text[one + 1 :]]) + "\n")
    evaluations = (kept / "evaluations.csv").read_text().splitlines()
    old = [line for line in evaluations if line.startswith("avf_qplex") and line.split(",")[3] == cells[3]]
    changed = [line.replace(f",{cells[3]},,", f",{cells[3]},other,") if line in old else line for line in evaluations]
    (kept / "evaluations.csv").write_text("\n".join(changed) + "\n")
    assert "**Some rows have runs of several versions of the code.**" in make(tmp_path, kept)


# Figures


def test_figures_show_every_curve(runs, tmp_path):
    text = make(tmp_path, runs)
    expected = {"wtd-s.png": ["#D55E00", "#0072B2"], "wtd-s_variants_of_AVF-QMIX.png": ["#0072B2", report.OTHERS[0][0]]}
    expected["overview.png"] = expected["wtd-s.png"]
    assert {path.name for path in tmp_path.glob("*.png")} == expected.keys()
    for name, colours in expected.items():
        assert f"({name})" in text
        pixels = np.asarray(Image.open(tmp_path / name).convert("RGB"), int)
        for colour in colours:
            rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
            assert (np.abs(pixels - rgb).max(2) < 8).sum() > 200, (name, colour)


def test_figures_of_the_paper_appear_with_runs_of_each_row(tmp_path):
    for env in ("bp-20", "wtd-s"):
        write_run(tmp_path / "runs", "avf_qplex", env, 1, rising(10))
    assert "![figure-4](figure-4.png)" in make(tmp_path, tmp_path / "runs")
    assert (tmp_path / "figure-4.png").exists()


def test_curves_of_figures_by_hand(tmp_path):
    """Of 0.1, 0.2, 0.6: mean 0.3, standard error 0.15275, IQM the mean, lowest and highest 0.1 and 0.6."""
    for seed, value in ((1, 0.1), (2, 0.2), (3, 0.6)):
        write_run(tmp_path, "avf_qplex", "ct-10", seed, dict.fromkeys(STEPS, value))
    runs, evaluations, notes = report.read_runs([tmp_path])
    section = report.make_sections(runs)
    assert not notes and set(section["section"]) == {"ct-10"}
    for kind, middle, low, high in (("mean", 0.3, 0.14725, 0.45275), ("IQM", 0.3, 0.1, 0.6)):
        ax = Figure().subplots()
        report.draw(ax, section, evaluations, kind)
        lines = {line.get_label(): line for line in ax.lines}
        assert lines["AVF-QPLEX"].get_xdata() == pytest.approx(range(100, 700, 100))
        assert lines["AVF-QPLEX"].get_ydata() == pytest.approx([middle] * 6)
        assert lines["random policy"].get_ydata()[0] == 0 and lines["scripted policy"].get_ydata()[0] == 0.5
        band = ax.collections[0].get_paths()[0].vertices[:, 1]
        assert (band.min(), band.max()) == pytest.approx((low, high), abs=1e-5)


# The command line


def test_bad_input_is_one_line(runs, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "runs.csv").write_text("algorithm,task\na,b\n")
    (tmp_path / "file").write_text("")
    write_run(tmp_path / "cut", "avf_qplex", "wtd-s", 1, {1000: 0.0})
    for arguments, message in [
        ([tmp_path / "empty"], "no runs found in"),
        ([runs, tmp_path / "nowhere"], "no runs found in"),
        ([tmp_path / "bad"], "cannot read"),
        ([tmp_path / "cut"], "no finished run found"),
        ([runs, "-o", tmp_path / "file"], "cannot write to"),
    ]:
        with pytest.raises(SystemExit) as error:
            report.main(["-o", str(tmp_path / "out"), *map(str, arguments)])
        assert str(error.value).startswith("report: ") and message in str(error.value), arguments
        assert "\n" not in str(error.value)


def test_the_program(tmp_path):
    run, evaluations = record.read_folder(write_run(tmp_path / "runs", "avf_qplex", "wtd-s", 1, rising(10)))
    record.add(tmp_path / "kept", run, evaluations)
    command = [sys.executable, ROOT / "benchmark" / "report.py", "kept", "-o", "new/report"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "new/report/README.md\n", "")
    assert {path.name for path in (tmp_path / "new" / "report").iterdir()} == {"README.md", "overview.png", "wtd-s.png"}


def test_the_report_in_this_repository_is_that_of_its_results(tmp_path, monkeypatch):
    """But for numbers: resamples may differ in a digit from one version of NumPy to the next."""
    monkeypatch.setattr(report, "REFERENCES", json.loads((ROOT / "benchmark" / "references.json").read_text()))
    again, kept = make(tmp_path, record.RESULTS), (record.RESULTS / "README.md").read_text()
    again, kept = (re.sub(r"[-\d.]+|!\[.*\n\n", "#", text).replace("##", "#") for text in (again, kept))
    assert again == kept, "make it again: python benchmark/report.py"
