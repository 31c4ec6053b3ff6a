"""Run folders, checkpoints and the command line of the scripts, in processes of their own where one is killed."""

import importlib
import json
import multiprocessing
import os
import re
import runpy
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import pytest
import torch

import avf_qplex
import envs
from avf_qplex import Args, load, parse_args, save, train
from tests.curves import scalars
from tests.short_runs import CHARTS, EVAL, REPLAY, SHORT, cut_episodes, short
from tests.sync import ROOT, SCRIPTS

TINY = {**SHORT, **REPLAY}
TASKS = dict(zip(SCRIPTS, ("ct-10", "bp-10", "wtd-s", "bp-10", "ct-10", "wtd-s"), strict=True))  # one for each script


def flags(options):
    return [f"--{key.replace('_', '-')}={value}" for key, value in options.items()]


def start(script, *arguments):
    """The script as a program in a process of its own, which buffers what it prints.

    Ctrl-C reaches it even if these tests run in the background of a shell, where programs inherit that it is ignored.
    """
    command = [sys.executable, str(ROOT / f"{script}.py"), *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    pipes = dict(stdout=subprocess.PIPE, stderr=subprocess.PIPE)

    def heed_ctrl_c():
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    return subprocess.Popen(command, cwd=ROOT, env=environment, text=True, preexec_fn=heed_ctrl_c, **pipes)


def run_as_program(monkeypatch, *arguments, script="avf_qplex"):
    """The script as a program in this process: the exit code, and what the interpreter would print at last."""
    monkeypatch.setattr(sys, "argv", [f"{script}.py", *map(str, arguments)])
    try:
        runpy.run_path(str(ROOT / f"{script}.py"), run_name="__main__")
        return 0, ""
    except SystemExit as stopped:
        return (stopped.code, "") if isinstance(stopped.code, int) else (1, str(stopped.code))


def one_line(text):
    return bool(text) and "\n" not in text.strip() and "Traceback" not in text


def wait_for(condition):
    for _ in range(2_400):
        if condition():
            return
        time.sleep(0.025)
    raise TimeoutError


def interrupt_at(monkeypatch, module, steps):
    """Ctrl-C arrives in this step of training. What was logged up to it is written."""
    act, writer_class = module.act, module.SummaryWriter
    taken = []
    writers = []

    def counted(*args):
        taken.extend([1] * (len(args) > 4))  # evaluation gives neither epsilon nor a generator
        if len(taken) == steps:
            writers[-1].close()
            raise KeyboardInterrupt
        return act(*args)

    def noted(*args, **kwargs):
        writers.append(writer_class(*args, **kwargs))
        return writers[-1]

    monkeypatch.setattr(module, "act", counted)
    monkeypatch.setattr(module, "SummaryWriter", noted)


def interrupted(monkeypatch, module, args, steps):
    """The folder of a run to which Ctrl-C comes in this step."""
    with monkeypatch.context() as patch:
        interrupt_at(patch, module, steps)
        with pytest.raises(KeyboardInterrupt):
            module.train(args)
    (folder,) = Path(args.runs_dir).iterdir()
    return folder


def resume(module, folder, *flags):
    """Goes on with a run, but not in the second in which it began: TensorBoard orders its files by the second."""
    began = max(int(path.name.split(".")[3]) for path in folder.glob("events.*"))
    wait_for(lambda: time.time() >= began + 1)
    assert module.train(module.parse_args([f"--resume={folder}", *flags])) == folder
    assert not (folder / "checkpoint.pt").exists()


def assert_same_run(one, other):
    """Every logged number and every weight of two run folders is the same."""
    expected, got = scalars(one), scalars(other)
    assert expected.keys() == got.keys()
    for tag in expected:
        assert got[tag] == expected[tag], tag
    for name in ("last.pt", "best.pt"):
        models = [torch.load(folder / name, weights_only=True) for folder in (one, other)]
        assert models[0]["step"] == models[1]["step"], name
        for key, value in models[0]["networks"].items():
            assert torch.equal(value, models[1]["networks"][key]), f"{name} {key}"


def reached(folder):
    """The step of a run's checkpoint."""
    return torch.load(folder / "checkpoint.pt", weights_only=True)["progress"][0]


# ---- killed, interrupted and resumed --------------------------------------------------------------------------------
def train_in_process(script, args):
    module = importlib.import_module(script)
    module.train(args)


@pytest.fixture(scope="module")
def processes():
    """Processes that begin with what takes long to import: PyTorch, and what its optimisers import at first use."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch", "torch._dynamo", "torch.utils.tensorboard", "gymnasium", "tyro"])
    return context


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_killed_and_resumed_equals_undisturbed(tmp_path, processes, script):
    """With checkpoints at every step, so that the kill may come in the middle of one, too."""
    module = importlib.import_module(script)
    options = dict(seed=5, exploration_timesteps=200, total_timesteps=1_000, eval_frequency=200)
    undisturbed = module.train(short(module, TASKS[script], tmp_path / "whole", **options))
    args = short(module, TASKS[script], tmp_path / "cut", checkpoint_frequency=0.0, **options)
    process = processes.Process(target=train_in_process, args=(script, args))
    process.start()
    wait_for(lambda: any(tmp_path.glob("cut/*/last.pt")) or not process.is_alive())  # after the first evaluation
    process.kill()
    process.join()
    (folder,) = (tmp_path / "cut").iterdir()
    assert process.exitcode == -signal.SIGKILL and 0 < reached(folder) < 1_000, "the run was cut before its end"
    resume(module, folder)
    assert_same_run(undisturbed, folder)


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_interrupted_and_resumed_equals_undisturbed(tmp_path, monkeypatch, script):
    """Ctrl-C comes at step 520 of 700, the last checkpoint is of step 412, and episodes have ended in between.

    The clock moves on by a second whenever somebody looks at it, which is once a step, and once a checkpoint.
    """
    module = importlib.import_module(script)
    cut_episodes(monkeypatch, 17)
    options = dict(seed=0, exploration_timesteps=200, total_timesteps=700, eval_frequency=200, batch_size=13)
    undisturbed = module.train(short(module, TASKS[script], tmp_path / "whole", **options))
    args = short(module, TASKS[script], tmp_path / "cut", checkpoint_frequency=50.0, **options)
    seconds = iter(range(10_000))
    with monkeypatch.context() as patch:
        clock = types.SimpleNamespace(monotonic=lambda: next(seconds), time_ns=time.time_ns)
        patch.setattr(module, "time", clock)
        folder = interrupted(patch, module, args, steps=130)
    assert reached(folder) == 412
    saved = module.load(folder / "checkpoint.pt")
    assert saved["hidden"].any() and len(saved["buffer"]) > args.num_envs and any(map(len, saved["buffer"]))
    stale = scalars(folder)
    assert stale["charts/episodic_return"][-1][0] > 412, "what was logged after the checkpoint is dropped below"
    acted = []
    act = module.act

    def noted(agents, obs, infos, hidden, *others):
        acted.append(hidden)
        return act(agents, obs, infos, hidden, *others)

    with monkeypatch.context() as patch:
        patch.setattr(module, "act", noted)
        resume(module, folder)
    assert torch.equal(acted[0], saved["hidden"])
    assert_same_run(undisturbed, folder)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_program_that_is_stopped(tmp_path, monkeypatch, number):
    """Ctrl-C ends it with one line and code 130, SIGTERM ends it at once. The checkpoint is whole, and it can go on."""
    options = {**TINY, "runs_dir": tmp_path, "checkpoint_frequency": 0, "total_timesteps": 100_000}
    process = start("avf_vdn", "--env=bp-10", *flags(options))
    wait_for(lambda: any(tmp_path.glob("*/checkpoint.pt")) or process.poll() is not None)
    process.send_signal(number)
    printed, errors = process.communicate(timeout=60)
    (folder,) = tmp_path.iterdir()
    said = [line for line in errors.splitlines() if not line.startswith("step ")]  # but for evaluations
    assert printed == f"{folder}\n", "it is shown at once"
    if number == signal.SIGINT:
        assert process.returncode == 130
        assert said == ["stopped; --resume with its folder goes on from its last checkpoint"]
    else:
        assert process.returncode == -signal.SIGTERM and not said
    saved = importlib.import_module("avf_vdn").load(folder / "checkpoint.pt")
    assert saved["progress"][0] >= 4 and saved["args"]["total_timesteps"] == 100_000


def test_there_is_a_checkpoint_from_the_first_step_on(tmp_path, monkeypatch):
    """Here Ctrl-C comes in the second step, and the run goes on as if nothing had happened."""
    cut_episodes(monkeypatch, 25)
    undisturbed = train(short(avf_qplex, "bp-10", tmp_path / "whole", total_timesteps=400))
    args = short(avf_qplex, "bp-10", tmp_path / "cut", total_timesteps=400)
    folder = interrupted(monkeypatch, avf_qplex, args, steps=2)
    assert reached(folder) == 4 and not (folder / "last.pt").exists()
    resume(avf_qplex, folder)
    assert_same_run(undisturbed, folder)


@pytest.mark.parametrize("script", SCRIPTS)
def test_a_checkpoint_holds_the_rows_that_were_written_alone(tmp_path, monkeypatch, script):
    """Not the whole buffer, in which a long episode has its room reserved."""
    module = importlib.import_module(script)
    cut_episodes(monkeypatch, 20_000)
    buffers = []
    buffer_class = getattr(module, "ReplayBuffer", None) or module.EpisodeBuffer
    begin_rows = buffer_class.begin_rows

    def spy_begin_rows(self, *args, **kwargs):
        buffers[:] = [self]
        begin_rows(self, *args, **kwargs)

    monkeypatch.setattr(buffer_class, "begin_rows", spy_begin_rows)
    args = short(module, "ct-10", tmp_path, checkpoint_frequency=0.0, eval_frequency=10**6)
    folder = interrupted(monkeypatch, module, args, steps=30)
    (buffer,) = buffers
    assert buffer.running.nbytes > 5_000_000 and buffer.running_rows.max() == 29
    assert (folder / "checkpoint.pt").stat().st_size < 1_000_000
    saved = module.load(folder / "checkpoint.pt")["buffer"]
    row = buffer.running.dtype.itemsize
    lengths = [*buffer.running_rows, *map(len, buffer.ended)]
    assert [len(rows) for rows in saved] == [row * length for length in lengths]


def test_a_kill_costs_at_most_a_minute(tmp_path, monkeypatch):
    """By default a checkpoint is written every minute, here by a clock that moves on by 7 s in each step.

    What was logged up to a checkpoint is written before it.
    """
    assert all(importlib.import_module(script).Args.checkpoint_frequency == 60 for script in SCRIPTS)
    seconds = [0.0]
    written = []
    act, save, flush = avf_qplex.act, avf_qplex.save, avf_qplex.SummaryWriter.flush

    def slow_act(*args):
        seconds[0] += 7.0 * (len(args) > 4)  # a step of training, not of evaluation
        return act(*args)

    def spy_save(path, *args, **content):
        written.append((seconds[0], path.name))
        save(path, *args, **content)

    def spy_flush(self):
        written.append((seconds[0], "log"))
        flush(self)

    clock = types.SimpleNamespace(monotonic=lambda: seconds[0], time_ns=time.time_ns)
    monkeypatch.setattr(avf_qplex, "time", clock)
    monkeypatch.setattr(avf_qplex, "act", slow_act)
    monkeypatch.setattr(avf_qplex, "save", spy_save)
    monkeypatch.setattr(avf_qplex.SummaryWriter, "flush", spy_flush)
    train(short(avf_qplex, "bp-10", tmp_path, total_timesteps=200))
    times = [7.0 + 63.0 * number for number in range(6)]  # 63 s are the first nine steps that take over 60 s
    assert written[:12] == [(time, name) for time in times for name in ("log", "checkpoint.pt")]
    assert all(name != "checkpoint.pt" for _, name in written[12:])


# ---- what a run leaves ----------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_a_finished_run(tmp_path, monkeypatch, capsys):
    """What it printed, what is in its folder, and that it cannot be resumed."""
    options = {**TINY, "seed": 3, "runs_dir": tmp_path, "checkpoint_frequency": 0.05}
    code, _ = run_as_program(monkeypatch, "--env=bp-10", *flags(options))
    printed = capsys.readouterr()
    (folder,) = tmp_path.iterdir()
    assert code == 0 and printed.out == f"{folder}\n" and folder.name.startswith("bp-10__avf_qplex__3__")
    assert "it/s" not in printed.err, "no progress bar where there is no terminal"
    assert re.findall(r"step (\d+): greedy return", printed.err) == ["400", "800", "1200"]
    names = {path.name.split(".tfevents")[0] for path in folder.iterdir()}
    assert names == {"args.json", "best.pt", "last.pt", "events.out"}
    saved = json.loads((folder / "args.json").read_text())
    assert saved.pop("algorithm") == "avf_qplex"
    args = short(avf_qplex, "bp-10", tmp_path, seed=3, checkpoint_frequency=0.05)
    assert Args(**saved) == args
    last, best, curve = load(folder / "last.pt"), load(folder / "best.pt"), scalars(folder)
    assert last["step"] == 1_200 and last["return"] == pytest.approx(curve["eval/return"][-1][1])
    assert best["return"] == pytest.approx(max(value for _, value in curve["eval/return"]), rel=1e-6)
    assert Args(**last["args"]) == Args(**best["args"]) == args
    code, message = run_as_program(monkeypatch, f"--resume={folder}")
    assert code == 1 and one_line(message) and message.startswith(f"{folder} has no checkpoint: it is finished")


def test_what_is_logged(tmp_path, monkeypatch):
    """Returns where episodes end, losses of one update in a hundred, evaluations at their time and at the end."""
    cut_episodes(monkeypatch, 25)
    options = dict(total_timesteps=1_230, num_envs=6, train_frequency=8, learning_starts=120, eval_frequency=500)
    run = train(short(avf_qplex, "wtd-s", tmp_path, batch_size=2, **options))
    curve = scalars(run)
    losses = {"losses/td_loss", "losses/q_values"}
    assert curve.keys() == CHARTS | EVAL | losses
    assert [step for step, _ in curve["charts/episodic_return"]] == list(range(150, 1_230, 150))
    for name in EVAL:
        assert [step for step, _ in curve[name]] == [504, 1_002, 1_230], name
    for name in losses:  # there is an update where a multiple of 8 is passed; 804 passes the hundredth
        assert [step for step, _ in curve[name]] == [804], name


def test_best_is_the_best_and_the_latest_of_equals(tmp_path, monkeypatch):
    returns = iter([1.0, 3.0, 2.0, 3.0, 0.5, 1.0])
    result = {"discounted_return": np.zeros(2), "length": np.ones(2), "success": np.zeros(2)}
    monkeypatch.setattr(avf_qplex, "evaluate", lambda *args: result | {"return": np.full(2, next(returns))})
    folder = train(short(avf_qplex, "wtd-s", tmp_path, eval_frequency=200))
    best, last = load(folder / "best.pt"), load(folder / "last.pt")
    assert (best["step"], best["return"]) == (800, 3.0) and (last["step"], last["return"]) == (1_200, 1.0)
    assert any(not torch.equal(value, last["networks"][key]) for key, value in best["networks"].items())


def test_the_best_model_outlives_a_resume(tmp_path, monkeypatch):
    returns = iter([3.0, 2.0, 1.0])
    result = {"discounted_return": np.zeros(2), "length": np.ones(2), "success": np.zeros(2)}
    monkeypatch.setattr(avf_qplex, "evaluate", lambda *args: result | {"return": np.full(2, next(returns))})
    args = short(avf_qplex, "bp-10", tmp_path, total_timesteps=300, eval_frequency=100, checkpoint_frequency=0.0)
    folder = interrupted(monkeypatch, avf_qplex, args, steps=30)
    resume(avf_qplex, folder)
    assert load(folder / "best.pt")["step"] == 100 and load(folder / "last.pt")["step"] == 300


def test_evaluations_are_seeded_freshly_and_apart_from_training(tmp_path, monkeypatch):
    """No two evaluations of a run have one seed, and no two runs either; the environments of training have another."""
    seeds = []
    reset = envs.MacroVectorEnv.reset

    def spy_reset(self, *, seed=None, options=None):
        seeds.extend([] if seed is None else [seed])
        return reset(self, seed=seed, options=options)

    cut_episodes(monkeypatch, 10)
    monkeypatch.setattr(envs.MacroVectorEnv, "reset", spy_reset)
    for script in ("avf_vdn", "mac_iaicc"):
        module = importlib.import_module(script)
        for seed in (0, 1):
            seeds.clear()
            module.train(short(module, "bp-10", tmp_path, seed=seed, total_timesteps=60, eval_frequency=20))
            state = np.random.SeedSequence(seed).generate_state(5, np.uint64).tolist()
            own = state[3:] if script == "avf_vdn" else state[2:4]  # of the environments and of the evaluations
            assert seeds == [own[0], own[1] + 20, own[1] + 40, own[1] + 60]


def test_runs_never_share_a_folder(tmp_path, monkeypatch):
    """Not even those of the same microsecond: of one seed the second is refused, and the first is left as it is."""
    cut_episodes(monkeypatch, 10)
    options = dict(total_timesteps=40)
    with monkeypatch.context() as patch:
        patch.setattr(avf_qplex, "time", types.SimpleNamespace(monotonic=time.monotonic, time_ns=lambda: 123_456))
        folder = train(short(avf_qplex, "bp-10", tmp_path, seed=1, **options))
        assert train(short(avf_qplex, "bp-10", tmp_path, seed=2, **options)) != folder
        before = {path.name: path.read_bytes() for path in folder.iterdir()}
        with pytest.raises(FileExistsError):  # which the program turns into one line
            train(short(avf_qplex, "bp-10", tmp_path, seed=1, **options))
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    runs = {train(short(avf_qplex, "bp-10", tmp_path, seed=1, **options)) for _ in range(3)}
    assert len(runs | {folder}) == 4


def test_a_task_in_a_module_of_its_own(tmp_path, monkeypatch):
    """It is found through --env module:id. A family's defaults are not for it, and no folder's name has a colon."""
    module = "import envs\nfrom envs.box_pushing import BoxPushing\n\nenvs.register('bp-mine', BoxPushing, grid=6)\n"
    (tmp_path / "my_module.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    assert parse_args(["--env=my_module:bp-mine"]) == Args(env="my_module:bp-mine")
    assert parse_args(["--env=bp-mine"]) == Args(env="bp-mine", **avf_qplex.DEFAULTS["bp-"])
    folder = train(short(avf_qplex, "my_module:bp-mine", tmp_path / "runs", total_timesteps=400))
    assert folder.name.startswith("my_module-bp-mine__avf_qplex__1__") and ":" not in folder.name
    assert load(folder / "last.pt")["args"]["env"] == "my_module:bp-mine"


# ---- the command line -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--gamma=1.5"], "--gamma must be from 0 to 1, got 1.5"),
        (["--end-e=-0.1"], "--end-e must be from 0 to 1, got -0.1"),
        (["--polyak=1.01"], "--polyak must be from 0 to 1, got 1.01"),
        (["--td-lambda=2"], "--td-lambda must be from 0 to 1, got 2.0"),
        (["--hysteresis=-1"], "--hysteresis must be from 0 to 1, got -1.0"),
        (["--learning-rate=nan"], "--learning-rate must be from 0 to 1, got nan"),
        (["--max-grad-norm=nan"], "--max-grad-norm must be from 0 to 1000000000000000, got nan"),
        (["--reward-scale=inf"], "--reward-scale must be from 0 to 1000000000000000, got inf"),
        (["--checkpoint-frequency=-inf"], "--checkpoint-frequency must be from 0 to 1000000000000000, got -inf"),
        (["--batch-size=0"], "--batch-size must be from 1 to 1000000000000000, got 0"),
        (["--seed=-1"], "--seed must be from 0 to 1000000000000000, got -1"),
        (["--learning-starts=-1"], "--learning-starts must be from 0 to 1000000000000000, got -1"),
        (["--resume=nowhere"], "nowhere has no checkpoint: it is finished, nothing to resume, or it is not a run"),
        (["--resume="], " has no checkpoint: it is finished, nothing to resume, or it is not a run"),
    ],
)
def test_bad_arguments_are_told_in_one_line(tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stopped:
        parse_args(arguments)
    assert message in str(stopped.value) and one_line(str(stopped.value))
    assert not any(tmp_path.iterdir()), "nothing was written"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--env=wtd-x"], "--env: unknown environment 'wtd-x' (did you mean 'wtd-t'?); valid ids: bp-10 bp-20"),
        (["--env=no_such_module:my-task"], "--env: No module named 'no_such_module'"),
        (["--env=envs:my-task"], "--env: unknown environment 'envs:my-task'"),
        (["--env="], "--env: unknown environment ''"),
        (["--num-envs=1000000000000000"], "--env: Unable to allocate"),
        (["--track", "--env=bp-10"], "--track: import of wandb halted"),
    ],
)
def test_what_fails_at_the_start_is_told_in_one_line(tmp_path, monkeypatch, arguments, message):
    monkeypatch.setitem(sys.modules, "wandb", None)  # as if it were not installed
    code, said = run_as_program(monkeypatch, f"--runs-dir={tmp_path}", *arguments)
    assert code == 1 and message in said and one_line(said)
    assert "--track" in arguments or not any(tmp_path.iterdir()), "nothing was written"


@pytest.mark.parametrize("more", [["--gamma=0.5"], ["--env=bp-10"], ["--track"], ["elsewhere"]])
def test_a_resumed_run_takes_no_other_flag(tmp_path, monkeypatch, more):
    folder = interrupted(monkeypatch, avf_qplex, short(avf_qplex, "bp-10", tmp_path), steps=2)
    with pytest.raises(SystemExit, match="no other flag can be given") as stopped:
        parse_args([f"--resume={folder}", *more])
    assert one_line(str(stopped.value))


@pytest.mark.parametrize("script", SCRIPTS)
def test_every_script_checks_its_numbers(script):
    module = importlib.import_module(script)
    fields = module.Args.__dataclass_fields__.values()
    numbers = {field.name: field.type for field in fields if field.type in (int, float)}
    assert len(numbers) > 15
    for name, kind in numbers.items():
        for value in [-2] if kind is int else [-2.0, float("nan"), float("inf")]:
            with pytest.raises(SystemExit, match=rf"--{name.replace('_', '-')} must be from [01] to \d+, got {value}"):
                module.Args(**{name: value})
        if kind is float:
            module.Args(**{name: 0.0})
    assert module.parse_args(["--seed=0"]) == module.Args(seed=0)


@pytest.mark.parametrize("script", SCRIPTS)
def test_tasks_have_the_values_of_the_family_in_which_they_are(script):
    module = importlib.import_module(script)
    for beginning, values in module.DEFAULTS.items():
        ids = [env_id for env_id in envs.IDS if env_id.startswith(beginning)]
        assert ids and all(module.parse_args([f"--env={i}"]) == module.Args(env=i, **values) for i in ids), beginning
    given = module.parse_args(["--env", "ct-10", "--gamma", "0.5", "--no-anneal-lr"])
    assert given == module.Args(**{"env": "ct-10", **module.DEFAULTS["ct-"], "gamma": 0.5, "anneal_lr": False})


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_help_says_what_each_setting_does_and_its_value_for_the_task(script, capsys):
    """The text of a setting is the comment behind it."""
    module = importlib.import_module(script)
    comments = re.findall(r"^    (\w+): .+? = .+?  # (.+)$", (ROOT / f"{script}.py").read_text(), re.M)
    assert [name for name, _ in comments] == list(module.Args.__dataclass_fields__)
    for env_id in ("bp-10", "wtd-s", "ct-10"):
        with pytest.raises(SystemExit) as stopped:
            module.parse_args(["--env", env_id, "--help"])
        text = "".join(capsys.readouterr().out.replace("│", " ").split())  # without the box and its line breaks
        args = module.parse_args(["--env", env_id])
        assert stopped.value.code == 0
        for name, comment in comments:
            value = getattr(args, name)
            assert f"--{name.replace('_', '-')}" in text, name
            assert f"{comment}(default:{value})".replace(" ", "") in text, name


def test_unknown_flags_and_values_are_refused(capsys):
    removed = ["--discount=step", "--window=8", "--learning-rate-end=0"]
    for argument in (*removed, "--gama=0.9", "--evaluate=x", "--device=abacus", "--batch-size=many", "bp-10"):
        with pytest.raises(SystemExit) as stopped:
            parse_args([argument])
        assert stopped.value.code == 2 and not capsys.readouterr().out


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_missing_gpu_is_told_in_one_line(tmp_path, monkeypatch, script):
    arguments = ["--device=cuda", f"--runs-dir={tmp_path}"]
    code, message = run_as_program(monkeypatch, *arguments, script=script)
    assert (code, message) == (1, "--device cuda: there is none") and not any(tmp_path.iterdir())


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    path = tmp_path / "file"
    path.write_text("kept")
    code, message = run_as_program(monkeypatch, f"--runs-dir={path}")
    assert code == 1 and one_line(message) and str(path) in message and path.read_text() == "kept"


def test_other_runs_and_damaged_checkpoints_are_refused(tmp_path, monkeypatch):
    """In one line each, and nothing is changed."""
    folder = interrupted(monkeypatch, avf_qplex, short(avf_qplex, "bp-10", tmp_path, total_timesteps=400), steps=3)
    path = folder / "checkpoint.pt"
    whole = path.read_bytes()
    args = load(path)["args"]

    def refused(content, message):
        path.write_bytes(content)
        code, said = run_as_program(monkeypatch, f"--resume={folder}")
        assert code == 1 and one_line(said) and said.startswith(message), said
        assert path.read_bytes() == content and not (folder / "last.pt").exists()

    def written(content):
        torch.save(content, path)
        return path.read_bytes()

    other = f"cannot read {path}: it is of avf_vdn, or of another version of avf_qplex"
    refused(written({"algorithm": "avf_vdn", "args": args}), other)
    version = f"cannot read {path}: it is of avf_qplex, or of another version of avf_qplex"
    refused(written({"algorithm": "avf_qplex", "args": args | {"window": 25}}), version)
    without_lambda = {name: value for name, value in args.items() if name != "td_lambda"}
    refused(written({"algorithm": "avf_qplex", "args": without_lambda}), version)
    of_something_else = written({"step": 3})
    middle = len(whole) // 2
    damaged = [whole[:1000], whole[:-100], whole[:middle] + bytes(2000), b"\x80", b"text\n", bytes(99), b""]
    for content in (of_something_else, *damaged):
        refused(content, f"cannot read {path}: ")
    path.write_bytes(whole)
    assert run_as_program(monkeypatch, f"--resume={folder}")[0] == 0


class Malicious:
    def __init__(self, victim):
        self.victim = victim

    def __reduce__(self):
        return Path.touch, (self.victim,)


def test_loading_runs_no_code(tmp_path):
    folder, victim = tmp_path / "run", tmp_path / "victim"
    folder.mkdir()
    content = {"algorithm": "avf_qplex", "args": {}, "buffer": Malicious(victim)}
    torch.save(content, folder / "checkpoint.pt")
    with pytest.raises(SystemExit) as stopped:
        parse_args([f"--resume={folder}"])
    assert one_line(str(stopped.value)) and "cannot read" in str(stopped.value) and not victim.exists()
    assert "trust" not in str(stopped.value), "torch advises to load it unsafely"
    torch.load(folder / "checkpoint.pt", weights_only=False)
    assert victim.exists(), "the file is as malicious as it looks"


def test_files_are_whole_or_not_there(tmp_path, monkeypatch):
    """A failure while writing leaves the old model or checkpoint whole, and no moment sees half of the new one."""
    path, args = tmp_path / "checkpoint.pt", Args()
    save(path, args, step=1)

    for error in (OSError("disk full"), RuntimeError("disk full\nin torch")):

        def broken(content, file, error=error):
            Path(file).write_bytes(b"half")
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(torch, "save", broken)
            with pytest.raises(SystemExit, match=r"cannot write .*checkpoint\.pt: disk full$"):
                save(path, args, step=2)
        assert os.listdir(tmp_path) == ["checkpoint.pt"], "half a file would keep the disk full"
    assert load(path)["step"] == 1 and Args(**load(path)["args"]) == args
    os.link(path, tmp_path / "old")  # the same file, which would change if it were written to
    save(path, args, step=3)
    assert load(path)["step"] == 3 and load(tmp_path / "old")["step"] == 1
    assert sorted(os.listdir(tmp_path)) == ["checkpoint.pt", "old"]


def test_a_flipped_bit_is_noticed(tmp_path):
    """Not one of these files is read as something else than what was written."""
    path = tmp_path / "last.pt"
    weights = torch.arange(3_000.0)
    save(path, Args(), weights=weights)
    whole = path.read_bytes()
    refused = 0
    for place in range(5, len(whole), 97):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 16]) + whole[place + 1 :])
        try:
            assert torch.equal(load(path)["weights"], weights), "it is outside of what is read"
        except SystemExit as stopped:
            assert one_line(str(stopped.code))
            refused += 1
    assert refused > 120


def edits(saved):
    """Checkpoints that somebody edited: without a field, or with one of another kind."""
    for name in saved:
        yield f"without {name}", {key: value for key, value in saved.items() if key != name}
    for name in saved.keys() - {"algorithm"}:
        yield f"{name} is a word", saved | {name: "word"}
        if name != "buffer":  # one without rows is read
            yield f"{name} is empty", saved | {name: {}}
    for name, value in (("gamma", "word"), ("env", 5), ("env", "no-such-task"), ("num_envs", 3), ("hidden_size", 8)):
        yield f"{name} = {value}", saved | {"args": saved["args"] | {name: value}}
    yield "other weights", saved | {"learner": {name: value[:1] for name, value in saved["learner"].items()}}
    yield "half a row", saved | {"buffer": [rows[:-1] for rows in saved["buffer"]]}


@pytest.mark.slow
@pytest.mark.parametrize("script", ["avf_qplex", "mac_iaicc"])
def test_an_edited_checkpoint_is_refused_in_one_line(tmp_path, monkeypatch, script):
    module = importlib.import_module(script)
    cut_episodes(monkeypatch, 25)
    folder = interrupted(monkeypatch, module, short(module, "bp-10", tmp_path, checkpoint_frequency=0.0), steps=30)
    path = folder / "checkpoint.pt"
    for what, content in edits(torch.load(path, weights_only=True)):
        torch.save(content, path)
        with pytest.raises(SystemExit) as stopped:
            module.train(module.parse_args([f"--resume={folder}"]))
            pytest.fail(f"goes on, {what}")
        assert one_line(str(stopped.value)), what


def test_a_task_that_changed_is_not_resumed(tmp_path, monkeypatch):
    """Neither one with other widths nor one with a shorter horizon, which the running episodes may not fit."""
    folder = interrupted(
        monkeypatch, avf_qplex, short(avf_qplex, "bp-10", tmp_path, checkpoint_frequency=0.0), steps=30
    )
    for task in (envs._TASKS["wtd-s"], (envs.BoxPushing, dict(grid=10, horizon=4), {})):
        monkeypatch.setitem(envs._TASKS, "bp-10", task)
        with pytest.raises(SystemExit, match=f"^cannot resume {folder}: ") as stopped:
            train(parse_args([f"--resume={folder}"]))
        assert one_line(str(stopped.value))


def test_an_empty_folder_name_is_the_current_folder(tmp_path, monkeypatch):
    """An empty --resume begins no new run."""
    cut_episodes(monkeypatch, 25)
    folder = interrupted(monkeypatch, avf_qplex, short(avf_qplex, "bp-10", tmp_path, total_timesteps=80), steps=2)
    monkeypatch.chdir(folder)
    train(parse_args(["--resume="]))
    assert not (folder / "checkpoint.pt").exists() and load(folder / "last.pt")["step"] == 80


def test_no_file_decides_which_module_is_imported(tmp_path, monkeypatch):
    """A task of one's own has to be named again to resume its run."""
    (tmp_path / "my_task.py").write_text("raise SystemExit('it was imported')\n")
    monkeypatch.syspath_prepend(tmp_path)
    folder = interrupted(monkeypatch, avf_qplex, short(avf_qplex, "bp-10", tmp_path / "runs"), steps=2)
    saved = torch.load(folder / "checkpoint.pt", weights_only=True)
    saved["args"]["env"] = "my_task:mine"
    torch.save(saved, folder / "checkpoint.pt")
    for more in ([], ["--env=bp-10"], ["--env=other_task:mine"]):
        code, said = run_as_program(monkeypatch, f"--resume={folder}", *more)
        assert code == 1 and one_line(said) and "a task of your own has to be: --env module:id" in said
    code, said = run_as_program(monkeypatch, f"--resume={folder}", "--env=my_task:mine")
    assert said == "--env: SystemExit: it was imported (in the import of 'my_task')"


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_gradient_that_is_not_finite_ends_the_run(tmp_path, monkeypatch, script):
    """It names the step. The models of the evaluation before are kept, and their weights are finite."""
    module = importlib.import_module(script)
    cut_episodes(monkeypatch, 25)
    steps = []
    make_batch = module.make_batch

    def spoiled(*args):
        steps.append(1)
        batch = make_batch(*args)
        if len(steps) == 5:
            batch["reward"] = batch["reward"] + torch.inf
        return batch

    monkeypatch.setattr(module, "make_batch", spoiled)
    with pytest.raises(SystemExit, match=r"^the gradient at step \d+ is not finite: .* keeps the models before it$"):
        module.train(short(module, "bp-10", tmp_path, eval_frequency=4))
    (folder,) = tmp_path.iterdir()
    for name in ("last.pt", "best.pt"):
        assert all(value.isfinite().all() for value in module.load(folder / name)["networks"].values())


SPOILED = """
import envs
from envs.box_pushing import BoxPushing


class Spoiled(BoxPushing):
    def _advance(self):
        rewards, terminations, ended, success = super()._advance()
        if self.num_envs > 1 and self.elapsed[1] == 7:  # not in evaluations
            rewards[1] = float("nan")
        return rewards, terminations, ended, success


envs.register("spoiled", Spoiled, grid=6)
"""


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_task_of_the_current_folder_that_goes_wrong_ends_the_run_in_one_line(tmp_path, monkeypatch, script):
    """The module is found there. The line names the environment and the step, and the last good model is kept."""
    (tmp_path / "spoiled_task.py").write_text(SPOILED)
    monkeypatch.chdir(tmp_path)
    module = importlib.import_module(script)
    options = {**SHORT, **(REPLAY if "buffer_size" in vars(module.Args) else {}), "eval_frequency": 12}
    arguments = flags({**options, "env": "spoiled_task:spoiled", "eval_episodes": 1, "runs_dir": tmp_path / "runs"})
    code, said = run_as_program(monkeypatch, *arguments, script=script)
    assert (code, said) == (1, "Spoiled._advance: rewards must be finite, got nan for environment 1 at step 7")
    (folder,) = (tmp_path / "runs").iterdir()
    assert module.load(folder / "last.pt")["step"] == 24


def test_a_task_carries_its_values(tmp_path, monkeypatch):
    """They stand between the script's own defaults and the command line. --help shows the values in force."""
    text = "import envs\nfrom envs.box_pushing import BoxPushing\n\n"
    text += "envs.register('with-values', BoxPushing, grid=6, defaults=dict(gamma=0.5, td_lambda=0.1, n_step=7))\n"
    (tmp_path / "module_with_values.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    env = "module_with_values:with-values"
    assert parse_args([f"--env={env}"]) == Args(env=env, gamma=0.5, td_lambda=0.1), "it has no n_step"
    assert parse_args([f"--env={env}", "--gamma=0.25"]) == Args(env=env, gamma=0.25, td_lambda=0.1)
    mac_iaicc = importlib.import_module("mac_iaicc")
    assert mac_iaicc.parse_args([f"--env={env}"]) == mac_iaicc.Args(env=env, gamma=0.5, n_step=7)


def test_track_copies_the_curves(tmp_path, monkeypatch):
    """With a stand-in for wandb, which is optional: what it is told, and the one line where it is missing."""
    calls = []
    module = types.ModuleType("wandb")
    module.init = lambda **options: calls.append(options)
    monkeypatch.setitem(sys.modules, "wandb", module)
    args = short(avf_qplex, "bp-10", tmp_path, track=True, total_timesteps=400)
    folder = interrupted(monkeypatch, avf_qplex, args, steps=10)
    resume(avf_qplex, folder)
    told, again = calls
    assert told["sync_tensorboard"] and told["config"]["track"] and told["config"]["env"] == "bp-10"
    assert told["id"] == told["name"] == again["id"] == folder.name and told["resume"] == again["resume"] == "allow"
    monkeypatch.setitem(sys.modules, "wandb", None)  # as if it were not installed
    code, message = run_as_program(monkeypatch, "--track", f"--runs-dir={tmp_path / 'other'}")
    assert code == 1 and one_line(message) and "wandb" in message
