"""The encoder: prompts change every layer, the backbone stays, checkpoints hold only what is trained."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from pipeline.config import EncoderConfig, Recipe
from pipeline.embeddings import INDEX_FILE, TENSOR, TENSOR_FILE, EmbeddingStore
from pipeline.encoder.clip import load_visual_tower
from pipeline.encoder.embed import standardize
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.errors import UserError
from pipeline.io import save_tensors, write_table
from pipeline.records import Embedding
from pipeline.trainable import load_trainable, save_trainable, trainable_state
from pipeline.weights import check_encoder, check_language
from tests.checkpoints import write_clip, write_llama


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clip"))


def config(weights: Path, prompts: int = 2, recipe: Recipe = "paper") -> EncoderConfig:
    return EncoderConfig(
        recipe=recipe, weights=str(weights), prompts=prompts, reference="subtract" if recipe == "pretrained" else "none"
    )


FRAME_INDICES = torch.tensor([[0, 5, 9]] * 4)


def test_base_encoder_is_open_clips_own_embedding(weights: Path, frames: torch.Tensor) -> None:
    import open_clip
    from PIL import Image

    model = open_clip.create_model(f"local-dir:{weights}").eval()
    transform = open_clip.transform.image_transform_v2(
        open_clip.transform.PreprocessCfg(**model.visual.preprocess_cfg), is_train=False
    )
    pictures = torch.stack([transform(Image.fromarray(f.numpy())) for f in frames[:, 0]])
    with torch.inference_mode():
        torch.testing.assert_close(
            base_encoder(config(weights))(frames[:, 0], FRAME_INDICES[:, 0]), model.encode_image(pictures), atol=1e-5, rtol=0
        )


def test_prompts_reach_every_layer_and_leave_no_trace(weights: Path, frames: torch.Tensor) -> None:
    model = property_classifier(config(weights, 3), [3, 3, 2])
    seen: list[int] = []
    for block in model.encoder.visual.transformer.resblocks:
        block.attn.register_forward_pre_hook(
            lambda _, a, k: seen.append((k.get("query", a[0] if a else None)).shape[1]), with_kwargs=True
        )
    output = model(frames, FRAME_INDICES, torch.tensor([[0, 1, 1]] * 4))
    patches = (32 // 16) ** 2 + 1
    assert seen == [patches + 3] * 2, "each layer sees its own prompts, and only its own"
    output["loss"].backward()
    gradient = model.encoder.prompts.prompts.grad  # type: ignore[union-attr]
    assert (gradient.flatten(1).norm(dim=1) > 0).all(), "gradients reach the prompts of every layer"
    assert all(p.grad is None for p in model.encoder.visual.parameters()), "the backbone is frozen"


def test_zero_prompts_would_differ_from_the_base(weights: Path, frames: torch.Tensor) -> None:
    tuned = property_classifier(config(weights, 3), [2]).encoder
    assert not torch.allclose(tuned(frames[0], FRAME_INDICES[0]), base_encoder(config(weights))(frames[0], FRAME_INDICES[0]))


def test_loss_is_the_sum_over_properties_of_the_mean_frame(weights: Path, frames: torch.Tensor) -> None:
    model = property_classifier(config(weights, 2), [3, 2]).eval()
    labels = torch.tensor([[0, 1], [2, 0], [1, 1], [2, 1]])
    output = model(frames, FRAME_INDICES, labels)
    pooled = torch.stack([model.encoder(clip, FRAME_INDICES[0]).mean(0) for clip in frames])
    expected = sum(F.cross_entropy(head(pooled), y) for head, y in zip(model.heads, labels.T, strict=True))
    torch.testing.assert_close(output["loss"], expected)
    assert output["logits"].shape == (4, 5)


def test_backbone_is_bit_identical_after_a_step(weights: Path, frames: torch.Tensor) -> None:
    model = property_classifier(config(weights, 2), [3, 3]).train()
    assert not model.encoder.visual.training
    before = {k: v.clone() for k, v in model.encoder.visual.state_dict().items()}
    optimiser = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], lr=0.1)
    model(frames, FRAME_INDICES, torch.zeros(4, 2, dtype=torch.long))["loss"].backward()
    optimiser.step()
    for name, value in model.encoder.visual.state_dict().items():
        assert torch.equal(before[name], value)


def test_saved_state_is_only_what_is_trained_and_reloads_exactly(
    weights: Path, frames: torch.Tensor, tmp_path: Path
) -> None:
    model = property_classifier(config(weights, 2), [3, 3]).eval()
    save_trainable(model, tmp_path / "encoder.safetensors")
    assert all("visual" not in name for name in trainable_state(model))
    other = property_classifier(config(weights, 2), [3, 3]).eval()
    load_trainable(other, tmp_path / "encoder.safetensors")
    assert torch.equal(model(frames, FRAME_INDICES)["logits"], other(frames, FRAME_INDICES)["logits"])
    with pytest.raises(UserError, match="does not fit"):
        load_trainable(property_classifier(config(weights, 5), [3, 3]), tmp_path / "encoder.safetensors")
    with pytest.raises(UserError, match="does not fit"):
        load_trainable(property_classifier(config(weights, 2), [3]), tmp_path / "encoder.safetensors")


def test_batch_of_one_equals_batch_of_many(weights: Path, frames: torch.Tensor) -> None:
    model = property_classifier(config(weights, 2), [3, 3]).eval()
    whole = model(frames, FRAME_INDICES)["logits"]
    single = torch.cat([model(clip[None], FRAME_INDICES[:1])["logits"] for clip in frames])
    torch.testing.assert_close(whole, single, atol=1e-6, rtol=0)


@pytest.mark.parametrize("value", [0, 255])
def test_constant_frames_are_finite(weights: Path, value: int) -> None:
    frames = torch.full((1, 5, 32, 32, 3), value, dtype=torch.uint8)
    assert (
        property_classifier(config(weights, 2), [3])(frames, torch.zeros(1, 5, dtype=torch.int64))["logits"]
        .isfinite()
        .all()
    )


def test_standardized_by_training_frames_alone() -> None:
    index = [
        Embedding(video_id=video, frame_index=f, flip=flip, row=0)
        for video in ("train_0", "train_1", "test_0")
        for flip in ("none", "both")
        for f in range(4)
    ]
    index = [entry.model_copy(update={"row": row}) for row, entry in enumerate(index)]
    raw = torch.randn(len(index), 3, generator=torch.manual_seed(0)) * torch.tensor([1e-3, 1.0, 0.0]) + 1e3
    rows = [e.row for e in index if e.video_id.startswith("train") and e.flip == "none"]
    done = standardize(raw, index, {"train_0", "train_1"})
    reference = (raw.numpy() - raw[rows].numpy().astype(float).mean(0)) / np.array(
        [*raw[rows].numpy().astype(float).std(0)[:2], 1.0]
    )
    np.testing.assert_allclose(done.numpy(), reference, rtol=1e-6)
    assert done.isfinite().all(), "a constant dimension is only shifted"
    moved = raw.clone()
    moved[[e.row for e in index if e.video_id == "test_0"]] += 5
    assert torch.equal(standardize(moved, index, {"train_0", "train_1"})[rows], done[rows])


class TestBadWeights:
    def test_missing_folder(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match="hf download timm"):
            check_encoder(tmp_path / "nothing", 32)

    def test_pickle(self, tmp_path: Path) -> None:
        folder = write_clip(tmp_path)
        (folder / "open_clip_model.safetensors").rename(folder / "open_clip_pytorch_model.bin")
        with pytest.raises(UserError, match="pickles are refused"):
            check_encoder(folder, 32)

    def test_pickle_under_the_name_of_safetensors(self, tmp_path: Path) -> None:
        folder = write_clip(tmp_path)
        torch.save({"a": torch.zeros(1)}, folder / "open_clip_model.safetensors")
        with pytest.raises(UserError, match="does not fit"):
            load_visual_tower(folder)

    def test_wrong_size(self, tmp_path: Path) -> None:
        with pytest.raises(UserError, match="frames.size=32"):
            check_encoder(write_clip(tmp_path), 24)

    def test_checkpoint_of_another_model(self, tmp_path: Path) -> None:
        folder = write_clip(tmp_path)
        config = folder / "open_clip_config.json"
        config.write_text(config.read_text().replace('"layers": 2', '"layers": 3'))
        with pytest.raises(UserError, match="does not fit its open_clip_config.json"):
            load_visual_tower(folder)

    def test_language_pickle(self, tmp_path: Path) -> None:
        folder = write_llama(tmp_path)
        (folder / "model.safetensors").rename(folder / "pytorch_model.bin")
        with pytest.raises(UserError, match="only pickles"):
            check_language(folder)


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_embeddings_are_served_by_a_memory_map(tmp_path: Path) -> None:
    tensor = torch.randn(64, 8)
    save_tensors(tmp_path / TENSOR_FILE, {TENSOR: tensor})
    index = [Embedding(video_id="a_0", frame_index=i, flip="none", row=i) for i in range(64)]
    write_table(tmp_path / INDEX_FILE, Embedding, index)
    store = EmbeddingStore(tmp_path)
    maps = Path("/proc/self/maps").read_text().splitlines()
    mapped = [line.split()[0].split("-") for line in maps if line.endswith(TENSOR_FILE)]
    place = store.tensor.data_ptr()
    assert any(int(low, 16) <= place < int(high, 16) for low, high in mapped), "read from the file when it is asked for"
    assert torch.equal(store.features("a_0", [5, 2]), tensor[[5, 2]])
