"""What is kept of runs: a row for each in runs.csv and its evaluations in evaluations.csv, both plain text.

KEY says which run it is. flags: those that differ from the script's defaults for the task, as "name=value name=value".
checksum: of the code that a run executes, because changed code makes another run (`checksum`). A script cannot tell its
own, so the sweep leaves ORIGIN beside its run folders; of a run that was started by hand it is not known, and empty.
"""

import ast
import contextlib
import csv
import fcntl
import hashlib
import importlib
import itertools
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from dataclasses import asdict, fields
from datetime import UTC, datetime
from pathlib import Path

import pandas as pd
from tensorboard.backend.event_processing.event_file_loader import LegacyEventFileLoader
from tensorboard.compat.proto.event_pb2 import SessionLog
from torch.backends.cpu import get_cpu_capability
from tqdm import tqdm

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmark" / "results"
ORIGIN = "origin.json"
KEY = ["algorithm", "env", "flags", "seed", "checksum"]
VALUES = ["return", "discounted_return", "length", "success"]
RUNS = "algorithm env variant seed flags commit checksum steps seconds processor date".split()
TABLES = {"runs.csv": RUNS, "evaluations.csv": [*KEY, "step", *VALUES]}


def scripts():
    """Names of the algorithm scripts."""
    return sorted(path.stem for path in ROOT.glob("*.py") if "\nALGORITHM = " in path.read_text())


def load_script(algorithm):
    """The module of a script. Raises ValueError for any other module: its name may come from a file."""
    if algorithm not in scripts():
        raise ValueError(f"{algorithm!r} is none of the scripts {' '.join(scripts())}")
    if str(ROOT) not in sys.path:
        sys.path.insert(0, str(ROOT))
    return importlib.import_module(algorithm)


def values_of(algorithm, env):
    """The values in force for a script on a task: {field of Args: value}. A task "module:id" is imported."""
    return asdict(load_script(algorithm).parse_args([f"--env={env}"]))


def flags_of(usual, arguments):
    """The flags that make a script's arguments, a dict, of the usual ones; without what has a column of its own."""
    usual = usual | {name: arguments.get(name) for name in ("algorithm", "env", "seed", "runs_dir")}
    return " ".join(f"{name}={value}" for name, value in arguments.items() if usual.get(name, ...) != value)


def syntax(path):
    """The syntax tree of a module, so without comments, and without docstrings."""
    tree = None
    while tree is None:
        with contextlib.suppress(SystemError):  # Python 3.11 cannot make trees in two threads at once
            tree = ast.parse(path.read_text())
    for node in ast.walk(tree):
        if isinstance(getattr(node, "body", None), list):
            texts = [part for part in node.body if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant)]
            node.body = [part for part in node.body if part not in texts]
    return tree


def checksum(algorithm, env):
    """Of all that a run executes, whatever its comments and docstrings say: the script, with the values in force on the
    task, the task's domain and keywords, and the modules that define it.

    These are the domain's, that of "module:id", and what they import from envs/, but for rendering.py, which draws. So
    a new task, or another value for another task, leaves the recorded runs what they are.
    """
    code = [repr(values_of(algorithm, env))]
    for node in syntax(ROOT / f"{algorithm}.py").body:
        if isinstance(node, ast.ClassDef) and node.name == "Args":  # its fields are among the values
            node.body = [part for part in node.body if not isinstance(part, ast.AnnAssign)]
        if not ast.unparse(node).startswith("DEFAULTS ="):
            code.append(ast.unparse(node))
    envs = importlib.import_module("envs")
    domain, keywords = envs._find(env)[:2]
    code.append(re.sub(r" at 0x\w+", "", repr((domain, keywords))))  # without the addresses of functions
    names = {domain.__module__, env.rpartition(":")[0] or domain.__module__}
    modules = {}
    todo = [Path(sys.modules[name].__file__) for name in names]
    while todo:
        path = todo.pop()
        if path not in modules and path.name != "rendering.py":
            modules[path] = ast.unparse(syntax(path))
            imports = " ".join(re.findall(r"^ *(?:from|import) envs\b.*", modules[path], re.M))
            files = [Path(envs.__file__).with_name(f"{word}.py") for word in re.findall(r"\w+", imports)]
            todo += filter(Path.exists, files)
    return hashlib.sha256("\n".join([*code, *sorted(modules.values())]).encode()).hexdigest()[:12]


def commit():
    """The commit that is checked out, with a + if tracked files were changed since; "" outside git."""
    command = "git describe --always --exclude='*' --dirty=+"  # by the shell: without a git it fails like any command
    return subprocess.run(command, shell=True, cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()


def processor():
    """This machine's processor and its vector instructions as torch uses them: with others it rounds differently."""
    about = Path("/proc/cpuinfo")  # of Linux, and without a name of some processors
    names = re.findall(r"model name\s*: (.*)", about.read_text()) if about.exists() else []
    return f"{names[0] if names else platform.processor()}, {get_cpu_capability()}"


def folder(text):
    """The path that a word of a command line names."""
    if not text:
        raise ValueError("an empty word, not a folder")
    return Path(text)


def make_folder(place):
    """Makes a folder, if it is not there; raises OSError if nothing can be written into it."""
    place.mkdir(parents=True, exist_ok=True)
    tempfile.TemporaryFile(dir=place).close()


def tell(line):
    """Prints a line to stderr. It may be closed, full or of a terminal that is gone: that is no reason to stop."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError):
            tqdm.write(line, sys.stderr)


def replace(path, write):
    """Lets `write` make a file beside the path and swaps: what fails or is killed leaves the old one."""
    new = Path(f"{path}.new")
    try:
        write(new)
        os.replace(new, path)
    finally:
        new.unlink(missing_ok=True)


def replace_text(path, text):
    """Writes a file of text as `replace` does."""
    replace(path, lambda new: new.write_text(text))


def describe(folder):
    """What run a folder is of: {column: value} of runs.csv, without steps, seconds and date."""
    arguments = json.loads((folder / "args.json").read_text())
    about = {name: str(arguments[name]) for name in ("algorithm", "env", "seed")}
    if (folder.parent / ORIGIN).exists():
        return about | json.loads((folder.parent / ORIGIN).read_text())
    script = load_script(about["algorithm"])
    usual = {field.name: field.default for field in fields(script.Args)}
    # A module that a file names is not imported, so the values of a task of one's own are flags
    if about["env"] in importlib.import_module("envs").IDS:
        usual = values_of(about["algorithm"], about["env"])
    flags = flags_of(usual, arguments)
    return about | {"flags": flags, "variant": flags, "checksum": "", "commit": "", "processor": ""}


def read_events(folder):
    """What a run logged: its evaluations, {step: {name: text}}, the seconds that it ran and when it began."""
    files = [list(LegacyEventFileLoader(str(path)).Load()) for path in folder.glob("events.out.tfevents.*")]
    files = sorted((events for events in files if events), key=lambda events: events[0].wall_time)
    points = {}
    for event in itertools.chain.from_iterable(files):
        if event.session_log.status == SessionLog.START:  # of a resumed run: from this step on replaces what was before
            points = {step: values for step, values in points.items() if step < event.step}
        for value in event.summary.value:
            if (name := value.tag.removeprefix("eval/")) in VALUES:
                points.setdefault(event.step, {})[name] = f"{value.simple_value:.7g}"  # the digits of a float32
    seconds = sum(max(event.wall_time for event in events) - events[0].wall_time for events in files)
    return points, seconds, files[0][0].wall_time if files else 0.0


def is_finished(folder):
    """Whether a run has come to its end: the last evaluation is made, and the checkpoint is removed after all else."""
    steps = json.loads((folder / "args.json").read_text())["total_timesteps"]
    return not (folder / "checkpoint.pt").exists() and max(read_events(folder)[0], default=0) >= steps


def read_folder(folder):
    """A run as it is kept: its row of runs.csv, a dict, and its rows of evaluations.csv, a DataFrame."""
    points, seconds, began = read_events(folder)
    run = describe(folder) | {"steps": str(max(points, default=0)), "seconds": f"{seconds:.0f}"}
    run["date"] = datetime.fromtimestamp(began, UTC).strftime("%F %T")
    rows = [{**run, "step": str(step), **points[step]} for step in sorted(points)]
    return run, pd.DataFrame(rows, columns=TABLES["evaluations.csv"]).fillna("")


def load(place):
    """The runs and the evaluations recorded in a folder: two DataFrames of text, empty where there is no file.

    Raises:
        OSError: a file cannot be read.
        ValueError: a file has other columns, or a line that is no row, such as the marks of a merge conflict.
    """
    tables = []
    for name, columns in TABLES.items():
        lines = [columns]
        if (place / name).exists():
            try:
                with open(place / name, newline="") as file:
                    lines = list(csv.reader(file, strict=True))
            except csv.Error as error:
                raise ValueError(f"{name}: {error}") from None
        if not lines or lines[0] != columns:
            raise ValueError(f"{name} must begin with the columns {','.join(columns)}")
        for number, line in enumerate(lines, 1):
            if len(line) != len(columns):
                raise ValueError(f"line {number} of {name} is no row of {len(columns)} columns: {','.join(line)[:40]}")
        tables.append(pd.DataFrame(lines[1:], columns=columns, dtype=str))
    return tables


def load_runs(place):
    """What `read_folder` returned of each run that is recorded in a folder."""
    runs, evaluations = load(place)
    found = dict(list(evaluations.groupby(KEY)))
    return [(run, found.get(tuple(run[name] for name in KEY), evaluations[:0])) for run in runs.to_dict("records")]


def add(place, run, evaluations):
    """Records what `read_folder` returned, whole or not at all; any number of processes may do so at once."""
    place.mkdir(parents=True, exist_ok=True)
    lock = os.open(place, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    try:
        runs, old = load(place)
        # runs.csv comes second: a run that is not in it counts as not recorded, and is replaced the next time
        for name, table, new in (("evaluations.csv", old, evaluations), ("runs.csv", runs, pd.DataFrame([run]))):
            same = (table[KEY] == [run[key] for key in KEY]).all(axis=1)
            table = pd.concat([table[~same], new])[TABLES[name]]
            replace_text(place / name, table.to_csv(index=False, lineterminator="\n"))
    finally:
        os.close(lock)
