"""Train the tiny CLIP from scratch on drawn pictures and captions.

Run from the repository's root: `python -m standins.make_clip`. Writes `standins/clip/` (open_clip's local-dir
format), `standins/clip_curve.csv` and `standins/clip_zero_shot.csv`.
"""

from __future__ import annotations

import math
import random
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import open_clip
import torch
import torch.nn.functional as F

from pipeline.artifacts import save_tensors, write_json
from pipeline.runtime import derive_seed, seed_everything
from standins.images import COLOURS, OPENINGS, SHAPES, caption, draw_scene, draw_topics
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
    """Contrastive training in place: cross-entropy over a batch's similarities, both ways (Radford et al. 2021).

    The captions of a batch speak of the same topics, so many are alike; pictures with like captions share the target
    (Yang et al. 2022, UniCL). Few topics at a time are what makes the fine ones, pattern and light, learnt at all.

    Returns:
        Mean loss (nats) and share of pictures that found their caption in the batch, every `log_every` steps.
    """
    model, rng = reader.model, random.Random(derive_seed("clip scenes", settings.seed))
    decayed = [p for p in model.parameters() if p.ndim >= 2]
    others = [p for p in model.parameters() if p.ndim < 2]
    groups = [{"params": decayed, "weight_decay": settings.weight_decay}, {"params": others, "weight_decay": 0.0}]
    optimiser = torch.optim.AdamW(groups, lr=settings.learning_rate, betas=(0.9, 0.98))
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _rate(step, settings))
    curve: Curve = []
    losses: list[float] = []
    hits: list[float] = []
    for step in range(1, settings.steps + 1):
        if step > settings.steps * settings.patch_dropout_until:
            model.visual.patch_dropout.prob = 0.0
        scenes = [draw_scene(rng, held_out=False) for _ in range(settings.batch_size)]
        # Full captions first: their colours are learnt at once, which gives the finer topics something to build on.
        topics = draw_topics(rng, 1.0 if step <= settings.full_steps else settings.full_captions)
        opening = rng.choice(OPENINGS)
        captions = [caption(scene, topics, opening) for scene in scenes]
        ids = reader.tokens(captions)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            image, text, scale = model(reader.pictures(scenes), ids)
        logits, target = scale * image.float() @ text.float().T, alike(captions)
        loss = (F.cross_entropy(logits, target) + F.cross_entropy(logits.T, target)) / 2
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            model.logit_scale.clamp_(0, math.log(settings.max_logit_scale))
        losses.append(loss.item())
        hits.append((target.gather(1, logits.argmax(1, keepdim=True)) > 0).float().mean().item())
        if step % settings.log_every == 0:
            curve.append((step, statistics.fmean(losses), statistics.fmean(hits)))
            print("step {} loss {:.3f} accuracy {:.3f}".format(*curve[-1]), flush=True)
            losses, hits = [], []
    return curve


def alike(captions: Sequence[str]) -> torch.Tensor:
    """Target distribution of each row, captions x captions: even over the equal ones."""
    numbers = torch.tensor([captions.index(text) for text in captions])
    same = (numbers[:, None] == numbers[None]).float()
    return same / same.sum(1, keepdim=True)


def _rate(step: int, settings: ClipSettings) -> float:
    """Linear warm-up, then a half cosine to zero."""
    progress = step / settings.steps
    return min((step + 1) / settings.warmup_steps, 0.5 + 0.5 * math.cos(math.pi * min(progress, 1)))


def main() -> None:
    """Make the stand-in and test it."""
    torch.set_num_threads(1)
    settings = load_settings().clip
    seed_everything(settings.seed)
    with replacing(FOLDER / "clip") as folder:
        tokenizer = make_tokenizer(settings.seed)
        tokenizer.save_pretrained(folder)
        write_config(folder, settings, len(tokenizer))
        model = open_clip.create_model(
            f"local-dir:{folder}", load_weights=False, force_patch_dropout=settings.patch_dropout
        )
        with torch.no_grad():
            model.logit_scale.fill_(math.log(1 / settings.temperature))
        curve = train(Reader(model, tokenizer, settings), settings)
        save_tensors(
            folder / "open_clip_model.safetensors",
            {name: tensor.to(torch.bfloat16) for name, tensor in model.state_dict().items()},
            {"format": "pt"},
        )
        # Tested as stored, so that the figures are those of the rounded weights.
        stored = open_clip.create_model(f"local-dir:{folder}", precision="fp32")
        rows = zero_shot(Reader(stored, tokenizer, settings), settings)
    write_rows(FOLDER / "clip_curve.csv", ("step", "loss", "accuracy"), curve)
    write_rows(FOLDER / "clip_zero_shot.csv", ("question", "accuracy", "low", "high", "n", "chance"), rows)


if __name__ == "__main__":
    main()
