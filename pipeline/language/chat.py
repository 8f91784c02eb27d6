"""Rendering of a conversation as text, one for training and evaluation, so that both use the same format.

The chat format is the tokenizer's own template where it has one, else Vicuna v1.5's; or the published code's, which
encodes a conversation piece by piece. A video in a question becomes `<tact_start>`, one `<tact_frame>` a frame and
`<tact_end>`; the model puts tactile embeddings in the frames' places.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from datetime import date
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

from jinja2 import TemplateError

from pipeline.config import ChatFormat
from pipeline.core.records import Turn
from pipeline.running.errors import UserError

if TYPE_CHECKING:
    from transformers import PreTrainedTokenizerBase

TACTILE = "{tactile}"
TACT_START, TACT_FRAME, TACT_END = TACTILE_TOKENS = ("<tact_start>", "<tact_frame>", "<tact_end>")
VICUNA = (
    "{% for m in messages %}{% if m.role == 'system' %}{{ m.content }} {% elif m.role == 'user' %}"
    "USER: {{ m.content }} ASSISTANT:{% else %} {{ m.content }}{{ eos_token }}{% endif %}{% endfor %}"
)
"""Vicuna v1.5's format (FastChat's `vicuna_v1.1`): `SYSTEM USER: question ASSISTANT: answer</s>USER: ...`."""
PROBE = "Octopi"
"""A placeholder, rendered to find out what a chat template writes around an answer."""
DAY = date(2024, 7, 26)
"""What templates that ask for today are told (Llama 3.2's), so that a prompt is the same on every day."""
TOLD = "".join(f" | replace('%{letter}', '{DAY:%{letter}}')" for letter in "aAbBcdfHIjmMpSUwWxXyYzZ")
TODAY = "{% macro strftime_now(form) %}{{ form" + TOLD + " }}{% endmacro %}\n"
"""Put before a template, in place of transformers' own function; the line end is swallowed."""
PIECE = "\ue000"
"""Stands before each piece of text that the published format encodes by itself; no text has this character."""
BLANK = "▁"
"""How SentencePiece writes a blank."""
IGNORE_INDEX = -100
"""Label of a token that the loss leaves out (torch's and transformers' convention)."""


class Rendered(NamedTuple):
    """A conversation as text, with the character spans that the assistant says, end token included.

    What a template writes of its own before an answer, such as an empty block of thoughts, belongs to the prompt.
    """

    text: str
    answers: tuple[tuple[int, int], ...]


class Encoded(NamedTuple):
    """Token ids of a conversation and the labels of the same length, `IGNORE_INDEX` outside the answers."""

    input_ids: tuple[int, ...]
    labels: tuple[int, ...]


def add_tactile_tokens(tokenizer: PreTrainedTokenizerBase) -> None:
    """Add the three tactile tokens as special tokens; does nothing where they are there already."""
    missing = [t for t in TACTILE_TOKENS if t not in tokenizer.get_vocab()]
    tokenizer.add_special_tokens({"additional_special_tokens": missing}, replace_extra_special_tokens=False)


def render(
    turns: Sequence[Turn],
    tokenizer: PreTrainedTokenizerBase,
    *,
    system_prompt: str,
    frames: int,
    complete: bool,
    chat: ChatFormat = "template",
    single: bool | None = None,
) -> Rendered:
    """Write a conversation out.

    Args:
        tokenizer: Whose template writes it; without one, Vicuna's with its end token.
        system_prompt: Put before the first turn. Where it is empty nothing is, or what the template puts there itself.
        frames: Tactile embeddings a video.
        complete: With the last answer (training), or up to where it is to be generated.
        chat: As `language.chat`.
        single: Whether the conversation ends after one turn, by which the published format differs; by default, whether
            it has one so far.

    Raises:
        UserError: for a template that fails, that writes a conversation's beginning otherwise once it goes on (a
            model would be asked what it was not trained on), or that ends answers with no end token.
    """
    if chat == "published":
        single = len(turns) == 1 if single is None else single
        return _published(turns, str(tokenizer.eos_token), system_prompt, frames, complete, single)
    video = TACT_START + TACT_FRAME * frames + TACT_END
    messages = [{"role": "system", "content": system_prompt}] if system_prompt else []
    written = []
    for turn in turns:
        messages.append({"role": "user", "content": turn.user.replace(TACTILE, video)})
        written.append(_templated(messages, tokenizer, ask=True))
        messages.append({"role": "assistant", "content": turn.assistant})
    if complete:
        written.append(_templated(messages, tokenizer, ask=False))
    where, (lead, _) = f"language.weights: the chat template in {tokenizer.name_or_path}", _around_answers(tokenizer)
    text, starts = "", []
    for before, longer in pairwise(["", *written]):
        if not longer.startswith(before):
            raise UserError(f"{where} writes a prompt otherwise once it is answered; take one that only appends")
        added = longer.removeprefix(before)
        # Some templates (Qwen3's) write a prefix, such as an empty block of thoughts, only before the last answer. At
        # generation every answer is the last one, so each gets the prefix here.
        text += added if not before or added.startswith(lead) else lead + added
        starts.append(len(text) + len(lead))
    ends, answers = [str(tokenizer.convert_ids_to_tokens(i)) for i in end_ids(tokenizer)], []
    for start in starts[:-1]:
        stops = [place + len(end) for end in ends if (place := text.find(end, start)) >= 0]
        if not stops:
            raise UserError(f"{where} ends an answer with none of {', '.join(ends)}; the model could not learn to stop")
        answers.append((start, min(stops)))
    return Rendered(text if complete else text + lead, tuple(answers))


def end_ids(tokenizer: PreTrainedTokenizerBase) -> tuple[int, ...]:
    """Ids of the tokens that end an answer: the end token, and the one that the template writes behind an answer.

    They differ for some: Llama-3's instruct models end a turn with `<|eot_id|>`, a text with `<|end_of_text|>`.
    """
    _, rest = _around_answers(tokenizer)
    special = {i for i, token in tokenizer.added_tokens_decoder.items() if token.special}
    behind = [i for i in tokenizer(rest, add_special_tokens=False)["input_ids"] if i in special]
    return tuple(dict.fromkeys([int(tokenizer.eos_token_id), *behind[:1]]))


def encode(rendered: Rendered, tokenizer: PreTrainedTokenizerBase, *, bos: bool = True) -> Encoded:
    """Tokenise a whole conversation at once and label the answers' tokens by their character offsets.

    Tokenising in one piece keeps prompt tokens equal in training and evaluation, whatever the tokenizer does at
    the borders of pieces. With `bos` it begins with the begin token. The published format is tokenised by its pieces.
    """
    if rendered.text.startswith(PIECE):
        places = list(_pieces(rendered.text, tokenizer))
        begin = [(tokenizer.bos_token_id, 0, 0)] if bos and tokenizer.bos_token_id is not None else []
        found = [*begin, *places]
    else:
        # What the tokenizer's own template writes has a begin token of its own, where it wants one.
        own = bos and not tokenizer.chat_template
        batch = tokenizer(rendered.text, return_offsets_mapping=True, add_special_tokens=own)
        found = [(i, a, b) for i, (a, b) in zip(batch["input_ids"], batch["offset_mapping"], strict=True)]
    labels = [
        token if any(start <= a and b <= stop and a < b for start, stop in rendered.answers) else IGNORE_INDEX
        for token, a, b in found
    ]
    return Encoded(tuple(token for token, *_ in found), tuple(labels))


def _published(turns: Sequence[Turn], end: str, system: str, frames: int, complete: bool, single: bool) -> Rendered:
    """A conversation as the published code writes it, with `PIECE` before each piece.

    A conversation of one turn is written as its trainings are, a longer one as its script for chats (`interact.py`).
    """
    video = f"{TACT_START}{PIECE}{TACT_FRAME * frames}{PIECE}{TACT_END}"
    told = f"{system}\n\n" if system else ""
    text, answers = "", []
    for number, turn in enumerate(turns):
        if single:
            before, ask = ["USER", ": ", *([told] if told else [])], ["\n", "ASSISTANT: "]
        else:
            before, ask = [f"{told}USER: " if number == 0 else "\nUSER: "], ["\nASSISTANT:"]
        pieces = [*before, turn.user.replace(TACTILE, video), *ask]
        text += "".join(piece if piece.startswith(PIECE) else PIECE + piece for piece in pieces)
        if complete or number < len(turns) - 1:
            start = len(text)
            text += PIECE + turn.assistant + end
            answers.append((start, len(text)))
    return Rendered(text, tuple(answers))


def _pieces(text: str, tokenizer: PreTrainedTokenizerBase) -> Iterator[tuple[int, int, int]]:
    """Tokens of a text in pieces, each with the place in the text where it starts and stops.

    SentencePiece puts a blank before each piece. The published code adds its tactile tokens as such that swallow the
    blank before them, so that none stands before `<tact_start>`, and what follows `<tact_end>` gets none of its own.
    transformers has read both otherwise in different versions, so that here the vocabulary itself is asked.
    """
    vocabulary, end = tokenizer.get_vocab(), str(tokenizer.eos_token)
    if BLANK not in vocabulary:
        for piece in re.finditer(f"[^{PIECE}]+", text):
            batch = tokenizer(piece[0], return_offsets_mapping=True, add_special_tokens=False)
            for token, (a, b) in zip(batch["input_ids"], batch["offset_mapping"], strict=True):
                yield token, piece.start() + a, piece.start() + b
        return
    # The end token cuts a piece, and what stands behind it gets a blank again.
    for part in re.finditer(f"{re.escape(end)}|(?:(?!{re.escape(end)})[^{PIECE}])+", text):
        if part[0] == end:
            yield vocabulary[end], *part.span()
            continue
        written, at = BLANK + part[0].replace(" ", BLANK), part.start() - 1
        tactile = "|".join(TACTILE_TOKENS)
        for run in re.finditer(f"{BLANK}?({tactile})|(?:(?!{BLANK}?(?:{tactile})).)+", written, flags=re.DOTALL):
            if run[1]:
                yield vocabulary[run[1]], at + run.start(), at + run.end()
                continue
            raw = run[0].encode()
            for token in tokenizer.backend_tokenizer.model.tokenize(run[0]):
                # Of a character that is spread over tokens, each of them covers the whole.
                a = len(raw[: token.offsets[0]].decode(errors="ignore"))
                b = len(raw[: token.offsets[1]].decode(errors="replace"))
                yield token.id, at + run.start() + a, at + run.start() + b


def _templated(messages: Sequence[dict[str, str]], tokenizer: PreTrainedTokenizerBase, *, ask: bool) -> str:
    """Render messages by the tokenizer's template, or Vicuna's; `ask` appends what it writes before an answer."""
    try:
        template = TODAY + (tokenizer.get_chat_template() if tokenizer.chat_template else VICUNA)
        how = {"chat_template": template, "tokenize": False, "add_generation_prompt": ask}
        return str(tokenizer.apply_chat_template(list(messages), **how))
    except (TemplateError, ValueError) as error:
        raise UserError(
            f"language.weights: the chat template in {tokenizer.name_or_path} fails ({' '.join(str(error).split())}); "
            "where it knows no system message, empty language.system_prompt"
        ) from None


def _around_answers(tokenizer: PreTrainedTokenizerBase) -> tuple[str, str]:
    """What the template writes of its own between a prompt and the answer's text, and behind that."""
    messages = [{"role": "user", "content": "a"}, {"role": "assistant", "content": PROBE}]
    before, _, behind = _templated(messages, tokenizer, ask=False).rpartition(PROBE)
    # The space before a word belongs to its token.
    return before.removeprefix(_templated(messages[:1], tokenizer, ask=True)).rstrip(" "), behind
