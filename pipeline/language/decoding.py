"""Greedy decoding: what all prompts begin with is read once, and what has ended is computed no further.

transformers' `generate` goes on with all rows until the longest answer ends, and reads what all begin with for each.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator, Sequence

import torch
from torch.nn import functional as F
from transformers import Cache

from pipeline.language.cache import extendable, roomy_cache
from pipeline.language.octopi import OctopiForCausalLM

READ = 1024
"""Tokens of prompts that are read at once: enough for a processor, and neighbours of like length pad little."""
STAYING = 7 / 8
"""Rows leave when no more than this share goes on: their neighbours' keys and values are copied then."""


def greedy(
    model: OctopiForCausalLM,
    prompts: Sequence[Sequence[int]],
    features: Sequence[torch.Tensor],
    ends: Collection[int],
    limits: Sequence[int],
) -> list[list[int]]:
    """All that `greedy_tokens` says: the new tokens of each prompt."""
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
    """The likeliest next token after each prompt, until one that ends an answer (kept) or the limit.

    Args:
        prompts: Token ids, of like length where little is to be spent on padding.
        features: Of each prompt's frames: frames x tactile_dim.
        ends: Ids of tokens that end an answer.
        limits: Most new tokens of each, at least 1. One that is lowered meanwhile ends that row.

    Yields:
        The place of a prompt and its next token, as soon as it is known. In float32 a row's tokens do not depend on
        its neighbours.
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
    """Logits behind the last column, rows x vocabulary, of embeddings at the end of what the mask covers."""
    positions = (mask.cumsum(1) - 1).clamp(min=0)[:, -embeddings.shape[1] :]
    call = {"attention_mask": mask, "position_ids": positions, "past_key_values": cache, "use_cache": True}
    logits: torch.Tensor = model.llm(inputs_embeds=embeddings, **call, logits_to_keep=1).logits
    return logits[:, -1].float()


def _read(
    model: OctopiForCausalLM, prompts: Sequence[Sequence[int]], features: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, Cache, torch.Tensor]:
    """Logits behind each prompt, the cache, and which of its columns a row sees; prompts are padded on the left."""
    device, config = model.connector.delimiters.device, model.llm.config
    if not extendable(config):
        cache = roomy_cache(config)
        logits, mask = _read_part(model, prompts, features, 0, cache)
        return logits, cache, mask
    shared = _shared(prompts, model.start_id)
    begun = roomy_cache(config)
    if shared:
        ids = torch.tensor([prompts[0][:shared]], device=device)
        _step(model, model.embed_words(ids), torch.ones_like(ids), begun)
    parts: list[tuple[torch.Tensor, torch.Tensor, Cache]] = []
    for rows in _parts([len(p) - shared for p in prompts]):
        cache = copy.deepcopy(begun)
        if shared:
            cache.batch_repeat_interleave(len(rows))
        suffixes = [prompts[r][shared:] for r in rows]
        logits, mask = _read_part(model, suffixes, [features[r] for r in rows], shared, cache)
        parts.append((logits, mask, cache))
    width = max(mask.shape[1] for _, mask, _ in parts)
    whole = roomy_cache(config)
    for layer in whole.layers:
        own = [part[2].layers.pop(0) for part in parts]  # Or all would be held twice.
        layer.update(*(torch.cat([_widen(getattr(x, kind), width) for x in own]) for kind in ("keys", "values")))
    masks = [F.pad(mask, (width - mask.shape[1], 0)) for _, mask, _ in parts]
    return torch.cat([logits for logits, _, _ in parts]), whole, torch.cat(masks)


def _read_part(
    model: OctopiForCausalLM,
    prompts: Sequence[Sequence[int]],
    features: Sequence[torch.Tensor],
    before: int,
    cache: Cache,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Logits behind prompts that follow on `before` columns of the cache, and the mask of all columns."""
    device, longest = model.connector.delimiters.device, max(map(len, prompts))
    ids = torch.tensor([[0] * (longest - len(p)) + list(p) for p in prompts], device=device)
    lengths = torch.tensor([len(p) for p in prompts], device=device)
    mask = (torch.arange(longest, device=device) >= longest - lengths[:, None]).long()
    mask = F.pad(mask, (before, 0), value=1)
    padded = torch.nn.utils.rnn.pad_sequence(list(features), batch_first=True).to(device)
    return _step(model, model.embed(ids, padded), mask, cache), mask


def _shared(prompts: Sequence[Sequence[int]], stop: int) -> int:
    """How many tokens all prompts begin with alike, before the first video, and not all of any."""
    count, most = 0, min(map(len, prompts)) - 1
    while count < most and prompts[0][count] != stop and len({p[count] for p in prompts}) == 1:
        count += 1
    return count


def _parts(lengths: Sequence[int]) -> list[list[int]]:
    """Neighbours, of at most `READ` tokens together with their padding, at least one."""
    parts: list[list[int]] = []
    for row in range(len(lengths)):
        last = [*parts[-1], row] if parts else []
        if parts and len(last) * max(lengths[r] for r in last) <= READ:
            parts[-1] = last
        else:
            parts.append([row])
    return parts


def _widen(states: torch.Tensor, width: int) -> torch.Tensor:
    return F.pad(states, (0, 0, width - states.shape[-2], 0))
