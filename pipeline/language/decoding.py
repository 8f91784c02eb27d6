"""Greedy decoding that computes the prompts' common prefix once, and drops rows whose answers have ended.

transformers' `generate` computes the prefix for every row, and every row until the longest answer ends.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator, Sequence

import torch
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence
from transformers import Cache

from pipeline.language.cache import extendable, roomy_cache
from pipeline.language.octopi import OctopiForCausalLM

READ = 1024
"""Prompt tokens that are computed at once, with padding: enough to keep a processor busy."""
STAYING = 7 / 8
"""Rows that ended are dropped once no more than this share goes on. Dropping copies the keys and values of all others,
so it is not done for each row by itself."""


def greedy(
    model: OctopiForCausalLM,
    prompts: Sequence[Sequence[int]],
    features: Sequence[torch.Tensor],
    ends: Collection[int],
    limits: Sequence[int],
) -> list[list[int]]:
    """All tokens that `greedy_tokens` yields, by prompt."""
    said: list[list[int]] = [[] for _ in prompts]
    for row, token in greedy_tokens(model, prompts, features, ends, limits):
        said[row].append(token)
    return said


@torch.inference_mode()
def greedy_tokens(
    model: OctopiForCausalLM,
    prompts: Sequence[Sequence[int]],
    features: Sequence[torch.Tensor],
    ends: Collection[int],
    limits: Sequence[int],
) -> Iterator[tuple[int, int]]:
    """Yield the place of a prompt and its most likely next token, up to and including an end token, or to the limit.

    In float32 a row's tokens do not depend on its neighbours.

    Args:
        features: Of each prompt's frames: frames x tactile_dim.
        ends: Ids of tokens that end an answer.
        limits: Most new tokens of each, at least 1. Lowering a limit during generation ends its row.
    """
    logits, cache, mask = _read(model, prompts, features)
    said, ended = [0] * len(prompts), [False] * len(prompts)
    rows = list(range(len(prompts)))
    while True:
        tokens, going = logits.argmax(-1), []
        for place, (row, token) in enumerate(zip(rows, tokens.tolist(), strict=True)):
            if ended[row]:
                continue
            said[row] += 1
            ended[row] = token in ends or said[row] >= limits[row]
            if not ended[row]:
                going.append(place)
            yield row, token
        if not going:
            return
        if len(going) <= STAYING * len(rows):
            rows = [rows[place] for place in going]
            chosen = torch.tensor(going, device=mask.device)
            tokens, mask = tokens[chosen], mask[chosen]
            cache.batch_select_indices(chosen)
        mask = F.pad(mask, (0, 1), value=1)
        logits = _step(model, model.embed_words(tokens[:, None]), mask, cache)


def _step(model: OctopiForCausalLM, embeddings: torch.Tensor, mask: torch.Tensor, cache: Cache) -> torch.Tensor:
    """Logits of the next token, rows x vocabulary, after these embeddings: the last columns that the mask covers."""
    # Padding on the left takes no position, so positions count a row's real tokens; the clamp keeps padding at 0.
    positions = (mask.cumsum(1) - 1).clamp(min=0)[:, -embeddings.shape[1] :]
    call = {"attention_mask": mask, "position_ids": positions, "past_key_values": cache, "use_cache": True}
    logits: torch.Tensor = model.llm(inputs_embeds=embeddings, **call, logits_to_keep=1).logits
    return logits[:, -1].float()


def _read(
    model: OctopiForCausalLM, prompts: Sequence[Sequence[int]], features: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, Cache, torch.Tensor]:
    """Logits behind each prompt, the cache, and which of its columns a row sees; prompts are padded on the left."""
    device, config = model.connector.delimiters.device, model.llm.config
    shared, parts = 0, [list(range(len(prompts)))]
    # Caches of sliding-window layers have dropped tokens, so they can neither share a prefix nor be joined.
    if extendable(config):
        # The common prefix ends before the first video and leaves each prompt a token at least.
        most = min(map(len, prompts)) - 1
        while shared < most and prompts[0][shared] != model.start_id and len({p[shared] for p in prompts}) == 1:
            shared += 1
        parts = _parts([len(p) - shared for p in prompts])
    begun = roomy_cache(config)
    if shared:
        ids = torch.tensor([prompts[0][:shared]], device=device)
        _step(model, model.embed_words(ids), torch.ones_like(ids), begun)
    logits, masks, caches = [], [], []
    for rows in parts:
        cache = copy.deepcopy(begun)
        if shared:
            cache.batch_repeat_interleave(len(rows))
        suffixes = [torch.tensor(prompts[row][shared:]) for row in rows]
        ids = pad_sequence(suffixes, batch_first=True, padding_side="left").to(device)
        real = pad_sequence([torch.ones_like(s) for s in suffixes], batch_first=True, padding_side="left").to(device)
        mask = F.pad(real, (shared, 0), value=1)
        embeddings = model.embed(ids, pad_sequence([features[row] for row in rows], batch_first=True).to(device))
        logits.append(_step(model, embeddings, mask, cache))
        masks.append(mask)
        caches.append(cache)
    if len(parts) == 1:
        return logits[0], caches[0], masks[0]
    width = max(mask.shape[1] for mask in masks)
    whole = roomy_cache(config)
    for layer in whole.layers:
        own = [cache.layers.pop(0) for cache in caches]  # Popped, so that no keys and values are held twice.
        keys, values = ([getattr(each, kind) for each in own] for kind in ("keys", "values"))
        layer.update(*(torch.cat([F.pad(s, (0, 0, width - s.shape[-2], 0)) for s in x]) for x in (keys, values)))
    return torch.cat(logits), whole, torch.cat([F.pad(mask, (width - mask.shape[1], 0)) for mask in masks])


def _parts(lengths: Sequence[int]) -> list[list[int]]:
    """Split rows, in order, into parts of at most `READ` tokens with their padding; a part has one row at least."""
    parts: list[list[int]] = [[]]
    for row in range(len(lengths)):
        longer = [*parts[-1], row]
        if parts[-1] and len(longer) * max(lengths[r] for r in longer) > READ:
            parts.append([row])
        else:
            parts[-1] = longer
    return parts
