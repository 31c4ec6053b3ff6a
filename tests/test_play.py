"""play.py: what it records is what the environment did, what it prints is right, and its files are whole."""

import dataclasses
import importlib
import os
import re
import resource
import subprocess
import sys
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import envs
import play
from envs.box_pushing import PUSH, BoxPushing
from tests.recording import scripted

TINY = dict(
    num_envs=4,
    total_timesteps=1_200,
    learning_starts=200,
    train_frequency=100,
    batch_size=2,
    hidden_size=16,
    eval_frequency=400,
    eval_episodes=3,
)


def train(name, env_id, runs_dir, **changes):
    """The folder of a tiny run; options that the script does not have are left out."""
    script = importlib.import_module(name)
    args = script.parse_args([f"--env={env_id}"])
    options = {key: value for key, value in {**TINY, **changes}.items() if hasattr(args, key)}
    return script.train(dataclasses.replace(args, seed=3, runs_dir=str(runs_dir), **options))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return train("avf_qplex", "wtd-s", tmp_path_factory.mktemp("runs"))


@pytest.fixture
def brief(monkeypatch):
    """Episodes of twelve steps."""
    make = envs.make
    monkeypatch.setattr(envs, "make", lambda env_id, num_envs=1: make(env_id, num_envs, horizon=12))


def played(run, episodes=2, **options):
    script, args, learner, _ = play.load_run(run, "best")
    return play.watch(script, args, learner, episodes, seed=5, **options)[1].episode()


# ---- recording ------------------------------------------------------------------------------------------------------
def test_the_recording_of_a_scripted_episode_is_the_one_done_by_hand():
    recorder = scripted()
    episode = recorder.episode()
    pictures = [frame.convert("RGB").tobytes() for frame in recorder.frames]
    assert episode.bars(0) == [(0, 1, 7), (1, 2, 7), (2, 6, 0), (6, 7, 5), (7, 8, 7)]
    assert episode.bars(1) == [(0, 4, 1), (4, 5, 6), (5, 6, 6), (6, 7, 7), (7, 8, 7)]
    assert episode.rows() == [0, 1, 2, 4, 5, 6, 7]
    assert episode.running[3].tolist() == [0, 1] and episode.running[5].tolist() == [0, 6]
    np.testing.assert_allclose(episode.rewards, np.full(8, -0.1))
    assert episode.labels == [0, 1] and episode.names[0][7] == "Stay"
    assert len(pictures) == 9 and all(one != other for one, other in combinations(pictures, 2))
    # of environment 0, of the network's run before each step
    assert episode.utilities.shape == (8, 2, 8) and episode.utilities[5, 1].tolist() == (np.arange(16, 24) + 5).tolist()


def test_the_recorder_changes_nothing_and_agrees_with_the_masks_of_the_environment():
    plain, recorder = envs.make("wtd-t1", 3), play.Recorder(envs.make("wtd-t1", 3))
    _, infos = plain.reset(seed=1)
    recorder.reset(seed=1)
    assert recorder.num_envs == 3 and recorder.n_actions == plain.n_actions
    rng, chosen, running, rewards = np.random.default_rng(0), [], [], []
    over = np.zeros(3, bool)
    while not over[0]:
        actions = rng.integers(plain.n_actions, size=(3, 4))
        chosen.append(infos["macro_done"][0])
        obs, reward, *over, infos = plain.step(actions)
        over = over[0] | over[1]
        np.testing.assert_array_equal(recorder.step(actions)[0], obs)
        running.append(infos["macro_action"][0])
        rewards.append(reward[0])
    episode = recorder.episode()
    np.testing.assert_array_equal(episode.chosen, chosen)
    np.testing.assert_array_equal(episode.running, running)
    np.testing.assert_array_equal(episode.rewards, rewards)
    assert episode.utilities is None and episode.labels == [0, 1, 2, "A"]
    for agent in range(4):
        bars = episode.bars(agent)
        assert bars[0][0] == 0 and bars[-1][1] == len(rewards)
        assert all(one[1] == other[0] for one, other in pairwise(bars))
        for start, end, action in bars:
            assert chosen[start][agent] and not np.array(chosen)[start + 1 : end, agent].any()
            assert (np.array(running)[start:end, agent] == action).all()


@pytest.mark.slow
def test_watching_gives_the_results_of_the_script_and_its_first_episode(run, brief):
    script, args, learner, _ = play.load_run(run, "best")
    expected = script.evaluate(learner["agents"], envs.make(args.env, 4), args.gamma, 5)
    frames = []
    result, recorder = play.watch(script, args, learner, 4, 5, frames)
    episode = recorder.episode()
    for key, value in expected.items():
        np.testing.assert_allclose(result[key], value)
    assert len(episode.rewards) == expected["length"][0] == len(frames) - 1
    np.testing.assert_allclose(episode.rewards.sum(), expected["return"][0])
    assert not learner["agents"]._forward_hooks


def test_agents_choose_what_their_networks_find_best(run):
    episode = played(run)
    best = episode.utilities.argmax(2)
    assert len(set(best[episode.chosen].tolist())) > 1 and episode.meaning == "utility"
    np.testing.assert_array_equal(best[episode.chosen], episode.running[episode.chosen])
    assert np.isneginf(episode.utilities[:, 0, 3:]).all(), "a robot has three macro-actions"


@pytest.mark.parametrize("name", ["avf_qplex", "cen_maddrqn", "mac_iaicc"])
def test_what_cannot_be_started_is_neither_chosen_nor_shown(name, tmp_path, monkeypatch):
    """Here nobody can push but in every third step, and the environment refuses a choice that is not available."""

    def can_start(self):
        everything = np.tile(self.own_actions, (self.num_envs, 1, 1))
        everything[:, :, PUSH] &= self.elapsed[:, None] % 3 == 0
        return everything

    monkeypatch.setattr(BoxPushing, "_can_start", can_start)
    episode = played(train(name, "bp-10", tmp_path, total_timesteps=500))
    steps, agents = np.nonzero(episode.chosen)
    pushes = steps[episode.running[steps, agents] == PUSH]
    assert (pushes % 3 == 0).all() and (steps % 3 > 0).any()
    if name != "cen_maddrqn":
        nothing = 0.0 if name == "mac_iaicc" else -np.inf
        np.testing.assert_array_equal(episode.utilities[steps, agents, PUSH] == nothing, steps % 3 > 0)


# ---- rows -----------------------------------------------------------------------------------------------------------
def printed(lines):
    """What describe_rows says: of each row what stands left of the bar, of each agent and row what stands right."""
    halves = [line.split("|") for line in lines if "|" in line][1:]
    return [left.split() for left, _ in halves if left.strip()], [right.split() for _, right in halves]


def test_the_rows_of_a_scripted_episode_are_the_ones_done_by_hand():
    """Every reward is -0.1, times 10: a row of two steps has -1 - 0.9."""
    script, recorder = importlib.import_module("avf_qplex"), scripted()
    args = script.Args(env="bp-10", gamma=0.9, reward_scale=10.0)
    rows, agents = printed(play.describe_rows(script, args, recorder, 0, 7))
    assert rows == [
        ["0", "0", "1", "-1.0000", "0.9000"],
        ["1", "1", "1", "-1.0000", "0.9000"],
        ["2", "2", "2", "-1.9000", "0.8100"],
        ["3", "4", "1", "-1.0000", "0.9000"],
        ["4", "5", "1", "-1.0000", "0.9000"],
        ["5", "6", "1", "-1.0000", "0.9000"],
        ["6", "7", "1", "-1.0000", "0.9000"],  # cut off by the horizon, not terminal
        ["7", "8", "end"],
    ]
    assert [agent[:4] for agent in agents[:8] + agents[-2:]] == [
        ["0", "Stay", "0", "chosen"],
        ["1", "Go-to-Small-Box(1)", "0", "chosen"],
        ["0", "Stay", "1", "chosen"],
        ["1", "Go-to-Small-Box(1)", "0", "ongoing"],
        ["0", "Go-to-Small-Box(0)", "2", "chosen"],
        ["1", "Go-to-Small-Box(1)", "0", "ongoing"],
        ["0", "Go-to-Small-Box(0)", "2", "ongoing"],
        ["1", "Turn-right", "3", "chosen"],
        ["0", "-", "7", "free"],
        ["1", "-", "7", "free"],
    ]
    assert printed(play.describe_rows(script, args, recorder, 2, 3)) == (rows[2:4], agents[4:8])
    recorder.steps[-1] = recorder.steps[-1]._replace(terminated=np.array([True]))
    assert printed(play.describe_rows(script, args, recorder, 6, 6))[0] == [["6", "7", "1", "-1.0000", "0.0000"]]
    with pytest.raises(ValueError, match="the episode has rows 0 to 7"):
        play.describe_rows(script, args, recorder, 7, 8)


def test_what_an_agent_last_saw_stays_until_it_chooses():
    """Robot 0 waits for a tool, robot 1 is in the tool room from time 2 on, the arm has found tool 0 at time 6."""
    script, recorder = importlib.import_module("avf_qplex"), play.Recorder(envs.make("wtd-s", horizon=7))
    _, infos = recorder.reset(seed=0)
    for _ in range(7):
        _, _, _, _, infos = recorder.step(np.where(infos["macro_done"], [[2, 1, 3]], infos["macro_action"]))
    rows, agents = printed(play.describe_rows(script, script.Args(), recorder, 0, 5))
    assert [row[1] for row in rows] == ["0", "2", "3", "4", "5", "6"]
    nowhere, room = "0 0 0 1 0 0 0 0 0 0 0 0 0".split(), "0 1 0 0 0 0 0 0 0 0 0 0 0".split()
    assert (
        agents[12:]
        == [  # at time 5 and at time 6
            ["0", "Get-Tool", "0", "ongoing", *nowhere],
            ["1", "Go-TR", "4", "chosen", *room],
            ["A", "Search-Tool(0)", "0", "ongoing", *"00000"],
            ["0", "Get-Tool", "0", "ongoing", *nowhere],
            ["1", "Go-TR", "5", "chosen", *room[:11], "1", "0"],
            ["A", "Search-Tool(0)", "5", "chosen", *"10010"],
        ]
    )


def test_what_is_printed_is_what_is_sampled_for_learning():
    script, recorder = importlib.import_module("avf_qmix"), scripted()
    args = script.Args(env="bp-10")
    batch = script.make_batch([play.remember(script, args, recorder.steps)])
    rows, agents = printed(play.describe_rows(script, args, recorder, 0, 7))
    assert batch["valid"][0].tolist() == [True] * 7 + [False]
    np.testing.assert_allclose(batch["reward"][0, :7], [float(row[3]) for row in rows[:7]], atol=6e-5)
    np.testing.assert_allclose(batch["discount"][0, :7], [float(row[4]) for row in rows[:7]], atol=6e-5)
    assert batch["free"][0, :7].flatten().tolist() == [agent[3] == "chosen" for agent in agents[:14]]
    names = recorder.episode().names[0]
    assert batch["action"][0, :7].flatten().tolist() == [names.index(agent[1]) for agent in agents[:14]]


@pytest.mark.parametrize("env_id", ["bp-30", "wtd-t1", "ct-10"])
def test_rows_fit_a_terminal(env_id):
    script, recorder = importlib.import_module("avf_vdn"), play.Recorder(envs.make(env_id, horizon=30))
    recorder.reset(seed=1)
    for _ in range(30):
        recorder.step(np.ones((1, recorder.n_agents), int))
    lines = play.describe_rows(script, script.Args(env=env_id), recorder, 0, 3)
    assert max(map(len, lines)) <= 120 and not any(line.endswith("...") for line in lines)


def test_rows_of_odd_names_fit_a_terminal():
    script = importlib.import_module("avf_qplex")
    recorder = scripted()
    recorder.env.macro_action_names = [["", "-1", "A--B", "Wait-", "去工作室", "x" * 200, "-", "Stay"]] * 2
    lines = play.describe_rows(script, script.Args(env="bp-10"), recorder, 0, 3)
    assert max(map(len, lines)) == 120
    assert [line.split("|")[1].split()[:2] for line in lines[5:7]] == [["0", "Stay"], ["1", "-1"]]


# ---- the command line -----------------------------------------------------------------------------------------------
def test_what_is_printed(run, brief, capsys, monkeypatch):
    script, asked = importlib.import_module("avf_qplex"), []
    evaluate = script.evaluate

    def uneven(agents, env, gamma, seed):
        asked.append((env.num_envs, gamma, seed))
        return evaluate(agents, env, gamma, seed) | {"discounted_return": np.array([1.0, 2.0, 6.0])}

    monkeypatch.setattr(script, "evaluate", uneven)
    play.main([str(run), "--episodes=3", "--model=last"])
    play.main([str(run), "--episodes=3", "--seed=5"])
    gamma = play.load_run(run, "last")[1].gamma
    assert asked == [(3, gamma, 3), (3, gamma, 5)], "the seed of the run, or the one given"
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "wtd-s avf_qplex last model of step 1200: 3 greedy episodes"
    assert re.fullmatch(r"wtd-s avf_qplex best model of step (400|800|1200): 3 greedy episodes", lines[5])
    assert [line.split("  ")[0] for line in lines[1:5]] == ["return", "discounted return", "length", "success"]
    assert lines[2] == "discounted return     3.000 +- 1.528 (standard error)"
    assert lines[3] == "length               12.000 +- 0.000 (standard error)"


@pytest.mark.slow
def test_the_files_that_are_written(run, tmp_path, brief, capsys):
    gif, whole_png, part = tmp_path / "team.GIF", tmp_path / "team.png", tmp_path / "part.png"
    play.main([str(run), "--episodes=2", f"--gif={gif}", f"--timeline={whole_png}"])
    play.main([str(run), "--episodes=1", f"--timeline={part}", "--steps=0-12"])
    with Image.open(gif) as animation, Image.open(whole_png) as whole, Image.open(part) as enlarged:
        assert animation.n_frames == 13 and animation.format == "GIF"
        assert animation.size == Image.fromarray(envs.make("wtd-s")._draw(0)).size
        assert whole.format == enlarged.format == "PNG"
        assert whole.width == enlarged.width == 2000 and whole.height < enlarged.height
    assert sorted(path.name for path in tmp_path.iterdir()) == ["part.png", "team.GIF", "team.png"]


@pytest.mark.slow
def test_the_timeline_is_written_as_its_suffix_says(run, tmp_path, brief):
    svg, pdf = tmp_path / "team.SVG", tmp_path / "team.pdf"
    play.main([str(run), "--episodes=1", f"--timeline={svg}"])
    play.main([str(run), "--episodes=1", f"--timeline={pdf}", "--steps=0-12"])
    text = svg.read_text()
    assert "wtd-s, avf_qplex</text>" in text and "A greedy episode of 12 steps, " in text
    assert "Asynchronous: macro-actions end" in text and "<image" not in text
    assert pdf.read_bytes().startswith(b"%PDF")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["team.SVG", "team.pdf"]


@pytest.mark.slow
def test_matplotlib_is_imported_only_for_a_timeline_and_without_a_window_system():
    seen = "print([name in sys.modules for name in ('matplotlib', 'matplotlib.pyplot')])"
    command = [sys.executable, "-c", f"import sys; import play; {seen}; import timeline; {seen}"]
    program = subprocess.run(command, capture_output=True, text=True, cwd=Path(play.__file__).parent)
    assert program.stdout.splitlines() == ["[False, False]", "[True, False]"], program.stderr


@pytest.mark.slow
def test_a_reader_that_has_seen_enough_is_no_error(run):
    command = [sys.executable, play.__file__, str(run), "--episodes=1"]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    program.stdout.close()
    assert program.stderr.read() == "" and program.wait() == 0


@pytest.mark.slow
@pytest.mark.parametrize("name", play.SCRIPTS)
def test_every_script_can_be_watched(name, tmp_path, brief, capsys):
    folder = train(name, "bp-10", tmp_path, total_timesteps=600)
    play.main([str(folder), "--episodes=2", f"--timeline={tmp_path / 'team.png'}", "--steps=0-3", "--rows=0-1"])
    out = capsys.readouterr().out
    assert f"bp-10 {name} best model" in out and printed(out.splitlines())[0][0][:2] == ["0", "0"]
    assert (tmp_path / "team.png").exists()
    episode = played(folder, 1)
    if name == "cen_maddrqn":
        assert episode.utilities is None
    else:
        np.testing.assert_array_equal(episode.utilities.argmax(2)[episode.chosen], episode.running[episode.chosen])
    if name == "mac_iaicc":
        assert episode.meaning == "probability"
        np.testing.assert_allclose(episode.utilities.sum(2), 1, rtol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--episodes=0"], "--episodes must be from 1 to 100000, got 0"),
        (["--episodes=100001"], "--episodes must be from 1 to 100000, got 100001"),
        (["--episodes=many"], "argument --episodes: invalid int value: 'many'"),
        (["--seed=-1"], "--seed must not be negative, got -1"),
        (["--model=worst"], "invalid choice: 'worst'"),
        (["--render"], "unrecognized arguments: --render"),
        (["--rows=4"], "--rows must be two rows, the second not before the first, such as 0-8"),
        (["--rows=4-3"], "--rows must be two rows, the second not before the first, such as 0-8"),
        (["--rows=0-99"], "--rows 0-99 is out of range: the episode has rows 0 to "),
        (["--steps=0-4"], "--steps needs --timeline"),
        (["--timeline={}/team.png", "--steps=4"], "--steps must be two times, the second after the first"),
        (["--timeline={}/team.png", "--steps=4-4"], "--steps must be two times, the second after the first"),
        (["--timeline={}/team.png", "--steps=0-13"], "--steps 0-13 is out of range: the episode has 12 steps"),
        (["--timeline={}/team.jpg"], "cannot write .*jpg: it has to be a .png or .svg or .pdf file in a folder that"),
        (["--timeline={}/missing/team.pdf"], "cannot write .*team.pdf: it has to be a .png or .svg or .pdf file in a"),
        (["--gif={}/missing/team.gif"], "cannot write .*missing/team.gif: it has to be a .gif file in a folder that"),
    ],
)
def test_bad_options_end_with_one_line_and_leave_files_alone(run, tmp_path, brief, arguments, message):
    for name in ("team.png", "team.jpg"):
        (tmp_path / name).write_text("kept")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(SystemExit, match=f"^play: .*{message}") as error:
        play.main([str(run), "--episodes=1", *(argument.format(tmp_path) for argument in arguments)])
    assert "\n" not in str(error.value)
    assert sorted(tmp_path.iterdir()) == before and (tmp_path / "team.png").read_text() == "kept"


def test_a_write_that_fails_leaves_the_old_file(tmp_path):
    path = tmp_path / "team.png"
    path.write_text("kept")

    def broken(file):
        file.write(b"half")
        raise OSError("disk full")

    with pytest.raises(SystemExit, match=r"^play: cannot write .*team.png: disk full"):
        play.write(str(path), broken)

    def too_large(file):
        raise ValueError("Image size is too large")

    with pytest.raises(SystemExit, match=r"^play: cannot write .*team.png: Image size is too large"):
        play.write(str(path), too_large)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(SystemExit, match=r"^play: cannot write .*folder.png: "):
        play.write(str(tmp_path / "folder.png"), lambda file: file.write(b"whole"))
    assert sorted(file.name for file in tmp_path.iterdir()) == ["folder.png", "team.png"]
    assert path.read_text() == "kept"


# ---- what is not to be trusted --------------------------------------------------------------------------------------
@pytest.fixture
def refused(tmp_path):
    """Checks that play ends with one line, a regular expression, for a folder."""

    def check(message, folder=tmp_path, **options):
        with pytest.raises(SystemExit, match=f"^play: .*{message}") as error:
            play.load_run(folder, "best", **options)
        assert "\n" not in str(error.value) and "weights_only" not in str(error.value)

    return check


@pytest.fixture
def edit(run, tmp_path):
    """Writes the run's model with other content and other settings into tmp_path."""

    def write(settings=None, **content):
        saved = torch.load(run / "best.pt", weights_only=True)
        torch.save({**saved, "args": {**saved["args"], **(settings or {})}, **content}, tmp_path / "best.pt")

    return write


def test_folders_that_are_no_runs_end_with_one_line(run, tmp_path, refused):
    refused("there is no model .*missing/best.pt", tmp_path / "missing")
    refused("there is no model .*args.json/best.pt", run / "args.json")
    refused("there is no model .*best.pt")
    (tmp_path / "best.pt").mkdir()
    refused("there is no model .*best.pt")
    with pytest.raises(SystemExit, match=r"^play: there is no model .*last\.pt"):
        play.load_run(tmp_path, "last")


def test_a_pipe_in_place_of_a_model_is_not_waited_for(tmp_path, refused):
    os.mkfifo(tmp_path / "best.pt")
    refused("there is no model .*best.pt")


def test_damaged_models_end_with_one_line(run, tmp_path, refused):
    path, whole = tmp_path / "best.pt", (run / "best.pt").read_bytes()
    model = torch.load(run / "best.pt", weights_only=True)
    message = "best.pt is damaged, or not the model of a script"
    for content in (b"", b"half", whole[:-1], whole[: len(whole) // 2]):
        path.write_bytes(content)
        refused(message)
    weights = model["networks"]["agents.encoder.weight"].numpy().tobytes()
    flipped = bytearray(whole)
    flipped[whole.index(weights)] ^= 1
    path.write_bytes(flipped)
    refused(message)
    for content in ([1, 2], {}, {**model, "args": [1, 2]}, {**model, "networks": Path()}):
        torch.save(content, path)
        refused(message)
    torch.save(model, path, _use_new_zipfile_serialization=False)  # without checksums
    refused(message)


def test_a_model_file_runs_no_code_and_the_line_does_not_advise_to_let_it(tmp_path, refused, capfd):
    class Payload:
        def __reduce__(self):
            return print, ("it runs",)

    torch.save({"algorithm": Payload()}, tmp_path / "best.pt")
    refused("best.pt is damaged, or not the model of a script$")
    assert not capfd.readouterr().out


def test_a_module_that_a_model_names_is_imported_only_if_it_is_given(edit, tmp_path, refused, monkeypatch):
    package = tmp_path / "runs" / "evil"
    package.mkdir(parents=True)
    for name in ("__init__", "payload"):
        (package / f"{name}.py").write_text(f"from pathlib import Path\nPath({str(package / 'ran')!r}).touch()\n")
    with (package / "payload.py").open("a") as file:
        file.write("import envs\nenvs.register('mine', envs.Warehouse, layout='s')\n")
    monkeypatch.syspath_prepend(tmp_path)
    edit({"env": "runs.evil.payload:mine"})
    message = r"names a module, which is imported only if you add --env 'runs\.evil\.payload:mine'"
    refused(message)
    with pytest.raises(SystemExit, match=message):
        play.main([str(tmp_path)])
    refused("is of the task 'runs.evil.payload:mine', not of 'wtd-s'", env="wtd-s")
    refused("is of the task 'runs.evil.payload:mine', not of 'runs.evil:mine'", env="runs.evil:mine")
    refused("is of the task 'runs.evil.payload:mine', not of ''", env="")
    assert not (package / "ran").exists()
    edit({"env": ["runs.evil.payload:mine"]})
    refused("names a module")
    edit({"env": "runs.evil.payload:mine"}, algorithm="runs.evil.payload")
    refused("is of 'runs.evil.payload', which is none of avf_vdn avf_qmix")
    assert not (package / "ran").exists()
    edit({"env": "runs.evil.payload:mine"})
    assert play.load_run(tmp_path, "best", env="runs.evil.payload:mine")[1].env == "runs.evil.payload:mine"
    assert (package / "ran").exists()


def test_the_task_may_be_given_though_it_need_not(run, refused):
    assert play.load_run(run, "best", env="wtd-s")[1].env == "wtd-s"
    refused("best.pt is of the task 'wtd-s', not of 'wtd-d'", run, env="wtd-d")


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"env": "nowhere"}, "does not fit its settings: .*unknown environment 'nowhere'"),
        ({"env": None}, "does not fit its settings: .*unknown environment"),
        ({"env": "bp-10"}, "does not fit its settings: .*size mismatch"),
        ({"hidden_size": 32}, "does not fit its settings: .*size mismatch"),
        ({"hidden_size": 10**14}, "does not fit its settings: "),
        ({"hidden_size": "16"}, "does not fit its settings: "),
        ({"hidden_size": 16.5}, "does not fit its settings: "),
        ({"gamma": 1.5}, "does not fit its settings: .*--gamma must be from 0 to 1, got 1.5"),
        ({"gamma": float("nan")}, "does not fit its settings: .*--gamma must be"),
        ({"gamma": None}, "does not fit its settings: "),
        ({"depth": 3}, "is of another version of avf_qplex.py: .'depth'. differ$"),
        ({"\n": 3, "b": 4}, r"is of another version of avf_qplex.py: .'.n', 'b'. differ$"),
        ({3: 3}, "is of another version of avf_qplex.py: .'3'. differ$"),
    ],
)
def test_edited_settings_end_with_one_line(edit, refused, settings, message):
    edit(settings)
    refused(message)


def test_a_missing_setting_is_not_replaced_by_todays_default(run, tmp_path, refused):
    saved = torch.load(run / "best.pt", weights_only=True)
    for name in saved["args"]:
        others = {other: value for other, value in saved["args"].items() if other != name}
        torch.save({**saved, "args": others}, tmp_path / "best.pt")
        refused(f"is of another version of avf_qplex.py: .'{name}'. differ$")


def without(key, values):
    return {name: value for name, value in values.items() if name != key}


WEIGHT = "agents.encoder.weight"
EDITS = {  # of a model's networks
    "none": lambda networks: None,
    "a list": list,
    "a weight less": lambda networks: without(WEIGHT, networks),
    "a weight more": lambda networks: {**networks, "other": torch.zeros(3)},
    "a number for a weight": lambda networks: {**networks, WEIGHT: 3.0},
    "another shape": lambda networks: {**networks, WEIGHT: networks[WEIGHT][:, 1:]},
    "a number as a name": lambda networks: {**networks, 3: networks[WEIGHT]},
}


@pytest.mark.parametrize("change", EDITS)
def test_edited_networks_end_with_one_line(run, edit, refused, change):
    networks = torch.load(run / "best.pt", weights_only=True)["networks"]
    edit(networks=EDITS[change](networks))
    refused("best.pt does not fit its settings: ")


def test_a_model_that_lacks_a_part_ends_with_one_line(run, tmp_path, refused):
    saved = torch.load(run / "best.pt", weights_only=True)
    for key in ("algorithm", "args", "networks", "step"):
        torch.save(without(key, saved), tmp_path / "best.pt")
        refused("best.pt is damaged, or not the model of a script")


@pytest.mark.slow
@pytest.mark.parametrize("value", [None, [], "text", -1, 2.5, 10**30, float("inf"), {"a": 1}])
def test_whatever_a_setting_is_there_is_a_line_or_it_plays(run, edit, tmp_path, brief, capsys, value):
    """Few settings matter to a model that is watched. No value of any of them gives a traceback."""
    refused = set()
    for name in torch.load(run / "best.pt", weights_only=True)["args"]:
        edit({name: value})
        capsys.readouterr()
        try:
            play.main([str(tmp_path), "--episodes=1", "--rows=0-0"])
            assert "greedy episodes" in capsys.readouterr().out
        except SystemExit as error:
            refused.add(name)
            assert re.fullmatch("play: .*best.pt .*|play: wtd-s cannot be played: .*", str(error))
    assert {"env", "hidden_size"} <= refused


def test_weights_that_are_not_finite_and_doubles_play(run, edit, tmp_path, brief, capsys):
    networks = torch.load(run / "best.pt", weights_only=True)["networks"]
    for change in (lambda weight: weight * torch.nan, torch.Tensor.double):
        edit(networks={name: change(weight) for name, weight in networks.items()})
        play.main([str(tmp_path), "--episodes=1", f"--timeline={tmp_path / 'team.svg'}", "--steps=0-12"])
        assert "greedy episodes" in capsys.readouterr().out


def test_a_model_of_another_device_plays_on_the_cpu(edit, tmp_path):
    edit({"device": "cuda"})
    assert play.load_run(tmp_path, "best")[1].device == "cpu"


# ---- tasks of one's own, and disks ----------------------------------------------------------------------------------
def nothing(env, index):
    raise NotImplementedError


@pytest.mark.parametrize(
    "draws",
    [
        nothing,
        lambda env, index: None,
        lambda env, index: np.zeros((4, 4), np.uint8),
        lambda env, index: np.zeros((4, 4, 4), np.uint8),
        lambda env, index: np.zeros((4, 4, 3)),
        lambda env, index: np.zeros((0, 4, 3), np.uint8),
        lambda env, index: [[[0, 0, 0]]],
    ],
)
def test_a_task_that_draws_nothing_has_no_gif(run, tmp_path, brief, monkeypatch, draws):
    monkeypatch.setattr(envs.warehouse.Warehouse, "_draw", draws)
    with pytest.raises(SystemExit, match=r"^play: --gif: _draw of this task does not give a picture"):
        play.main([str(run), "--episodes=1", f"--gif={tmp_path / 'team.gif'}"])
    assert not list(tmp_path.iterdir())
    play.main([str(run), "--episodes=1"])


def test_pictures_that_no_gif_can_hold_end_with_one_line(run, tmp_path, brief, monkeypatch):
    def refused(draws, message):
        monkeypatch.setattr(envs.warehouse.Warehouse, "_draw", draws)
        with pytest.raises(SystemExit, match=f"^play: {message}") as error:
            play.main([str(run), "--episodes=1", f"--gif={tmp_path / 'team.gif'}"])
        assert "\n" not in str(error.value) and not list(tmp_path.iterdir())

    refused(
        lambda env, index: np.zeros((4, 4 + env.elapsed[index], 3), np.uint8), "--gif: the pictures of this task ha"
    )
    refused(lambda env, index: np.full((1, 70_000, 3), env.elapsed[index], np.uint8), "cannot write .*team.gif: .+")


def test_a_task_that_raises_ends_with_its_name(run, brief, monkeypatch):
    def broken(self):
        raise KeyError("marbles")

    monkeypatch.setattr(envs.warehouse.Warehouse, "_advance", broken)
    with pytest.raises(SystemExit, match=r"^play: wtd-s cannot be played: KeyError: 'marbles'$"):
        play.main([str(run), "--episodes=1"])


@pytest.mark.slow
def test_a_long_animation_is_cut_and_play_says_so(run, tmp_path, brief, capsys, monkeypatch):
    gif = tmp_path / "team.gif"
    monkeypatch.setattr(play, "MOST_FRAMES", 13)
    play.main([str(run), "--episodes=1", f"--gif={gif}"])
    assert "ends" not in capsys.readouterr().out
    monkeypatch.setattr(play, "MOST_FRAMES", 5)
    play.main([str(run), "--episodes=1", f"--gif={gif}"])
    assert f"{gif} ends at time 4 of 12, since a longer one would be too large" in capsys.readouterr().out
    with Image.open(gif) as animation:
        assert animation.n_frames == 5


def test_a_timeline_that_is_too_long_needs_steps(run, tmp_path, brief, monkeypatch):
    monkeypatch.setattr(play, "MOST_STEPS", 11)
    command = [str(run), "--episodes=1", f"--timeline={tmp_path / 'team.svg'}"]
    with pytest.raises(SystemExit, match=r"^play: --timeline can show 11 steps, the episode has 12: choose some with"):
        play.main(command)
    assert not list(tmp_path.iterdir())
    play.main([*command, "--steps=1-12"])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["team.gif", "team.png", "team.svg", "team.pdf"])
def test_a_full_disk_ends_with_one_line_and_leaves_nothing(run, tmp_path, brief, name):
    """Here files may have 1,000 bytes at most."""
    path = tmp_path / name
    path.write_text("kept")
    option = "--gif" if name == "team.gif" else "--timeline"
    _, most = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000, most))
    try:
        with pytest.raises(SystemExit, match=f"^play: cannot write .*{name}: .*File too large") as error:
            play.main([str(run), "--episodes=1", f"{option}={path}"])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
    assert "\n" not in str(error.value)
    assert [file.name for file in tmp_path.iterdir()] == [name] and path.read_text() == "kept"


def test_a_name_that_is_too_long_for_a_file_and_a_pipe_in_the_way(tmp_path):
    with pytest.raises(SystemExit, match=r"^play: cannot write .*File name too long"):
        play.write(str(tmp_path / f"{'x' * 249}.gif"), lambda file: file.write(b"whole"))
    os.mkfifo(tmp_path / "team.gif.new")
    play.write(str(tmp_path / "team.gif"), lambda file: file.write(b"whole"))
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("team.gif", b"whole")]


def test_a_folder_that_cannot_be_written_ends_with_one_line(tmp_path, monkeypatch):
    def read_only(self, missing_ok=False):
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "unlink", read_only)
    with pytest.raises(SystemExit, match=r"^play: cannot write .*team.gif: .*Permission denied"):
        play.write(str(tmp_path / "team.gif"), lambda file: None)


@pytest.mark.slow
def test_a_full_disk_behind_the_standard_output_ends_with_one_line(run):
    with open("/dev/full", "w") as full:
        command = [sys.executable, play.__file__, str(run), "--episodes=1"]
        program = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True)
    assert program.stderr == "play: [Errno 28] No space left on device\n" and program.returncode == 1
