"""What the tests of encoders share: tiny towers, frames as extraction leaves them, settings, comparisons."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file

from pipeline.config import EncoderConfig, RecipeName, RuntimeConfig
from pipeline.core.io import write_table
from pipeline.core.layout import PRETRAINED
from pipeline.core.records import Part
from pipeline.encoder.data import EncoderData
from pipeline.encoder.finetune import Training
from pipeline.encoder.frame_classifier import FittedHeads
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.training.trainable import save_trainable
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.frames.store import FRAMES_FILE, REFERENCES_FILE, TABLE_FILE, FrameStore
from pipeline.videos.records import Assignment, Frame
from tests.checkpoints import write_clip

Floats = np.ndarray
CPU = RuntimeConfig(device="cpu", save_steps=2)
FRAME_INDICES = torch.tensor([[0, 5, 9], [1, 2, 40_000], [7, 7, 7], [3, 10**6, 4]])
OBJECTS = ("baseball", "rug", "pillow", "potato", "cotton_ball", "ice_block", "millet")
PARTS = {o: Part.VALIDATION if i > 4 else Part.TRAIN for i, o in enumerate(OBJECTS)}
"""Five videos to train on, two to choose by."""


def write_tower(folder: Path, *, averages: bool = False) -> Path:
    """A tiny CLIP none of whose biases is 0 and none of whose scales is 1: fresh ones would hide a wrong layer.

    With `averages` its embedding is read from the mean over patches, in place of the class token.
    """
    file = write_clip(folder) / "open_clip_model.safetensors"
    if averages:
        form = folder / "open_clip_config.json"
        form.write_text(form.read_text().replace('"vision_cfg": {', '"vision_cfg": {"pool_type": "avg", '))
    draw = torch.Generator().manual_seed(1)
    save_file({k: v + 0.2 * torch.randn(v.shape, generator=draw) for k, v in load_file(file).items()}, file)
    return folder


def write_frames(folder: Path, lengths: Mapping[str, int], side: int = 32, seed: int = 0) -> Path:
    """What extraction would leave of videos with so many kept frames; every third frame was kept."""
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(seed)
    index = [(video, 3 * i) for video, count in lengths.items() for i in range(count)]
    for name, count in ((FRAMES_FILE, len(index)), (REFERENCES_FILE, len(lengths))):
        np.save(folder / name, rng.integers(0, 256, (count, side, side, 3), dtype=np.uint8))
    rows = [Frame(video_id=v, frame_index=i, score=0, row=row) for row, (v, i) in enumerate(index)]
    write_table(folder / TABLE_FILE, Frame, rows)
    return folder


def encoder_data(folder: Path, catalogue: Catalogue, parts: Mapping[str, Part], per_video: int = 2) -> EncoderData:
    """Videos of 4, 1 and 3 frames by turns, one an object, in these parts."""
    write_frames(folder, {f"{o}_0": (4, 1, 3)[i % 3] for i, o in enumerate(parts)})
    assignments = [Assignment(video_id=f"{o}_0", object_id=o, part=part) for o, part in parts.items()]
    return EncoderData(FrameStore(folder), catalogue, assignments, per_video)


def config(weights: Path, recipe: RecipeName, **changes: object) -> EncoderConfig:
    tuned = {"backbone": ("scenes",), "reference": "subtract"} if recipe == "tuned" else {}
    own = {"recipe": recipe, "weights": str(weights), "prompts": 3}
    return EncoderConfig.model_validate({**own, **tuned, **changes})


def training(data: EncoderData, setting: EncoderConfig, seed: int = 0, **more: Any) -> Training:
    return Training(data, setting, CPU, seed, (), **more)


def write_pretrained(seed: int = 0) -> SceneEncoder:
    """The backbone `scenes`, with running statistics of noise, where the chain has it; in evaluation mode."""
    torch.manual_seed(seed)
    made = SceneEncoder()
    made(torch.randint(0, 256, (8, 32, 32, 3), dtype=torch.uint8), torch.zeros(8))
    save_trainable(made, PRETRAINED)
    return made.eval()


def write_timm(folder: Path, name: str = "test_efficientnet", seed: int = 0, **arguments: Any) -> Path:
    """A tiny network of timm's in its hub's layout; no normalisation is the identity, which would hide a wrong one."""
    import timm
    from timm.models import save_for_hf

    torch.manual_seed(seed)
    model = timm.create_model(name, pretrained=False, **arguments)
    with torch.no_grad():
        for key, value in model.state_dict().items():
            if value.is_floating_point():
                value.add_(0.1 * torch.rand_like(value) if "running" in key else 0.1 * torch.randn_like(value))
    save_for_hf(model, folder, safe_serialization=True, model_args=arguments or None)
    return folder


def float64(tensor: torch.Tensor) -> Floats:
    return tensor.detach().double().numpy()


def close(found: torch.Tensor, expected: Floats, rtol: float = 1e-5) -> None:
    assert found.dtype == torch.float32
    np.testing.assert_allclose(float64(found), expected, rtol=0, atol=rtol * max(1, np.abs(expected).max()))


def random_heads(seed: int, dim: int, classes: Sequence[int], strength: float) -> FittedHeads:
    rng = np.random.default_rng(seed)
    return FittedHeads(
        centre=rng.normal(size=dim).astype(np.float32),
        spread=rng.uniform(0.1, 3, dim).astype(np.float32),
        weights=[strength * rng.normal(size=(c, dim)) for c in classes],
        biases=[strength * rng.normal(size=c) for c in classes],
        dependence=rng.normal(size=tuple(classes)),
    )
