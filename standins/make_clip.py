"""Train the tiny CLIP from scratch on drawn pictures and captions.

Run from the repository's root: `python -m standins.make_clip`. Writes `standins/clip/` (open_clip's local-dir
format), `standins/clip_curve.csv` and `standins/clip_zero_shot.csv`.
"""

from __future__ import annotations

import math
import random
import statistics
from pathlib import Path
from typing import TYPE_CHECKING

import open_clip
import torch
import torch.nn.functional as F
from torch.nn.attention import SDPBackend, sdpa_kernel
from torch.optim.lr_scheduler import LambdaLR

from pipeline.io import save_tensors, write_json
from pipeline.runtime import derive_seed, seed_everything
from standins.beginning import initialise
from standins.contrast import contrastive_loss, draw_captions
from standins.images import COLOURS, OPENINGS, SHAPES, caption, draw_scene
from standins.outputs import replacing, write_rows
from standins.patterns import PATTERNS
from standins.settings import FOLDER, ClipSettings, load_settings
from standins.vocabulary import build_tokenizer, words_of
from standins.zero_shot import Reader, zero_shot

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerFast

MEAN, STD = (0.48, 0.46, 0.41), (0.27, 0.26, 0.28)
"""RGB statistics that pictures are normalised by, close to those of photographs."""
CAPTIONS_FOR_WORDS = 4000
MORE_WORDS = ("colour", "texture", "material", "wood", "metal", "stone", "cloth", "object", "dark", "bright")

Curve = list[tuple[int, float, float]]


def make_tokenizer(seed: int) -> PreTrainedTokenizerFast:
    """The caption tokenizer: the captions' words, a few more, and bytes."""
    rng = random.Random(derive_seed("clip words", seed))
    captions = [caption(draw_scene(rng, held_out=False)) for _ in range(CAPTIONS_FOR_WORDS)]
    return build_tokenizer(words_of([*captions, *OPENINGS, *COLOURS, *SHAPES, *PATTERNS, *MORE_WORDS]), closed=True)


def write_config(folder: Path, settings: ClipSettings, vocabulary: int) -> None:
    """Write open_clip_config.json: two transformers, and how pictures are prepared."""
    vision = {
        "image_size": settings.image_size,
        "patch_size": settings.patch_size,
        "width": settings.width,
        "layers": settings.layers,
        "head_width": 32,
        "pool_type": "avg",
    }
    text = {
        "context_length": settings.context_length,
        "vocab_size": vocabulary,
        # open_clip only asks whether a name is there; the files are this folder's own.
        "hf_tokenizer_name": "local",
        "width": settings.text_width,
        "heads": settings.text_width // 32,
        "layers": settings.text_layers,
        "pool_type": "eos",
        "eos_id": 2,
    }
    preprocess = {"mean": MEAN, "std": STD, "interpolation": "bicubic", "resize_mode": "squash"}
    model = {"embed_dim": settings.embed_dim, "vision_cfg": vision, "text_cfg": text}
    write_json(folder / "open_clip_config.json", {"model_cfg": model, "preprocess_cfg": preprocess})


def train(reader: Reader, settings: ClipSettings) -> Curve:
    """Contrastive training in place.

    Returns:
        Mean loss (nats) and share of pictures that found their caption, over the sets of captions, every `log_every`
        steps.
    """
    model, rng = reader.model, random.Random(derive_seed("clip scenes", settings.seed))
    optimisers = make_optimisers(model, settings)
    schedules = [LambdaLR(optimiser, lambda step: _rate(step, settings)) for optimiser in optimisers]
    curve: Curve = []
    losses: list[float] = []
    hits: list[float] = []
    for step in range(1, settings.steps + 1):
        scenes = [draw_scene(rng, held_out=False) for _ in range(settings.batch_size)]
        sets = draw_captions(rng, scenes, settings.full_captions)
        # PyTorch's fused attention is slow backwards in bfloat16 on a processor.
        with torch.autocast("cpu", dtype=torch.bfloat16), sdpa_kernel(SDPBackend.MATH):
            image = F.normalize(model.encode_image(reader.pictures(scenes)).float(), dim=-1)
            singles = reader.texts([text for captions in sets[:-1] for text in captions.texts])
            last = reader.texts(sets[-1].texts)
        texts = [*singles.split([len(captions.texts) for captions in sets[:-1]]), last]
        scaled = image * model.logit_scale.exp()
        results = [contrastive_loss(scaled, *pair) for pair in zip(texts, sets, strict=True)]
        parts = torch.stack([part for part, _ in results])
        loss = settings.topic_weight * parts[:-1].mean() + parts[-1]
        for optimiser in optimisers:
            optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        for optimiser, schedule in zip(optimisers, schedules, strict=True):
            optimiser.step()
            schedule.step()
        with torch.no_grad():
            model.logit_scale.clamp_(0, math.log(settings.max_logit_scale))
        losses.append(loss.item())
        hits.append(statistics.fmean(found.item() for _, found in results))
        if step % settings.log_every == 0:
            curve.append((step, statistics.fmean(losses), statistics.fmean(hits)))
            print("step {} loss {:.3f} accuracy {:.3f}".format(*curve[-1]), flush=True)
            losses, hits = [], []
    return curve


def make_optimisers(model: open_clip.CLIP, settings: ClipSettings) -> list[torch.optim.Optimizer]:
    """Muon (Jordan 2024) for the transformers' matrices, AdamW for everything else."""
    towers = (model.visual.transformer, model.transformer)
    matrices = [p for tower in towers for p in tower.parameters() if p.ndim == 2]
    chosen = {id(p) for p in matrices}
    others = [p for p in model.parameters() if id(p) not in chosen]
    decayed, plain = [p for p in others if p.ndim >= 2], [p for p in others if p.ndim < 2]
    groups = [{"params": decayed, "weight_decay": settings.weight_decay}, {"params": plain, "weight_decay": 0.0}]
    muon = torch.optim.Muon(
        matrices, lr=settings.matrix_rate, weight_decay=settings.weight_decay, adjust_lr_fn="match_rms_adamw"
    )
    return [muon, torch.optim.AdamW(groups, lr=settings.learning_rate, betas=(0.9, 0.98))]


def _rate(step: int, settings: ClipSettings) -> float:
    """Linear warm-up, a plateau, and a linear descent to zero."""
    return min((step + 1) / settings.warmup_steps, 1, (settings.steps - step) / (settings.steps * settings.descent))


def main() -> None:
    """Make the stand-in and test it."""
    torch.set_num_threads(1)
    settings = load_settings().clip
    seed_everything(settings.seed)
    with replacing(FOLDER / "clip") as folder:
        tokenizer = make_tokenizer(settings.seed)
        tokenizer.save_pretrained(folder)
        write_config(folder, settings, len(tokenizer))
        model = open_clip.create_model(f"local-dir:{folder}", load_weights=False)
        initialise(model, settings.temperature)
        curve = train(Reader(model, tokenizer, settings), settings)
        save_tensors(
            folder / "open_clip_model.safetensors",
            {name: tensor.to(torch.bfloat16) for name, tensor in model.state_dict().items()},
            {"format": "pt"},
        )
        # Tested as stored, so that the figures are those of the rounded weights.
        stored = open_clip.create_model(f"local-dir:{folder}", precision="fp32")
        rng = random.Random(derive_seed("clip test", settings.seed))
        scenes = [draw_scene(rng, held_out=True) for _ in range(settings.test_scenes)]
        rows = zero_shot(Reader(stored, tokenizer, settings), scenes, rng)
    write_rows(FOLDER / "clip_curve.csv", ("step", "loss", "accuracy"), curve)
    write_rows(FOLDER / "clip_zero_shot.csv", ("question", "accuracy", "low", "high", "n", "chance"), rows)


if __name__ == "__main__":
    main()
