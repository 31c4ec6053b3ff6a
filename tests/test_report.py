"""benchmark/report.py: its statistics by hand, and reports of runs that were written for the purpose."""

import csv
import json
import shutil
import subprocess
import sys
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from PIL import Image
from torch.utils.tensorboard import SummaryWriter

import avf_qmix
import avf_qplex
import avf_vdn
from benchmark import report

ROOT = Path(__file__).parents[1]
STEPS = range(1000, 7000, 1000)
REFERENCES = {
    "wtd-s": {
        "random": {"return": -40.0, "se": 1.5, "discounted_return": -20.0, "episodes": 2000},
        "scripted": {"name": "fixed loads", "return": 60.0, "se": 0.0, "discounted_return": 30.0, "episodes": 2000},
        "note": "written for this test",
    },
    "ct-10": {"random": {"return": 0.0}, "scripted": {"return": 0.5}},
}


@pytest.fixture(autouse=True)
def quick(request, monkeypatch):
    """Figures are drawn where they are what is tested."""
    if "figures" not in request.node.name:
        monkeypatch.setattr(report, "write_figures", lambda sections, output: None)


# Statistics


def test_standard_error():
    """Of 10, 20, 60: mean 30, squares 400 + 100 + 900, / 2 = 700, root 26.458, / root 3 = 15.275."""
    assert report.standard_error(np.array([10.0, 20.0, 60.0])) == pytest.approx(15.275, abs=1e-3)
    assert np.isnan(report.standard_error(np.array([5.0])))
    assert report.standard_error(np.array([[0.0, 1.0], [2.0, 1.0]])).tolist() == [1.0, 0.0]


@pytest.mark.parametrize(
    "values, expected",
    [
        ([8, 1, 7, 2, 6, 3, 5, 4], 4.5),  # 1 2 | 3 4 5 6 | 7 8: trim_mean(x, 0.25) as well
        ([9, 0, 3], 3.5),  # 0.75 off either end leaves 0.25, 1, 0.25: (0 + 4 * 3 + 9) / 6
        ([0, 1, 2, 3, 10], 2.0),  # 1.25 off either end leaves 0, 0.75, 1, 0.75, 0: (0.75 + 2 + 2.25) / 2.5
        ([1, 4], 2.5),
        ([7], 7.0),
    ],
)
def test_interquartile_mean(values, expected):
    x = np.array(values, float)
    assert report.iqm(x) == pytest.approx(expected)
    assert report.iqm(np.stack([x, x + 1])[:, None], axis=2)[:, 0] == pytest.approx([expected, expected + 1])


def test_bootstrap_redraws_within_strata():
    """Two runs, 0 and 1, give the means 0, 1/2, 1 in 1/4, 1/2, 1/4 of the resamples."""
    coin = np.array([0.0, 1.0])
    assert report.bootstrap([coin], report.pooled_iqm).tolist() == [0, 1]
    assert report.bootstrap([coin], report.pooled_iqm, level=0.4).tolist() == [0.5, 0.5]
    # two tasks with equal runs each: nothing varies, unless runs are redrawn across tasks
    assert report.bootstrap([np.zeros(2), np.ones(2)], report.pooled_iqm).tolist() == [0.5, 0.5]
    # three runs, 0, 0, 1: the mean is 1 in 1/27 = 3.7% of the resamples, more than the 2.5% above the interval
    runs = np.array([0.0, 0.0, 1.0])
    assert report.bootstrap([runs], lambda drawn: drawn[0].mean(1)).tolist() == [0, 1]
    curves = np.random.default_rng(1).normal(size=(20, 3))
    whole = report.bootstrap([curves], report.pooled_iqm)
    assert whole.shape == (2, 3) and (whole == report.bootstrap([curves], report.pooled_iqm)).all()


def test_probability_of_improvement():
    """1 loses against 2 and 3, 3 wins against 2 and ties with 3: (0 + 0 + 1 + 1/2) / 4."""
    x, y = np.array([1.0, 3.0]), np.array([2.0, 3.0])
    assert report.improvement([x, y]) == 0.375
    assert report.improvement([y, x]) == 0.625
    assert report.improvement([x, y, np.array([5.0]), y]) == (0.375 + 1) / 2
    # x is redrawn as 1 1 in 1/4 of the resamples, which wins nothing, and as 3 3 in 1/4: against 2 2 it wins all
    assert report.bootstrap([x, y], report.improvement).tolist() == [0, 1]


# Reading


def write_run(root, script, task, seed, returns, started=1_000, total=6_000, **flags):
    """A run folder as the scripts write it, with an evaluation at each step of returns: {step: value}."""
    folder = root / f"{task}__{script.ALGORITHM}__{seed}__{started}"
    folder.mkdir(parents=True)
    args = asdict(script.defaults(task, seed=seed, total_timesteps=total, runs_dir=str(root), **flags))
    (folder / "args.json").write_text(json.dumps({"algorithm": script.ALGORITHM, **args}))
    write_events(folder, returns)
    return folder


def write_events(folder, returns, seconds=0.1, resume_after=0, start=1e6):
    """An event file, begun at the time start, with evaluations; each 1,000 steps take that many seconds."""
    with patch("time.time", return_value=start), SummaryWriter(folder, purge_step=resume_after + 1) as writer:
        for step, value in returns.items():
            at = start + seconds * (step - resume_after) / 1000
            writer.add_scalar("charts/SPS", 500.0, step, walltime=at)
            for tag, factor in (("return", 1), ("discounted_return", 0.5)):
                writer.add_scalar(f"eval/{tag}", factor * value, step, walltime=at)
            writer.add_scalar("eval/length", 100, step, walltime=at)
            writer.add_scalar("eval/success", value > 50, step, walltime=at)
            writer.add_scalar("losses/td_loss", 0.1, step, walltime=at)


def rising(end, first=-1000.0):
    """Evaluations whose last five are end - 2, end - 1, end, end + 1, end + 2."""
    return dict(zip(STEPS, [first, *(end + x for x in (-2.0, 1.0, 0.0, -1.0, 2.0))], strict=True))


def make(tmp_path, *arguments, name="report", references=REFERENCES):
    """Runs the program; returns its README and its output folder."""
    path = tmp_path / "references.json"
    path.write_text(json.dumps(references))
    output = tmp_path / name
    report.main([*map(str, arguments), "-o", str(output), "--references", str(path), "--commit", "abc1234"])
    return (output / "README.md").read_text(), output


def rows(text, label):
    """The cells of the table rows that start with a label."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    return [line[1:] for line in lines if line[0] == label]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two algorithms and a variant on wtd-s. A seed of AVF-QMIX is missing."""
    root = tmp_path_factory.mktemp("runs")
    for seed, end in ((1, 10), (2, 20), (3, 60)):
        write_run(root, avf_qplex, "wtd-s", seed, rising(end))
        write_run(root, avf_qmix, "wtd-s", seed, rising(-end), mixer_state="single")
    for seed, end in ((1, 20), (2, 5)):
        write_run(root / "more", avf_qmix, "wtd-s", seed, rising(end))
    return root


def test_final_performance_by_hand(runs, tmp_path, capsys):
    text, _ = make(tmp_path, runs)
    assert capsys.readouterr().err == ""
    qplex, matrix = rows(text, "AVF-QPLEX")[-2:]
    # finals 10, 20, 60; three weigh 1/6, 4/6, 1/6 in the IQM: 25; resampled three times the lowest in 1/27 > 2.5%
    assert qplex[:7] == ["3", "6,000", "30.0 ± 15.3", "25.0 [10.0, 60.0]", "20.0", "1 of 3", "15.0 ± 7.6"]
    assert qplex[7:] == ["12.5 [5.0, 30.0]", "10.0", "", "0.0 min"]
    assert "at least 57, 95% of the scripted policy's." in text
    # against 20 and 5: 10 wins once, 20 wins once and ties once, 60 wins twice: 4.5 of 6 pairs
    assert matrix[0] == "" and matrix[1].startswith("0.75 [")
    assert rows(text, "*random policy*")[-1][2:7] == ["-40.0 ± 1.5", "", "", "", "-20.0"]
    assert rows(text, "*scripted: fixed loads*")[0][1:3] == ["2,000 episodes", "60.0 ± 0.0"]
    assert rows(text, "AVF-QPLEX")[0] == ["25.0 [10.0, 60.0], 1 of 3"]  # the summary
    assert "Missing seeds: AVF-QMIX 3." in text
    assert "**Few seeds.** The intervals of rows of 2 runs" in text
    assert "written for this test" in text and "All tasks together" not in text

    # of the variant: a section of its own, with the algorithm as it is by default
    assert "## wtd-s: variants of AVF-QMIX" in text
    assert rows(text, "mixer_state=single")[0][:3] == ["3", "6,000", "-30.0 ± 15.3"]
    commands = rows(text, "`python avf_qmix.py --env wtd-s --seed SEED --total-timesteps 6000 --mixer-state single`")
    commands += rows(text, "`python avf_qmix.py --env wtd-s --seed SEED --total-timesteps 6000`")
    assert commands == [["1 2 3", "abc1234"], ["1 2", "abc1234"]]

    text, _ = make(tmp_path, runs, "--last", 1, name="last")  # the last evaluations: 12, 22, 62
    assert rows(text, "AVF-QPLEX")[-2][2] == "32.0 ± 15.3"


def test_csv_has_every_evaluation(runs, tmp_path):
    _, output = make(tmp_path, runs)
    with open(output / "evaluations.csv") as file:
        table = list(csv.DictReader(file))
    names = "algorithm task seed step return discounted_return length success wall_clock_s variant"
    assert list(table[0]) == names.split()
    assert len(table) == 8 * 6
    keys = ("algorithm", "seed", "step", "return", "discounted_return", "length", "success")
    assert [table[0][key] for key in keys] == ["avf_qplex", "1", "1000", "-1000", "-500", "100", "0"]
    assert {(row["algorithm"], row["variant"]) for row in table} == {
        ("avf_qplex", ""), ("avf_qmix", ""), ("avf_qmix", "mixer_state=single")}  # fmt: skip


def test_the_same_report_from_its_own_data(runs, tmp_path):
    text, output = make(tmp_path, runs)
    for name, source in (("file", output / "evaluations.csv"), ("folder", output)):
        again, folder = make(tmp_path, source, name=name)
        assert again == text
        for file in ("evaluations.csv", "runs.csv"):
            assert (folder / file).read_bytes() == (output / file).read_bytes()
    alone = tmp_path / "alone.csv"
    alone.write_bytes((output / "evaluations.csv").read_bytes())
    again, _ = make(tmp_path, alone, name="without runs.csv")
    assert again.split("## Commands")[0] == text.split("## Commands")[0]
    assert "8 of 8 runs are in no runs.csv" in again and "not known" in again


def test_a_resumed_run(tmp_path):
    """It stopped after 4,000 steps and was taken up again from the checkpoint of 3,000: 4,000 is replaced."""
    folder = write_run(tmp_path / "runs", avf_qplex, "wtd-s", 1, {})
    for path in folder.glob("events*"):
        path.unlink()
    write_events(folder, {1000: 1, 2000: 2, 3000: 3, 4000: 400, 4500: 450}, seconds=10)
    write_events(folder, {4000: 4, 5000: 5, 6000: 6}, seconds=100, resume_after=3000, start=2e6)
    values = report.read_events(folder, pytest.fail)
    assert values[:, 0].tolist() == list(STEPS)
    assert values[:, 1].tolist() == [1, 2, 3, 4, 5, 6]
    assert values[:, 5] == pytest.approx([10, 20, 30, 130, 230, 330])  # not the pause, nor what was lost
    text, _ = make(tmp_path, folder)
    assert rows(text, "AVF-QPLEX")[-1][2] == "4.0" and rows(text, "AVF-QPLEX")[-1][-1] == "5.5 min"
    assert "**Rows of one run**" in text and "[95%]" in text and "4.0 [" not in text


def test_what_is_left_out_is_said(tmp_path, capsys):
    root = tmp_path / "runs"
    write_run(root, avf_qplex, "wtd-s", 1, rising(10), started=1_000)
    write_run(root, avf_qplex, "wtd-s", 1, rising(30), started=2_000)
    write_run(root, avf_qplex, "wtd-s", 1, rising(20), started=1_500, device="cuda")  # makes no variant
    write_run(root, avf_qplex, "wtd-s", 2, dict(list(rising(70).items())[:4]))
    damaged = write_run(root, avf_qplex, "wtd-s", 3, rising(50))
    for path in damaged.glob("events*"):
        data = bytearray(path.read_bytes())
        data[len(data) // 2] ^= 0xFF
        path.write_bytes(data)
    for path in write_run(root, avf_qplex, "wtd-s", 4, rising(50)).glob("events*"):
        path.write_bytes(b"no event file" * 10)
    (write_run(root, avf_qplex, "wtd-s", 5, rising(50)) / "args.json").write_text("{")
    cut = write_run(root, avf_qplex, "wtd-s", 6, rising(40))
    for path in cut.glob("events*"):  # a run that was killed in the middle of a record, after its last evaluation
        path.write_bytes(path.read_bytes()[:-5])
    text, _ = make(tmp_path, root)
    notes = text.split("## Notes on the data")[1]
    assert "wtd-s__avf_qplex__1__1000: left out, wtd-s__avf_qplex__1__1500 is newer" in notes
    assert "wtd-s__avf_qplex__1__1500: left out, wtd-s__avf_qplex__1__2000 is newer" in notes
    assert "wtd-s__avf_qplex__2__1000: left out (--unfinished counts it), only 4,000 of 6,000 steps are done" in notes
    assert "wtd-s__avf_qplex__3__1000: an event file is damaged from byte" in notes
    assert "wtd-s__avf_qplex__3__1000: left out (--unfinished counts it), only" in notes
    assert "wtd-s__avf_qplex__4__1000: left out, no evaluations" in notes
    assert "wtd-s__avf_qplex__5__1000: left out, args.json is damaged" in notes
    assert "wtd-s__avf_qplex__6__1000: an event file is damaged" in notes
    assert notes.count("\n- ") == 9  # and that the file of run 4 is damaged
    assert str(tmp_path) not in text and "tfevents" not in text
    assert f"({damaged}/events.out.tfevents." in capsys.readouterr().err
    final = rows(text, "AVF-QPLEX")[-1]
    assert final[0] == "2" and final[2].startswith("35.0 ±")  # 30 and 40

    text, _ = make(tmp_path, root, "--unfinished", name="unfinished")
    final = rows(text, "AVF-QPLEX")[-1]
    assert "wtd-s__avf_qplex__2__1000: counts, but only 4,000 of 6,000 steps are done" in text
    assert int(final[0]) == 4 and int(final[1].replace(",", "")) < 5_000  # cut to the steps that all of them have


def test_paper_and_all_tasks(tmp_path):
    """Scaled: wtd-s -15 and 35 are 0.25 and 0.75 of the way from -40 to 60, ct-10 0.25 and 0.75 of the way to 0.5."""
    for seed, share in ((1, 0.25), (2, 0.75)):
        write_run(tmp_path / "runs", avf_qplex, "wtd-s", seed, dict.fromkeys(STEPS, -40 + 100 * share))
        write_run(tmp_path / "runs", avf_qplex, "ct-10", seed, dict.fromkeys(STEPS, 0.5 * share + 0.25 * (seed == 1)))
        write_run(tmp_path / "runs", avf_qmix, "wtd-s", seed, dict.fromkeys(STEPS, 0.0))
    text, _ = make(tmp_path, tmp_path / "runs")
    ct = rows(text.split("## ct-10")[1], "AVF-QPLEX")[0]
    assert ct[2] == "0.375 ± 0.000" and ct[5] == "0 of 2" and ct[9] == "0.61 ± 0.09 (Table 1)"
    everything = text.split("## All tasks together")[1]
    # 0.25 0.75 0.75 0.75: a quarter off either end leaves 0.75 twice. Two low runs on wtd-s in 1/4: 0.25 0.25 0.75 0.75
    assert rows(everything, "AVF-QPLEX") == [["2 + 2", "0.750 [0.500, 0.750]", "0.625"]]
    assert "left out: AVF-QMIX" in everything


def test_an_algorithm_with_settings_of_its_own_is_named_so(tmp_path):
    """Compared with the others' defaults it is a variant; flags that all runs of a task share are not."""
    write_run(tmp_path / "runs", avf_qplex, "wtd-s", 1, rising(10), gamma=0.9)
    write_run(tmp_path / "runs", avf_qmix, "wtd-s", 1, rising(10), gamma=0.9, mixing_embed=16)
    write_run(tmp_path / "runs", avf_vdn, "wtd-s", 1, rising(10), total=400_000, gamma=0.9)  # the default
    text, _ = make(tmp_path, tmp_path / "runs", "--unfinished", references={})
    assert (
        len(rows(text, "AVF-QPLEX")) == len(rows(text, "AVF-VDN")) == 3
        and len(rows(text, "AVF-QMIX, mixing_embed=16")) == 3
    )
    assert "--gamma 0.9 --mixing-embed 16`" in text and "--gamma 0.9`" in text
    assert "random policy" not in text and "Solved:" not in text


# Figures


needs_matplotlib = pytest.mark.skipif(
    not find_spec("matplotlib"), reason="figures need matplotlib: pip install -e '.[report]'"
)


@needs_matplotlib
def test_figures_show_every_curve(runs, tmp_path):
    text, output = make(tmp_path, runs)
    assert {path.name for path in output.glob("*.png")} == {"overview.png", "wtd-s.png", "wtd-s__avf_qmix.png"}
    expected = {"wtd-s.png": ["#D55E00", "#0072B2"], "wtd-s__avf_qmix.png": ["#0072B2", report.OTHERS[0][0]]}
    for name, colours in (expected | {"overview.png": expected["wtd-s.png"]}).items():
        assert f"({name})" in text
        pixels = np.asarray(Image.open(output / name).convert("RGB"), int)
        for colour in colours:
            rgb = [int(colour[i : i + 2], 16) for i in (1, 3, 5)]
            assert (np.abs(pixels - rgb).max(2) < 8).sum() > 200, (name, colour)


@needs_matplotlib
def test_curves_of_figures_by_hand(tmp_path):
    """Of 0.1, 0.2, 0.6: mean 0.3, standard error 0.15275, IQM 0.25, lowest and highest 0.1 and 0.6."""
    from matplotlib.figure import Figure

    for seed, value in ((1, 0.1), (2, 0.2), (3, 0.6)):
        write_run(tmp_path, avf_qplex, "ct-10", seed, dict.fromkeys(STEPS, value))
    runs = report.read_runs([tmp_path], "", False, pytest.fail)
    (section,) = report.make_sections(runs, 5, REFERENCES)
    for kind, middle, low, high in (("mean", 0.3, 0.14725, 0.45275), ("IQM", 0.25, 0.1, 0.6)):
        ax = Figure().subplots()
        report.draw(ax, section, kind)
        lines = {line.get_label(): line for line in ax.lines}
        assert lines["AVF-QPLEX"].get_xdata() == pytest.approx(range(1, 7))
        assert lines["AVF-QPLEX"].get_ydata() == pytest.approx([middle] * 6)
        heights = {round(float(line.get_ydata()[0]), 6) for line in ax.lines if len(line.get_ydata()) == 2}
        assert heights == {0.0, 0.5, 0.61}  # random, scripted, paper
        band = ax.collections[0].get_paths()[0].vertices[:, 1]
        assert (band.min(), band.max()) == pytest.approx((low, high), abs=1e-5)


def test_without_matplotlib_text_and_data_remain(runs, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(report.importlib.util, "find_spec", lambda name: None)
    text, output = make(tmp_path, runs)
    assert capsys.readouterr().err == "report: no figures; they need: pip install -e '.[report]'\n"
    assert ".png" not in text and {path.name for path in output.iterdir()} == {
        "README.md",
        "evaluations.csv",
        "runs.csv",
    }


# The command line


def test_bad_input_is_one_line(runs, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.csv").write_text("algorithm,task\na,b\n")
    (tmp_path / "file").write_text("")
    shutil.copytree(next(runs.glob("wtd-s__*")), tmp_path / "one" / "run")
    (tmp_path / "cut").mkdir()
    write_run(tmp_path / "cut", avf_qplex, "wtd-s", 1, {1000: 0.0})
    for arguments, message in [
        ([tmp_path / "empty"], "no runs found in"),
        ([tmp_path / "nowhere"], "no runs found in"),
        ([tmp_path / "one", tmp_path / "nowhere"], "no runs found in"),
        ([tmp_path / "bad.csv"], "is damaged"),
        ([tmp_path / "cut"], "no finished run found"),
        ([tmp_path / "one", "--last", "0"], "--last must be at least 1, got 0"),
        ([tmp_path / "one", "-o", tmp_path / "file"], "cannot write to"),
        ([tmp_path / "one", "--references", tmp_path / "bad.csv"], "is damaged"),
    ]:
        with pytest.raises(SystemExit) as error:
            report.main(["-o", str(tmp_path / "out"), *map(str, arguments)])
        assert str(error.value).startswith("report: ") and message in str(error.value), arguments
        assert "\n" not in str(error.value)


def test_the_program(runs, tmp_path):
    _, output = make(tmp_path, runs)
    command = [
        sys.executable,
        ROOT / "benchmark" / "report.py",
        output / "evaluations.csv",
        "-o",
        "again",
        "--last",
        "2",
    ]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "again/README.md\n", "")
    assert "mean of its last 2 evaluations" in (tmp_path / "again" / "README.md").read_text()
