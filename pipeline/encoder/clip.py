"""Loading of CLIP's visual tower from a folder in open_clip's own format, never from a hub."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.core.errors import UserError
from pipeline.core.io import read_json
from pipeline.weights import CLIP_CONFIG, GET_CLIP, check_finite, frame_side

if TYPE_CHECKING:
    from open_clip.transformer import VisionTransformer


def load_visual_tower(folder: Path, embedding: str = "projected") -> VisionTransformer:
    """Load the visual tower in float32, frozen and in evaluation mode; the text tower is dropped.

    Args:
        folder: In open_clip's format.
        embedding: As `EncoderConfig.embedding`: `class_token` has the transformer's width, all else the projection's.

    Raises:
        UserError: where there are no safetensors, for a checkpoint that does not fit its configuration, or a
            tower that is not a vision transformer (visual prompts need one).
    """
    import open_clip
    from safetensors import SafetensorError

    frame_side(folder, "clip")  # Of another's folder open_clip would read a pickle, too.
    try:
        text = read_json(folder / CLIP_CONFIG)["model_cfg"]["text_cfg"]
        if "hf_model_name" in text:
            raise UserError(
                f"encoder.weights: open_clip would ask a hub for the text tower of {folder} ({text['hf_model_name']}); "
                "name a CLIP with a text tower of its own"
            )
        model = open_clip.create_model(f"local-dir:{folder}", precision="fp32", require_pretrained=True)
    except (RuntimeError, ValueError, LookupError, TypeError, AttributeError, OSError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:200]
        raise UserError(
            f"encoder.weights: {folder} does not fit its {CLIP_CONFIG} ({reason}); {GET_CLIP.format(folder=folder)}"
        ) from None
    visual = model.visual
    if not isinstance(visual, open_clip.transformer.VisionTransformer) or not visual.transformer.batch_first:
        raise UserError(f"encoder.weights: {folder} is no vision transformer; visual prompts need one such as ViT-L/14")
    check_finite(folder, "encoder.weights", visual.named_parameters())
    visual.requires_grad_(False).eval()
    if embedding == "class_token":
        visual.proj = None
    return visual
