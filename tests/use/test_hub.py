"""Models on the Hugging Face Hub: huggingface_hub itself, in processes of their own, against a small server."""

import base64
import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from fastapi import FastAPI, Request, Response

from pipeline.use.model import Octopi
from tests.checkpoints import contents
from tests.use.fake import running
from tests.use.shared import Made

NAME, COMMIT = "ann/touch", "c" * 40
COMMAND = "from pipeline.cli import main; main()"
READ = "import sys; from pipeline.use import folder, hub; folder.read_folder(hub.download(sys.argv[1]))"
"""What comes before the answer, without the libraries that an answer takes."""
Hub = tuple[Callable[..., str], dict[str, bytes], list[str]]


def serve_hub(files: dict[str, bytes], asked: list[str]) -> FastAPI:
    """One public repository, which the token `ann` may write."""
    app = FastAPI()

    @app.api_route("/{path:path}", methods=["GET", "HEAD", "POST"])
    async def reply(path: str, request: Request) -> Response:
        asked.append(path)
        lines = [json.loads(line) for line in (await request.body()).splitlines()]
        wrong = path.endswith("v2") or (lines and request.headers.get("authorization") != "Bearer ann")
        sums = {name: hashlib.sha1(content).hexdigest() for name, content in files.items()}
        told: object = {"id": NAME, "sha": COMMIT, "private": False, "url": f"{request.base_url}{NAME}"}
        if "/resolve/" in path:
            name = path.split(f"{COMMIT}/")[1]
            return Response(files[name], headers={"ETag": sums[name], "X-Repo-Commit": COMMIT})
        if "/tree/" in path:
            told = [{"type": "file", "path": name, "size": len(files[name]), "oid": sums[name]} for name in files]
        elif "/preupload/" in path:
            how = {"uploadMode": "regular", "shouldIgnore": False}
            told = {"files": [{"path": file["path"], **how} for file in lines[0]["files"]]}
        elif "/commit/" in path and not wrong:
            for line in lines:
                if line["key"] == "deletedFile":
                    del files[line["value"]["path"]]
                elif line["key"] == "file":
                    files[line["value"]["path"]] = base64.b64decode(line["value"]["content"])
            told = {"commitUrl": path, "commitOid": COMMIT}
        return Response(json.dumps(told), 403 if wrong else 200)

    return app


@pytest.fixture
def hub(made: Made, tmp_path: Path) -> Iterator[Hub]:
    """Runs the command where the language model lies; the Hub's files, of an earlier model; and what it was asked."""
    files, asked = {"language/adapter/old.json": b"{}"}, list[str]()
    with running(serve_hub(files, asked)) as port:
        own = {"HF_ENDPOINT": f"http://127.0.0.1:{port}", "HF_HOME": str(tmp_path), "HF_HUB_DISABLE_XET": "1"}

        def run(*words: str, code: str = COMMAND, status: int = 0, **more: str) -> str:
            line = [sys.executable, "-c", code, *words]
            where, told = made.folder.parents[1], {**os.environ, **own, "HF_HUB_OFFLINE": "0", **more}
            done = subprocess.run(line, cwd=where, env=told, text=True, capture_output=True, check=False)
            assert done.returncode == status, done.stderr
            return (done.stderr if status else done.stdout).strip()

        yield run, files, asked


def test_what_is_pushed_comes_back_and_answers_alike(made: Made, hub: Hub, files: list[Path], tmp_path: Path) -> None:
    run, there, asked = hub
    assert "language/connector.safetensors\n" in run("push", str(made.folder), NAME, "--dry-run")
    assert not asked
    run("push", str(made.folder), NAME, HF_TOKEN="ann")
    assert there == contents(made.folder), "what lay there is gone"
    question, name = ["Describe {tactile}.", str(files[0])], f"hf://{NAME}"
    ask = ["ask", *question, "--model"]
    expected = Octopi.from_pretrained(made.folder).ask(*question)
    assert run(*ask, f"{name}@v1") == expected
    asked.clear()
    assert run(*ask, f"{name}@v1", HF_HUB_OFFLINE="1") == expected, "of the cache"
    assert "HF_HUB_OFFLINE is set" in run(name, code=READ, HF_HUB_OFFLINE="1", status=1)
    assert f"{NAME}: holds no config.json" in run(*ask, NAME, status=1)
    assert not asked
    assert "no such model or revision" in run(f"{name}@v2", code=READ, status=1)
    there["language/connector.safetensors"] += b" "
    assert "connector.safetensors: differs" in run(name, code=READ, HF_HOME=str(tmp_path / "new"), status=1)


@pytest.mark.parametrize(
    ("options", "environment", "line"),
    [
        ([], {}, "there is no token"),
        ([], {"HF_TOKEN": "bob"}, "this token may not write"),
        (["--private"], {"HF_TOKEN": "ann"}, "is there already, and public"),
    ],
)
def test_what_is_not_pushed(options: list[str], environment: dict[str, str], line: str, made: Made, hub: Hub) -> None:
    said = hub[0]("push", str(made.folder), NAME, *options, status=1, **environment)
    assert said.startswith(f"octopi: {NAME}: {line}")
    assert "\n" not in said
