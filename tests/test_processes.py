"""What starts processes: Ctrl-C, launchers, kills, and work on many files here and on a local cluster of Ray's."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
import yaml

from pipeline.cli.reproduce import outdated
from pipeline.core.io import atomic_folder
from pipeline.core.runtime import cores
from pipeline.running.stage import stage
from pipeline.scales import compose, write_params
from tests.closure import ROOT
from tests.conftest import not_utf8, refused, wait_until_ended
from tests.project import ENVIRONMENT as USUAL

ENVIRONMENT = {**USUAL, "SHELL": "/bin/sh"}
CHAIN = """\
stages:
  first: {cmd: touch first.txt, outs: [first.txt]}
  slow: {cmd: python stages/slow.py, deps: [first.txt]}
"""
IMPORTING = "import pipeline\nprint('now', flush=True)\ntime.sleep(600)"
RUNNING = (
    "from pipeline.running.stage import stage\nwith stage('slow'):\n    print('now', flush=True)\n    time.sleep(600)"
)
WORKERS = "from pipeline.running.parallel import run_parallel\n"
SLEEPING = f"{WORKERS}print('now', flush=True)\nlist(run_parallel(time.sleep, [600] * 64, '', ''))"
# So much to hand over that a worker is always in the middle of it.
TELLING = (
    f"{WORKERS}for i, _ in enumerate(run_parallel(bytes, [1 << 22] * 9000, '', '')):\n    i or print('now', flush=True)"
)
STOPPED = "slow: stopped; finished stages stay, and `octopi repro` goes on from there"


def launch(folder: Path, *command: str, errors: int, **environment: str) -> subprocess.Popen[str]:
    """Start a command in a session of its own, as a terminal does."""
    return subprocess.Popen(
        command, cwd=folder, env={**ENVIRONMENT, **environment}, text=True,
        stdout=subprocess.PIPE, stderr=errors, start_new_session=True,
        # What a script starts in the background is born deaf to Ctrl-C, as this process then is.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def interrupted(folder: Path, *command: str) -> tuple[int, list[str]]:
    """Run a command, press Ctrl-C when `now` is printed, and give its status and the lines from there on."""
    process = launch(folder, *command, errors=subprocess.STDOUT)
    try:
        assert process.stdout
        while (line := process.stdout.readline()) != "now\n":
            assert line, "it ended"
        # As a terminal does it: to every process at once.
        os.killpg(process.pid, signal.SIGINT)
        lines = process.communicate(timeout=300)[0].splitlines()
        return process.returncode, lines
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize("body", [IMPORTING, RUNNING])
def test_ctrl_c_in_a_chain_is_one_line_and_what_is_finished_stays(here: Path, body: str) -> None:
    repository(here, CHAIN)
    (here / "stages").mkdir()
    (here / "stages/slow.py").write_text(f"import time\n{body}\n")
    assert interrupted(here, "octopi", "repro") == (130, [STOPPED])
    assert (here / "first.txt").exists()
    assert list(yaml.safe_load((here / "dvc.lock").read_text())["stages"]) == ["first"]
    _, lines = interrupted(here, "dvc", "repro")
    assert lines[0] == STOPPED
    assert [line.split(":")[0] for line in lines[1:]] == ["ERROR"], "DVC's own"


BRANCHES = """\
stages:
  first: {cmd: touch first, outs: [first]}
  align:
    matrix: {v: [a, b]}
    cmd: echo >> begun; touch ${item.v}; for i in $(seq 60); do [ -e a -a -e b ] && exit; sleep 1; done; exit 1
    deps: [first]
    outs: ['${item.v}']
  answer: {matrix: {v: [a, b]}, cmd: "cp ${item.v} ${item.v}2", deps: ["${item.v}"], outs: ["${item.v}2"]}
  last: {cmd: cat a2 b2 > last, deps: [a2, b2], outs: [last]}
"""
BROKEN = """\
stages:
  good: {cmd: "while [ ! -e failed ]; do sleep .1; done; touch good", outs: [good]}
  bad: {cmd: "touch bad; echo >> failed; echo bad: why; exit 3", outs: [bad]}
  last: {cmd: touch last, deps: [good, bad], outs: [last]}
"""


def repository(folder: Path, chain: str) -> None:
    (folder / "dvc.yaml").write_text(chain)
    subprocess.run(f"git init -q && '{sys.executable}' -m dvc init -q", shell=True, check=True, cwd=folder)


@pytest.mark.skipif(cores() < 2, reason="needs two cores")
def test_variants_run_side_by_side_and_all_is_in_the_lock(here: Path) -> None:
    """Each `align` waits for the other one: of DVC alone it would fail."""
    repository(here, BRANCHES)
    subprocess.run(["octopi", "repro"], env=ENVIRONMENT, check=True)
    locked = yaml.safe_load((here / "dvc.lock").read_text())["stages"]
    assert (here / "begun").read_text() == "\n\n", "once each"
    assert set(locked) == {"first", "align@a", "align@b", "answer@a", "answer@b", "last"}
    assert "up to date" in subprocess.check_output(["dvc", "status"], text=True, env=ENVIRONMENT)


@pytest.mark.skipif(cores() < 2, reason="needs two cores")
def test_a_stage_that_fails_runs_once_and_what_ran_beside_it_is_kept(here: Path) -> None:
    repository(here, BROKEN)
    ended = subprocess.run(["octopi", "repro"], env=ENVIRONMENT, text=True, capture_output=True, check=False)
    assert (ended.returncode, ended.stdout.splitlines()[-1], ended.stderr) == (255, "bad: why", "")
    assert (here / "failed").read_text() == "\n"
    assert list(yaml.safe_load((here / "dvc.lock").read_text())["stages"]) == ["good"]


SUBREAPER = 36
"""prctl(2)'s number of what has a process take the orphans of those that it started."""


@pytest.fixture
def unreaped() -> Iterator[list[psutil.Process]]:
    """As in many a container nobody reaps orphans, but for those in this list at the end."""
    orphans = list[psutil.Process]()
    if sys.platform == "linux":
        assert ctypes.CDLL(None).prctl(SUBREAPER, 1) == 0
    yield orphans
    if sys.platform == "linux":
        assert ctypes.CDLL(None).prctl(SUBREAPER, 0) == 0
        for orphan in orphans:
            with suppress(ChildProcessError):  # Its parent reaped it.
                os.waitpid(orphan.pid, 0)


@pytest.mark.skipif(cores() < 2, reason="needs two cores")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_chain_leaves_no_process_of_dvcs_and_goes_on(
    here: Path, number: signal.Signals, unreaped: list[psutil.Process]
) -> None:
    """As DVC, it leaves the stage, which may be at its end."""
    repository(here, CHAIN)
    (here / "stages").mkdir()
    (here / "stages/slow.py").write_text(f"import time\n{RUNNING}\n")
    process = launch(here, "octopi", "repro", errors=subprocess.DEVNULL)
    assert process.stdout
    while process.stdout.readline() != "now\n":
        pass
    children = psutil.Process(process.pid).children(recursive=True)
    living = [child for child in children if child.status() != psutil.STATUS_ZOMBIE]
    unreaped += living
    stage = [child for child in living if "stages/slow.py" in child.cmdline()[-1]]
    process.send_signal(number)
    process.wait()
    wait_until_ended(set(living) - set(stage))
    (here / "stages/slow.py").write_text("")
    subprocess.run(["octopi", "repro"], env=ENVIRONMENT, check=True)
    for left in stage:
        left.kill()


@pytest.mark.parametrize(
    ("name", "half", "line"),
    [
        (".dvc/tmp/rwlock", "{", "'.dvc/tmp/rwlock'. JSON structure is corrupted; delete it"),
        ("dvc.lock", "stages: {", "`git checkout dvc.lock` brings back Git's"),
    ],
)
def test_half_a_file_of_dvcs_is_one_line(here: Path, name: str, half: str, line: str) -> None:
    """As a kill leaves it in the middle of writing."""
    repository(here, "stages: {first: {cmd: 'true'}}")
    (here / name).write_text(half)
    with refused(line):
        outdated(here)


@pytest.mark.skipif(cores() < 2, reason="needs two cores")
def test_a_killed_process_of_dvcs_is_one_line(here: Path) -> None:
    repository(here, "stages: {first: {cmd: kill -9 $PPID}, second: {cmd: 'true'}}")
    ended = subprocess.run(["octopi", "repro"], env=ENVIRONMENT, text=True, capture_output=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.splitlines()[-1].endswith("killed; finished stages stay, call `octopi repro` again")
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("body", [SLEEPING, TELLING])
def test_ctrl_c_ends_the_processes_of_a_stage(tmp_path: Path, body: str) -> None:
    (tmp_path / "stages").mkdir()
    (tmp_path / "stages/slow.py").write_text(f"import time\n{body}\n")
    assert interrupted(tmp_path, sys.executable, "stages/slow.py") == (130, [STOPPED])


@pytest.mark.parametrize(("end", "status"), [("", 0), ("raise UserError('no')", 1), ("1 / 0", 1), ("sys.exit(3)", 3)])
def test_a_stage_ends_at_once_where_it_ended_well(here: Path, end: str, status: int) -> None:
    """What libraries do at the end is done, what was printed is shown, and another end keeps its status."""
    code = "import atexit, sys\nfrom pipeline.running.errors import UserError\n"
    code += "from pipeline.running.stage import stage\nclass Late:\n    def __del__(self): print('apart')\n"
    code += "late = Late()\natexit.register(print, 'library')\n"
    (here / "stages").mkdir()
    (here / "stages/slow.py").write_text(f"{code}with stage('slow'):\n    print('body')\n    {end}\n")
    command = [sys.executable, "stages/slow.py"]
    done = subprocess.run(command, env=ENVIRONMENT, text=True, capture_output=True, check=False)
    assert done.returncode == status, done.stderr
    said = [line for line in done.stdout.splitlines() if not line.startswith("slow: ")]
    assert said == ["body", "library", *(["apart"] if status else [])]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_no_worker_outlives_its_parent(tmp_path: Path, number: signal.Signals) -> None:
    parent = launch(tmp_path, sys.executable, "-c", f"import time\n{SLEEPING}", errors=subprocess.DEVNULL)
    while not (workers := psutil.Process(parent.pid).children(recursive=True)):
        time.sleep(0.05)
    parent.send_signal(number)
    wait_until_ended(workers)
    parent.kill()
    parent.wait()


@pytest.mark.parametrize("code", ["import torch; limit_threads(1)", "limit_threads(1); import torch"])
def test_threads_are_limited_before_and_after_torch_is_imported(code: str) -> None:
    """Some stages import it when they need it."""
    code = f"from pipeline.core.runtime import limit_threads; {code}; print(torch.get_num_threads())"
    environment = {**ENVIRONMENT, "OMP_NUM_THREADS": "2"}
    assert subprocess.check_output([sys.executable, "-c", code], text=True, env=environment) == "1\n"


def test_a_stage_runs_the_code_beside_it_or_refuses(tmp_path: Path) -> None:
    """Whichever environment is active, since dvc.lock records what lies in the project's folder."""
    clone, linked = tmp_path / "another clone", tmp_path / "linked clone"
    for part in ("pipeline", "stages", "conf"):
        shutil.copytree(ROOT / part, clone / part, ignore=shutil.ignore_patterns("__pycache__", "pretrained"))
    shutil.copy(ROOT / "dvc.yaml", clone)
    write_params(compose("smoke", conf=ROOT / "conf"), clone / "params.yaml")
    linked.symlink_to(clone)

    other = f"split: {ROOT / 'pipeline'} would run, but dvc.lock records {clone / 'pipeline'}"
    for folder, code, started, stopped in (
        (clone, ROOT, "", other),
        (linked, ROOT, "", other),
        (clone, linked, "split: starts (smoke-scenes)\n", "data/videos.parquet: no such file"),
        (linked, clone, "split: starts (smoke-scenes)\n", "data/videos.parquet: no such file"),
    ):
        command, environment = [sys.executable, "stages/split.py"], {**ENVIRONMENT, "PYTHONPATH": str(code)}
        done = subprocess.run(command, cwd=folder, env=environment, text=True, capture_output=True, check=False)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, started, 1)
        assert stopped in done.stderr


STARTED = """
import os, sys, time
from pathlib import Path
from pipeline.running.errors import UserError
from pipeline.running.stage import stage
with stage("align", "x", launched=True) as run:
    Path("started").write_text(str(os.getpid()))
    while sys.argv[1] == "waits":
        time.sleep(0.1)
    from accelerate import Accelerator
    from pipeline.training.trainer import check_accelerate
    print("computes in", Accelerator().mixed_precision)
    check_accelerate()
    if sys.argv[1] == "fails":
        raise UserError("no such thing")
"""


SHIPPED = compose("paper-7b", conf=ROOT / "conf").runtime.launcher


def started(here: Path, launcher: str, what: str) -> subprocess.Popen[str]:
    """A stage that is started as DVC starts it, where the user's own configuration of accelerate says bfloat16."""
    (here / "stage.py").write_text(STARTED)
    (here / "conf").symlink_to(ROOT / "conf")
    own = {"compute_environment": "LOCAL_MACHINE", "distributed_type": "NO", "mixed_precision": "bf16"}
    (here / "home" / "accelerate").mkdir(parents=True)
    (here / "home" / "accelerate" / "default_config.yaml").write_text(yaml.safe_dump(own | {"num_processes": 1}))
    (here / "two.yaml").write_text(yaml.safe_dump(own | {"distributed_type": "MULTI_CPU", "num_processes": 2}))
    write_params(compose("smoke", [f"runtime.launcher={launcher}"], conf=ROOT / "conf"), here / "params.yaml")
    return launch(here, "python", "stage.py", what, errors=subprocess.PIPE, HF_HOME=str(here / "home"))


@pytest.mark.parametrize(
    ("launcher", "line"),
    [
        (SHIPPED, "no such thing\n"),
        ("accelerate launch -q --num_processes 1", "runtime.launcher: ACCELERATE_MIXED_PRECISION is bf16, which"),
        ("nowhere", "runtime.launcher: nowhere: No such file or directory; set it to python\n"),
    ],
)
def test_a_stage_starts_itself_by_the_launcher(here: Path, launcher: str, line: str) -> None:
    """With its status and one line. The configuration that comes along keeps the user's own out."""
    process = started(here, launcher, "fails")
    output, errors = process.communicate(timeout=300)
    assert process.returncode == 1
    assert errors.startswith(f"align@x: {line}")
    assert errors.count("\n") == 1
    if launcher == SHIPPED:
        assert "computes in no\n" in output
        assert int((here / "started").read_text()) != process.pid


@pytest.mark.parametrize(
    ("launcher", "number"),
    [(SHIPPED, signal.SIGINT), ("accelerate launch --cpu --config_file two.yaml", signal.SIGKILL)],
)
def test_a_stage_that_is_ended_leaves_no_process(here: Path, launcher: str, number: signal.Signals) -> None:
    process = started(here, launcher, "waits")
    file = here / "started"
    while process.poll() is None and not (file.exists() and file.read_text()):
        time.sleep(0.1)
    children = psutil.Process(process.pid).children(recursive=True)
    assert int(file.read_text()) in {child.pid for child in children}
    process.send_signal(number)
    process.communicate(timeout=300)
    assert process.returncode != 0
    assert psutil.wait_procs(children, timeout=300)[1] == []


def test_a_stage_removes_what_killed_ones_were_writing(here: Path) -> None:
    (ended := subprocess.Popen([sys.executable, "-c", ""])).wait()
    rests, kept = list[Path](), list[Path]()
    for folder in ("data", "data/encoder/0", "reports/smoke-scenes/figures", "models", "runs"):
        (here / folder).mkdir(parents=True, exist_ok=True)
        rests += [here / folder / f".{name}" for name in (f"b.npy.{ended.pid}.part", f"c.{ended.pid}.part.mp4")]
        # A living process's, and what is none.
        kept += [here / folder / name for name in (f".x.{os.getpid()}.part", ".frames.part", f"x.{ended.pid}.csv")]
    for file in (*rests, *kept):
        file.touch()
    (here / "models" / f".d.{ended.pid}.part" / "within").mkdir(parents=True)
    with stage("grade"):
        assert not [rest for rest in (*rests, here / "models" / f".d.{ended.pid}.part") if rest.exists()]
    assert all(file.exists() for file in kept)


def test_a_folder_that_was_killed_is_made_anew_and_one_in_the_making_left_alone(tmp_path: Path) -> None:
    kill = "import os; from pathlib import Path; from pipeline.core.io import atomic_folder"
    kill += "; making = atomic_folder(Path('[a]')); (making.__enter__() / 'half').touch(); os.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", kill], cwd=tmp_path, env=ENVIRONMENT, check=False).returncode == -9
    (rest,) = tmp_path.iterdir()
    living, other = tmp_path / f".[a].{os.getppid()}.part", rest.with_name(rest.name.replace("[a]", "a"))
    living.mkdir()
    other.mkdir()
    with atomic_folder(tmp_path / "[a]") as made:
        (made / "whole").touch()
    assert set(tmp_path.iterdir()) == {tmp_path / "[a]", living, other}
    assert os.listdir(tmp_path / "[a]") == ["whole"]


def test_any_path_is_printed(tmp_path: Path) -> None:
    """On a terminal whose locale takes no bytes but UTF-8."""
    command = [sys.executable, "-c", "from pipeline.cli import main; main()", "data", "audit", not_utf8(tmp_path, "a?")]
    env = {**ENVIRONMENT, "PYTHONIOENCODING": "utf-8:strict"}
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (1, "")
    assert rf"{tmp_path}/a\udcff: no such folder" in done.stdout
    assert rf"{tmp_path}/a\udcff,no such folder" in (tmp_path / "audit.csv").read_text(encoding="utf-8")


SCRIPT = """
import os, sys, time
from pathlib import Path
os.environ.pop("OMP_NUM_THREADS", None)  # The tests' own.
import numpy
from threadpoolctl import threadpool_info
from pipeline.running import parallel
from pipeline.running.errors import UserError
from pipeline.running.parallel import run_parallel, use_backend

def fails(job):
    Path("last").write_text(str(job))
    # A thread of BLAS for each core in each worker, and they would wait for each other.
    assert {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"} == {1}
    if job == "refused":
        raise UserError("file 7 is broken; mend it")
    if job == "dies":
        os._exit(9)
    Path(f"{os.getpid()}.pid").touch()
    while len(list(Path().glob("*.pid"))) < 2:  # Else a quick worker might do all.
        time.sleep(0.01)
    return job, os.getpid()

def main():
    backend = sys.argv[1]
    parallel.cores = lambda: 2
    if backend == "ray":
        import ray
        ray.init(num_cpus=2, log_to_driver=False)
    use_backend(backend)
    jobs = list(range(70))
    results = list(run_parallel(fails, jobs, "numbers", "number"))
    assert [job for job, _ in results] == jobs
    workers = {pid for _, pid in results}
    assert len(workers) == 2 and os.getpid() not in workers, workers
    for bad in ("refused", "dies"):
        try:
            list(run_parallel(fails, ["good", bad], "numbers", "number"))
        except UserError as error:
            with open("said", "a") as stream:
                print(error, file=stream)

if __name__ == "__main__":
    main()
"""

MODELS = """
from pathlib import Path
from types import SimpleNamespace
import ray, torch
from pipeline.training.embeddings import EmbeddingStore
from pipeline.encoder.embed import EncoderSource, embed_videos
from pipeline.core.io import read_table
from pipeline.language import generate
from pipeline.running.parallel import use_backend
from pipeline.core.records import Encoder, Lora, Opd, Variant
from pipeline.videos.records import Assignment
from tests.use.shared import make

def main():
    ray.init(num_cpus=2, log_to_driver=False)
    torch.set_num_threads(1)
    made = make(Path.cwd(), Variant(Encoder.FINETUNED, Lora.WITH, Opd.ALL, 0))
    params, data = made.params, Path("data")
    state, catalogue = data / "encoder" / "0" / "encoder.safetensors", Path(params.data.catalogue)
    encoder = EncoderSource(params.encoder, "cpu", data / "frames", catalogue, state)
    parts = read_table(data / "splits" / "0.parquet", Assignment)
    here = embed_videos(encoder(), parts, encoder)
    source = generate.ModelSource(data / "models" / "with" / "finetuned-all-0", "llama", "float32", "none", "cpu")
    language = params.language.model_copy(update={"max_new_tokens": 12, "generation_batch_size": 8})
    store, model = EmbeddingStore(data / "embeddings" / "finetuned-0"), source()
    said = generate.answer(model, store, made.questions, Opd.ALL, language, params.frames.per_video, source)

    use_backend("ray")
    generate.greedy = None  # Not in this process.
    there = embed_videos(encoder()._replace(encoder=SimpleNamespace(dim=here[0].shape[1])), parts, encoder)
    assert torch.equal(here[0], there[0]) and here[1] == there[1]
    assert generate.answer(model, store, made.questions, Opd.ALL, language, params.frames.per_video, source) == said
    assert len(said) > 40 and len({p.outputs for p in said}) > 10

if __name__ == "__main__":
    main()
"""


def run_script(text: str, folder: Path, *arguments: str) -> None:
    (folder / "work.py").write_text(text)
    command, env = [sys.executable, "work.py", *arguments], {**ENVIRONMENT, "PYTHONWARNINGS": "ignore"}
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.parametrize("backend", ["processes", "ray"])
def test_two_workers_do_all_in_order_or_say_why_not_on_either_backend(backend: str, tmp_path: Path) -> None:
    run_script(SCRIPT, tmp_path, backend)
    refused, died = (tmp_path / "said").read_text().splitlines()
    assert refused == "file 7 is broken; mend it"
    assert died.startswith("numbers: a process died at dies; "), died
    # No worker outlives the work.
    wait_until_ended(p for p in psutil.process_iter(["cwd"]) if p.info["cwd"] == str(tmp_path))


def test_a_cluster_embeds_and_answers_to_the_same_bytes(tmp_path: Path) -> None:
    run_script(MODELS, tmp_path)
