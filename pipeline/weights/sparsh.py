"""Sparsh, a tactile encoder (Higuera et al. 2024, arXiv:2410.24090), in timm's layout, which the backbone `timm` reads.

Layout and input form are those of its public code (github.com/facebookresearch/sparsh, tactile_ssl/model): a vision
transformer with register tokens and no class token, with layer scale, and with positions of sines and cosines whose
frequencies are stored. It takes two pictures, one five frames before the other, as six channels, each of them
(frame - untouched) / 255 + .5.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipeline.core.records import GAIN, MIDDLE
from pipeline.running.errors import UserError
from pipeline.weights import first_words

if TYPE_CHECKING:
    import torch

SIDE = 224
"""Pixels that it was trained at."""
HEAD_WIDTH = 64
"""Width of an attention head, the same in every size of Sparsh."""
BANDS = "pos_embed.frequency_bands"
LICENCE = "CC-BY-NC-4.0: research only, no commerce"
# A picture of `subtract` is MIDDLE + GAIN * difference; (picture / 255 - MEAN) / STD is difference / 255 + .5 again.
MEAN, STD = MIDDLE / 255 - GAIN / 2, GAIN


def write(folder: Path, stored: Mapping[str, torch.Tensor], key: str) -> None:
    """Write Sparsh's weights as a timm network that takes one picture.

    Kept frames have no neighbour five frames earlier, so each is shown twice, as where nothing moves. The patch
    embedding is linear: twice the same picture is one picture with the sum of both halves of its weights.

    Args:
        folder: Empty; gets `config.json` and `model.safetensors`.
        stored: Tensors by their published names, without the prefix of a training's checkpoint.
        key: What an error names.

    Raises:
        UserError: where a tensor is missing, unknown or of another shape than the others imply.
    """
    import timm
    import torch
    from timm.models import save_for_hf

    state = {name: value for name, value in stored.items() if "mask_token" not in name}
    try:
        patches, registers, bands = state["patch_embed.proj.weight"], state.pop("register_tokens"), state.pop(BANDS)
        width, channels, patch, _ = patches.shape
        form = {
            "img_size": SIDE,
            "patch_size": patch,
            "embed_dim": width,
            "depth": 1 + max(int(name.split(".")[1]) for name in state if name.startswith("blocks.")),
            "num_heads": width // HEAD_WIDTH,
            "num_classes": 0,
            "class_token": False,
            "reg_tokens": registers.shape[1],
            "no_embed_class": True,
            "init_values": 1.0,
            "global_pool": "avg",
            "fc_norm": False,
        }
        if channels != 6:
            raise UserError(f"{key}: its pictures have {channels} channels, not the 6 of two; take a Sparsh of images")
        state["patch_embed.proj.weight"] = patches[:, :3] + patches[:, 3:]
        # Sine and cosine of a patch's row and column, counted from 0, at each frequency.
        places = torch.arange(SIDE // patch, dtype=torch.float32)[:, None]
        rows, columns = (torch.cat([(places * band).sin(), (places * band).cos()], dim=1) for band in bands.float())
        side = len(places)
        grid = [rows[:, None].expand(side, side, -1), columns[None].expand(side, side, -1)]
        state |= {"pos_embed": torch.cat(grid, dim=2).flatten(0, 1)[None], "reg_token": registers}
        model = timm.create_model("vit_base_patch16_224", pretrained=False, **form)
        model.load_state_dict(state)
    except (KeyError, ValueError, IndexError, AttributeError, RuntimeError) as error:
        raise UserError(
            f"{key}: not the layout of Sparsh's DINO encoders ({first_words(error)}); download "
            "facebook/sparsh-dino-base"
        ) from None
    means: dict[str, Any] = {"mean": (MEAN,) * 3, "std": (float(STD),) * 3}
    told = {**means, "input_size": (3, SIDE, SIDE), "license": LICENCE, "tag": "sparsh"}
    how = {"model_config": {"pretrained_cfg": told}, "data_config": told, "model_args": form}
    save_for_hf(model, str(folder), safe_serialization=True, **how)
