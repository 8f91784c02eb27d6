"""Initialisation of the projection: frames map near the word embeddings of their object's classes."""

from __future__ import annotations

import torch
from torch.nn import functional as F

from pipeline.language.conversations import ConversationDataset
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.videos.catalogue import Catalogue

STEPS, BATCH, RATE = 400, 128, 2e-3
"""Updates, frames an update and their learning rate: seconds on a processor."""
NOISE = 0.3
"""Standard deviation of the noise on an embedding, whose values have a deviation of 1 (`encoder.standardize`)."""


def begin_with_words(model: OctopiForCausalLM, data: ConversationDataset, catalogue: Catalogue, seed: int) -> None:
    """Fit the projection so that each frame maps to the mean word embedding of its object's class names.

    With a random projection the language model first memorises frames object by object, and does not learn which video
    of a question they belong to. If frames resemble words, it finds them by the label before them, as in a list.

    What is fitted are the unmirrored frames and the labels of `data`. Noise is added to the frames, or the projection
    would memorise the few objects.
    """

    def word(level: str) -> torch.Tensor:
        ids = model.tokenizer.encode(f" {level}", add_special_tokens=False)
        return model.embed_words(torch.tensor(ids, device=model.llm.device)).detach().float().mean(0)

    classes = [[word(level) for level in prop.levels] for prop in catalogue.properties]
    labels = {v: label for q in data.questions for v, label in zip(q.videos, q.gold.labels, strict=True)}
    frames, wanted = [], []
    for video, label in sorted(labels.items()):
        found = data.store.features(video, range(data.store.count(video))).float()
        mean = torch.stack([levels[place] for levels, place in zip(classes, label, strict=True)]).mean(0)
        frames.append(found)
        wanted.append(mean.expand(len(found), -1))
    device = model.connector.delimiters.device
    x, y = torch.cat(frames).to(device), torch.cat(wanted).to(device)
    # Word embeddings are far smaller than the optimizer's steps. So the targets are divided by their root mean square,
    # and the projection is multiplied by it at the end.
    length = y.square().mean().sqrt()
    projection, drawn = model.connector.projection, torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(projection.parameters(), lr=RATE, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    for _ in range(STEPS):
        rows = torch.randint(len(x), (BATCH,), generator=drawn)
        noise = NOISE * torch.randn(BATCH, x.shape[1], generator=drawn)
        loss = F.mse_loss(projection(x[rows] + noise.to(device)), y[rows] / length)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    optimizer.zero_grad()
    # A normalised projection has the words' length whatever its weights are.
    if model.word_rms is None:
        with torch.no_grad():
            for parameter in projection[-1].parameters():
                parameter.mul_(length)
