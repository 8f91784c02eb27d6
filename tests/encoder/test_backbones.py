"""Backbones: what they compute against timm's own features, what is tuned of them, and training above cached trunks."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

from pipeline.core.layout import PRETRAINED
from pipeline.core.records import Part
from pipeline.core.runtime import seed_everything
from pipeline.encoder import tuned
from pipeline.encoder.data import ClipDataset, EncoderData
from pipeline.encoder.embed import EncoderSource, Loaded, embed_videos
from pipeline.encoder.finetune import finetune, train_classifier, write_encoder_card
from pipeline.encoder.model import SideBySide, load_backbones
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.encoder.scene_encoder import SIDE
from pipeline.encoder.timm_backbone import TimmBackbone
from pipeline.encoder.tuned import TrunkDataset, run_trunks
from pipeline.report.provenance import encoder_words
from pipeline.training.embeddings import FLIPS
from pipeline.training.trainable import save_trainable, trainable_state
from pipeline.videos.frames.store import FrameStore
from pipeline.weights.backbones import BACKBONES, Backbone, backbone_files, check_encoder
from pipeline.weights.check import check_encoder_files
from tests.closure import ROOT
from tests.encoders import close, config, float64, training, write_frames, write_pretrained, write_timm

pytestmark = pytest.mark.usefixtures("elsewhere")

DEVICE = torch.device("cpu")
CLASSES = [3, 3, 3]
NETWORKS = {"test_efficientnet": 2, "test_resnet": 1, "test_convnext": 2, "test_vit": 3}
"""Tiny networks of timm's, and the stage at which they are read."""
SHALLOW = {"depth": 3, "embed_dim": 32, "num_heads": 2}


@pytest.fixture(scope="module", params=NETWORKS)
def network(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    return request.param, write_timm(tmp_path_factory.mktemp(request.param), request.param)


@pytest.fixture(scope="module")
def timm_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_timm(tmp_path_factory.mktemp("timm"))


def side_by_side(timm_folder: Path) -> SideBySide:
    encoder = base_encoder(config(timm_folder, "tuned", backbone=("timm",), feature_stage=2))
    assert isinstance(encoder, SideBySide)
    return encoder


def loaded(folder: Path, stage: int, *, tuned: bool = False) -> TimmBackbone:
    setting = config(folder, "tuned", backbone=("timm",), feature_stage=stage)
    (backbone,) = load_backbones(setting, tuned=tuned)
    assert isinstance(backbone, TimmBackbone)
    return backbone


def noise(side: int, count: int = 3, seed: int = 0) -> torch.Tensor:
    rng = np.random.default_rng(seed)
    return torch.from_numpy(rng.integers(0, 256, (count, side, side, 3), dtype=np.uint8))


def enlarged(frames: torch.Tensor, down: int, across: int) -> torch.Tensor:
    return frames.repeat_interleave(down, 1).repeat_interleave(across, 2)


def test_timm_features_are_mean_and_deviation_of_its_own_map(network: tuple[str, Path]) -> None:
    """Against `features_only`, timm's other way to the same map, and NumPy; the trunk and the stage make the same."""
    import timm

    name, folder = network
    stage = NETWORKS[name]
    backbone = loaded(folder, stage)
    form = timm.get_pretrained_cfg(name)
    side = form.input_size[-1] if form.fixed_input_size else 64
    frames = noise(side)
    mean, std = (torch.tensor(value)[:, None, None] for value in (form.mean, form.std))
    pixels = (frames.permute(0, 3, 1, 2) / 255 - mean) / std
    whole = timm.create_model(f"local-dir:{folder}", pretrained=True, features_only=True, out_indices=(stage,)).eval()
    with torch.no_grad():
        maps = float64(whole(pixels)[0])
        found, apart = backbone(frames, torch.zeros(3)), backbone.stage(backbone.trunk(frames))
    assert maps.shape[1] == whole.feature_info.channels()[0] == backbone.dim // 2
    assert len(set(maps.shape[2:])) == 1, "a square map"
    assert maps.shape[2] > 1
    close(found, np.concatenate([maps.mean((2, 3)), maps.std((2, 3))], axis=1), 1e-4)
    torch.testing.assert_close(apart, found, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("own", "told"), [((224, 224), True), ((224, 224), False), ((64, 96), False)])
def test_a_transformer_of_one_side_is_shown_means_over_areas(own: tuple[int, int], told: bool, tmp_path: Path) -> None:
    """Whether or not its configuration says that it takes no other side, and whatever side it was made for."""
    folder = write_timm(tmp_path, "vit_tiny_patch16_224", img_size=own, **SHALLOW)
    form = json.loads((folder / "config.json").read_text())
    assert form["pretrained_cfg"].pop("fixed_input_size")
    if not told:
        (folder / "config.json").write_text(json.dumps(form))
    backbone = loaded(folder, 2)

    # Two by two fields have the same means at every size, also where rows of pixels differ within an area.
    with torch.no_grad():
        expected = backbone(enlarged(noise(2) // 2 + 64, own[0] // 2, own[1] // 2), torch.zeros(3))
        for times, contrast in ((np.lcm(*own), 60), (16, 0), (50, 0)):
            frames = enlarged(noise(2) // 2 + 64, times, times)
            frames[:, ::2] += contrast
            frames[:, 1::2] -= contrast
            torch.testing.assert_close(backbone(frames, torch.zeros(3)), expected, rtol=1e-4, atol=1e-4)


def test_a_transformer_of_any_side_is_shown_whole_patches(tmp_path: Path) -> None:
    backbone = loaded(write_timm(tmp_path, "vit_tiny_patch16_224", dynamic_img_size=True, **SHALLOW), 2)
    frames, ragged = (enlarged(noise(2), n, n) for n in (24, 28))
    with torch.no_grad():
        torch.testing.assert_close(backbone(ragged, torch.zeros(3)), backbone(frames, torch.zeros(3)))


def test_scenes_sees_large_frames_as_it_was_pretrained() -> None:
    """A frame of twice its side, each pixel fourfold, is the frame; smaller ones are taken as they are."""
    model = write_pretrained()
    (backbone,) = load_backbones(config(Path("none"), "tuned"))
    frames = noise(SIDE, 2)
    with torch.no_grad():
        expected = model(frames, torch.zeros(2))
        assert torch.equal(backbone(frames, torch.zeros(2)), expected)
        torch.testing.assert_close(backbone(enlarged(frames, 2, 2), torch.zeros(2)), expected)
        small = model.layers((noise(32).permute(0, 3, 1, 2) - 128.0) / 24)
        torch.testing.assert_close(backbone(noise(32), torch.zeros(3))[:, :128], small.mean((2, 3)))


def test_several_backbones_stand_side_by_side_in_their_order(timm_folder: Path) -> None:
    write_pretrained()
    frames = noise(64)
    with torch.no_grad():
        for names in (("timm", "scenes"), ("scenes", "timm")):
            setting = config(timm_folder, "tuned", backbone=names, feature_stage=2)
            alone = [load_backbones(setting.model_copy(update={"backbone": (name,)}))[0] for name in names]
            expected = torch.cat([backbone(frames, torch.zeros(3)) for backbone in alone], dim=1)
            both = base_encoder(setting)
            assert isinstance(both, SideBySide)
            assert torch.equal(both(frames, torch.zeros(3)), expected)
            torch.testing.assert_close(both.stages(both.trunks(frames)), expected)
            assert both.dim == expected.shape[1]
            assert not any(p.requires_grad for p in both.parameters()), "the base is frozen"


def test_gradients_reach_the_last_stage_alone(network: tuple[str, Path]) -> None:
    name, folder = network
    backbone = loaded(folder, NETWORKS[name], tuned=True)
    backbone(noise(64), torch.zeros(3)).square().sum().backward()
    learnt = {id(p) for p in backbone.last.parameters()}
    assert learnt
    for parameter_name, parameter in backbone.named_parameters():
        assert (id(parameter) in learnt) == parameter.requires_grad == (parameter.grad is not None), parameter_name
    prefix = f"model.{backbone.info['module']}."
    assert all(key.startswith(prefix) for key in trainable_state(backbone))


@pytest.mark.slow
def test_training_above_trunks_trains_as_on_frames(timm_folder: Path, data: EncoderData, tmp_path: Path) -> None:
    """Two epochs, against the classifier on the frames themselves; each video has just the frames of a clip.

    Statistics of batch normalisation stay those of the pretraining.
    """
    write_pretrained()
    changes = {"backbone": ("timm", "scenes"), "feature_stage": 2, "epochs": 2, "batch_size": 2, "flip_probability": 0}
    setting, videos = config(timm_folder, "tuned", **changes), data.videos(Part.TRAIN) + data.videos(Part.VALIDATION)
    data = replace(data, store=FrameStore(write_frames(tmp_path / "two", {v.video_id: 2 for v in videos})))
    fresh, states = base_encoder(setting).state_dict(), []
    running = [name for name in fresh if "running" in name]
    assert {name[:11] for name in running} == {"backbones.0", "backbones.1"}
    for cached in (True, False):
        seed_everything(0)
        model = property_classifier(setting, CLASSES)
        trunks = run_trunks(model.encoder, data, videos, DEVICE, mirrored=False) if cached else None  # type: ignore[arg-type]
        train_classifier(model, training(data, setting), trunks)
        states.append(trainable_state(model))
        assert all(torch.equal(model.encoder.state_dict()[name], fresh[name]) for name in running)
    torch.testing.assert_close(states[0], states[1], rtol=1e-4, atol=1e-5)


def test_flips_are_drawn_by_seed_epoch_and_video(timm_folder: Path, data: EncoderData) -> None:
    videos, encoder = data.videos(Part.TRAIN), side_by_side(timm_folder)
    trunks = run_trunks(encoder, data, videos, DEVICE, mirrored=True)
    frames = ClipDataset(data.store, videos, per_video=2)[0]["frames"]
    with torch.no_grad():
        for flip, axes in {"none": [], "horizontal": [2], "vertical": [1], "both": [1, 2]}.items():
            (expected,), (found,) = encoder.trunks(frames.flip(axes)), trunks.of(videos[0].video_id, flip)  # type: ignore[arg-type]
            assert torch.equal(found, expected)

    def drawn(items: TrunkDataset) -> list[int]:
        shown = ((v.video_id, items[i]["outputs"]) for i, v in enumerate(videos))
        return [next(n for n, f in enumerate(FLIPS) if all(map(torch.equal, trunks.of(v, f), o))) for v, o in shown]

    items, epochs = TrunkDataset(trunks, videos, seed=3, flip_probability=0.5), []
    for epoch in range(80):
        items.epoch = epoch
        epochs.append(drawn(items))
    assert np.bincount(np.ravel(epochs), minlength=4).min() > 400 / 4 * 0.7
    assert len(set(map(tuple, epochs))) > 40
    assert not any(drawn(TrunkDataset(trunks, videos)))


def test_large_trunks_are_float16(timm_folder: Path, data: EncoderData, monkeypatch: pytest.MonkeyPatch) -> None:
    encoder, videos = side_by_side(timm_folder), data.videos(Part.TRAIN)
    exact = run_trunks(encoder, data, videos, DEVICE, mirrored=False)
    monkeypatch.setattr(tuned, "MEMORY", 0)
    short = run_trunks(encoder, data, videos, DEVICE, mirrored=False)
    for trunks, dtype in ((exact, torch.float32), (short, torch.float16)):
        assert {output.dtype for outputs in trunks.values() for output in outputs} == {dtype}
    with torch.no_grad():
        found, expected = (encoder.stages(trunks.of(videos[0].video_id)) for trunks in (short, exact))
    torch.testing.assert_close(found, expected, rtol=0, atol=2e-3 * float(expected.abs().max()))


def test_what_is_tuned_embeds_alike_from_its_file(timm_folder: Path, data: EncoderData, tmp_path: Path) -> None:
    """The file holds less than the network. What training never draws is not embedded."""
    write_pretrained()
    setting = config(timm_folder, "tuned", backbone=("timm", "scenes"), feature_stage=2)
    model = property_classifier(setting, data.classes).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.01 * parameter.requires_grad)
    save_trainable(model, tmp_path / "model.safetensors")
    kept = sum(value.numel() for value in trainable_state(model).values())
    assert kept < 0.9 * sum(p.numel() for p in model.parameters())
    shown = Loaded(model.encoder, FrameStore(tmp_path, "subtract"), DEVICE, 4)
    expected, mirrored = embed_videos(shown, data.assignments)
    catalogue, state = ROOT / "pipeline" / "physiclear", tmp_path / "model.safetensors"
    for probability in (0.5, 0.0):
        own = setting.model_copy(update={"flip_probability": probability})
        found, index = embed_videos(EncoderSource(own, "cpu", tmp_path, catalogue, state)(), data.assignments)
        rows = [row for row, entry in enumerate(mirrored) if probability or entry.flip == "none"]
        assert [(e.video_id, e.flip) for e in index] == [(mirrored[r].video_id, mirrored[r].flip) for r in rows]
        torch.testing.assert_close(found, expected[rows])


@pytest.mark.slow
def test_the_documented_backbone_works(data: EncoderData, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As it stands in docs/encoders.md, module and entry: it embeds, and trains beside another."""
    from transformers import Dinov2Config, Dinov2Model

    written, entry = (ROOT / "docs" / "encoders.md").read_text().split("```python\n")[1:3]
    dino = ModuleType("pipeline.encoder.dino")
    exec(written.split("```")[0], dino.__dict__)
    monkeypatch.setitem(sys.modules, dino.__name__, dino)
    for name, backbone in eval("{" + entry.split("```")[0] + "}", {"Backbone": Backbone}).items():
        monkeypatch.setitem(BACKBONES, name, backbone)
    sizes = Dinov2Config(hidden_size=12, num_hidden_layers=2, num_attention_heads=2, image_size=28, patch_size=14)
    network = Dinov2Model(sizes).eval()
    network.save_pretrained(weights := tmp_path / "dino")
    own = config(weights, "tuned", backbone=("dino",), reference="none")
    check_encoder(weights, 28, ("dino",))
    check_encoder_files(weights, ("dino",))
    frames = noise(28)
    with torch.no_grad():
        embedded = base_encoder(own)(frames, torch.zeros(3))
        patches = network(pixel_values=(frames.permute(0, 3, 1, 2) / 255 - 0.5) / 0.5).last_hidden_state[:, 1:]
    torch.testing.assert_close(embedded, patches.mean(1), rtol=1e-4, atol=1e-5)
    learnt = [name for name, p in property_classifier(own, CLASSES).named_parameters() if p.requires_grad]
    assert any(".layer.1." in name for name in learnt)
    assert not any(".layer.0." in name for name in learnt)
    write_pretrained()
    both = config(weights, "tuned", backbone=("dino", "scenes"), epochs=1)
    assert backbone_files(both) == [weights / "config.json", weights / "model.safetensors", PRETRAINED]
    assert "DINOv2 beside a convolutional network" in encoder_words(both)
    _, history = finetune(training(data, both))
    assert "validation_combined" in {m.name for m in history}
    write_encoder_card(tmp_path / "card", data, both, 0, "scenes")
    assert f"- dino: `{weights}`" in (tmp_path / "card" / "README.md").read_text()
