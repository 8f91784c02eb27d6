"""Work on many files in processes of this machine and on a local cluster of Ray's: the same bytes come out.

That no worker outlives a parent that is killed is tests/videos/test_extract.py's.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import psutil
import pytest

from pipeline.core import parallel
from pipeline.core.errors import UserError
from pipeline.core.parallel import _loaded, use_backend
from pipeline.core.records import Encoder, Lora, Opd, Variant
from pipeline.core.stage import stage
from pipeline.encoder.embed import EncoderSource
from pipeline.scales import check_inputs, compose, write_params
from tests.closure import ROOT
from tests.conftest import wait_until_ended
from tests.use.shared import make

SCRIPT = """
import os, sys, time
from pathlib import Path
from pipeline.core import parallel
from pipeline.config import FramesConfig
from pipeline.core.errors import UserError
from pipeline.core.parallel import run_parallel, use_backend
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.frames.extract import extract_frames

def fails(job):
    Path("last").write_text(str(job))
    if job == "refused":
        raise UserError("file 7 is broken; mend it")
    if job == "dies":
        os._exit(9)
    Path(f"{os.getpid()}.pid").touch()
    while len(list(Path().glob("*.pid"))) < 2:  # Else a quick worker might do all.
        time.sleep(0.01)
    return job, os.getpid()

def main():
    backend, videos, catalogue = sys.argv[1:]
    parallel.cores = lambda: 2
    if backend == "ray":
        import ray
        ray.init(num_cpus=2, log_to_driver=False)
    use_backend(backend)
    extract_frames(Path(videos), load_catalogue(Path(catalogue)), FramesConfig(pixels=16), Path("out"), Path("partial"))
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
import os, sys
from pathlib import Path
import torch
from pipeline.core.embeddings import EmbeddingStore
from pipeline.encoder.embed import EncoderSource, embed_videos
from pipeline.core import parallel
from pipeline.core.io import read_table
from pipeline.language import generate
from pipeline.core.parallel import use_backend
from pipeline.core.records import Assignment, Encoder, Lora, Opd, Variant
from tests.use.shared import make

def main():
    parallel.cores = lambda: 2
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

    use_backend(sys.argv[1])
    generate.greedy = None  # Not in this process.
    there = embed_videos(encoder()._replace(encoder=None), parts, encoder)
    assert torch.equal(here[0], there[0]) and here[1] == there[1]
    assert generate.answer(model, store, made.questions, Opd.ALL, language, params.frames.per_video, source) == said
    assert len(said) > 40 and len({p.outputs for p in said}) > 10

if __name__ == "__main__":
    main()
"""


def run_script(text: str, folder: Path, *arguments: str) -> None:
    (folder / "work.py").write_text(text)
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    env = {**os.environ, "PYTHONPATH": path, "PYTHONWARNINGS": "ignore"}
    command = [sys.executable, "work.py", *arguments]
    done = subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


def work_on(backend: str, folder: Path, videos: Path) -> dict[str, str]:
    """The sha256 of each file that two workers make of the videos; what is said of bad jobs is checked here."""
    folder.mkdir()
    run_script(SCRIPT, folder, backend, str(videos), str(ROOT / "pipeline" / "physiclear"))
    refused, died = (folder / "said").read_text().splitlines()
    assert refused == "file 7 is broken; mend it"
    assert died.startswith("numbers: a process died at or soon after "), died
    assert died.endswith("Run again")
    # No worker outlives the work.
    wait_until_ended(p for p in psutil.process_iter(["cwd"]) if p.info["cwd"] == str(folder))
    return {f.name: hashlib.sha256(f.read_bytes()).hexdigest() for f in (folder / "out").iterdir()}


@pytest.fixture(scope="module")
def here(tiny_videos: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    return work_on("processes", tmp_path_factory.mktemp("work") / "here", tiny_videos)


needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="needs ray: pip install -e '.[ray]'")


def test_this_machines_processes_make_four_files(here: dict[str, str]) -> None:
    assert len(here) == 4


@needs_ray
def test_two_workers_of_a_cluster_make_the_same_bytes(here: dict[str, str], tiny_videos: Path, tmp_path: Path) -> None:
    assert work_on("ray", tmp_path / "there", tiny_videos) == here


@needs_ray
def test_a_cluster_embeds_and_answers_to_the_same_bytes(tmp_path: Path) -> None:
    run_script(MODELS, tmp_path, "ray")


def test_a_worker_that_outlives_a_stage_loads_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one behind RAY_ADDRESS may: what is trained later lies at the same place."""
    monkeypatch.chdir(tmp_path)
    made = make(tmp_path, Variant(Encoder.FINETUNED, Lora.WITH, Opd.ALL, 0))
    state, catalogue = Path("data/encoder/0/encoder.safetensors"), Path(made.params.data.catalogue)
    first = EncoderSource(made.params.encoder, "cpu", Path("data/frames"), catalogue, state, run=1.0)
    before = _loaded(first).encoder
    assert _loaded(replace(first)).encoder is before
    state.unlink()
    with pytest.raises(UserError, match="encoder.safetensors"):
        _loaded(replace(first, run=2.0))


def test_a_missing_package_is_one_line_before_anything_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    params = compose("smoke", ["runtime.parallel=ray"])
    monkeypatch.setattr(parallel, "find_spec", lambda _: None)
    message = r"\Aruntime\.parallel: ray takes the package ray: pip install -e '\.\[ray\]'\Z"
    with pytest.raises(UserError, match=message):
        check_inputs(params)
    with pytest.raises(UserError, match=message):
        use_backend("ray")


def test_a_stage_works_where_its_parameters_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(parallel, "_chosen", "processes")
    monkeypatch.setattr(parallel, "find_spec", lambda _: True)
    write_params(compose("smoke", ["runtime.parallel=ray"], ROOT / "conf"))
    with stage("x"):
        assert parallel._chosen == "ray"
