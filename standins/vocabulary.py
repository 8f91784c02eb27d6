"""Tokenizers with a hand-picked vocabulary: whole words, and bytes for everything else.

A word of the vocabulary is one token, with or without a space before it; any other text falls back to its UTF-8
bytes, so every text can be encoded and decoded exactly. There are no learnt merges: byte-level BPE looks a piece up
as a whole first (`ignore_merges`) and, with an empty merge list, splits it into bytes where that fails.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerFast

PAD, BOS, EOS = SPECIAL = ("<pad>", "<s>", "</s>")
WORD = re.compile(r"[^\W\d_]+")


def words_of(texts: Iterable[str]) -> set[str]:
    """The words in some texts, as the tokenizer splits them."""
    return {word for text in texts for word in WORD.findall(text)}


def build_tokenizer(
    words: Iterable[str], phrases: Iterable[str] = (), *, closed: bool = False
) -> PreTrainedTokenizerFast:
    """Make a fast tokenizer.

    Args:
        words: Each becomes two tokens: as it is, and with a space before.
        phrases: Several words with a space before them that become one token, such as "moderately hard".
        closed: Also put the end token behind every text (CLIP), not only the start token before it (Llama).
    """
    from tokenizers import Regex, Tokenizer, decoders, models, pre_tokenizers, processors
    from transformers import PreTrainedTokenizerFast

    raw = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False, trim_offsets=False)
    singles = sorted(set(words))
    joined = sorted({f" {p}" for p in phrases}, key=lambda p: (-len(p), p))
    pieces = [*singles, *(f" {w}" for w in singles), *joined]
    entries = [*SPECIAL, *sorted(raw.alphabet()), *(_as_bytes(raw, piece) for piece in pieces)]
    vocabulary = {entry: index for index, entry in enumerate(dict.fromkeys(entries))}
    tokenizer = Tokenizer(models.BPE(vocab=vocabulary, merges=[], ignore_merges=True))
    options = "|".join(
        [*(rf"{re.escape(p)}(?!\p{{L}})" for p in joined), r" ?\p{L}+", r" ?\p{N}", r" ?[^\s\p{L}\p{N}]", r"\s"]
    )
    tokenizer.pre_tokenizer = pre_tokenizers.Sequence([pre_tokenizers.Split(Regex(options), "isolated"), raw])
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens(list(SPECIAL))
    tokenizer.post_processor = processors.TemplateProcessing(
        single=f"{BOS} $A {EOS}" if closed else f"{BOS} $A",
        special_tokens=[(token, vocabulary[token]) for token in (BOS, EOS)],
    )
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, bos_token=BOS, eos_token=EOS, pad_token=PAD, clean_up_tokenization_spaces=False
    )


def _as_bytes(raw: object, piece: str) -> str:
    return "".join(part for part, _ in raw.pre_tokenize_str(piece))  # type: ignore[attr-defined]
