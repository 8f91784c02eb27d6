"""The base models that the pipeline makes, made once and kept between runs of the tests."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from filelock import FileLock

from pipeline.core.io import fingerprint
from pipeline.weights.make import CATALOGUE, make
from tests.closure import ROOT


@cache
def model_folder(name: str) -> Path:
    """The folder of a base model, such as `smollm2` (a minute, and half a gigabyte) or `tiny-llama`; leave it as it is.

    It is kept in pytest's cache under a hash of the code that makes it and of the packages' versions.
    """
    key = fingerprint(ROOT / "pipeline" / "weights", ROOT / "requirements.lock", CATALOGUE)
    folder = ROOT / ".pytest_cache" / "weights" / key / name
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.with_suffix(".lock")):
        if not folder.is_dir():
            make(name, folder)
    return folder
