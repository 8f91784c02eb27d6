"""Any tokenizer's own chat format: what is labelled, what ends an answer, and templates that are refused.

The reference is transformers' own: the same format written with its `generation` blocks, whose tokens it marks.
"""

import io
from contextlib import suppress
from datetime import date
from itertools import pairwise, takewhile
from pathlib import Path
from unittest import mock

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers
from transformers import AutoTokenizer, PreTrainedTokenizerBase, PreTrainedTokenizerFast

from pipeline.core.records import Turn
from pipeline.language.base import load_llm, load_tokenizer
from pipeline.language.chat import IGNORE_INDEX, TACTILE, add_tactile_tokens, encode, end_ids, render
from pipeline.running.errors import UserError
from tests.checkpoints import edit, write_llama
from tests.conftest import refused

VICUNA = (
    "{% for m in messages %}{% if m.role == 'system' %}{{ m.content }} "
    "{% elif m.role == 'user' %}USER: {{ m.content }} ASSISTANT:"
    "{% else %}{% generation %} {{ m.content }}{{ eos_token }}{% endgeneration %}{% endif %}{% endfor %}"
)
PSR = (
    Turn(user=f"Feel {TACTILE} and {TACTILE}. Describe both.", assistant="a) It is soft.\n\nb) It is hard — très dur."),
    Turn(user="Which is better for a wound?", assistant="The first, since 1 < 2."),
)
WORDS = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",), exclude_characters="<>{}"), max_size=40)


def sentence_piece() -> PreTrainedTokenizerFast:
    """As Llama's: spaces are letters, words split before them, unknown letters as bytes, a token begins a text."""
    tokenizer = Tokenizer(models.BPE(unk_token="<unk>", byte_fallback=True, fuse_unk=True))
    tokenizer.pre_tokenizer = pre_tokenizers.Metaspace(prepend_scheme="first")
    tokenizer.decoder = decoders.Sequence([decoders.Replace("▁", " "), decoders.ByteFallback(), decoders.Fuse()])
    special = ["<unk>", "<s>", "</s>"]
    letters = [f"<0x{byte:02X}>" for byte in range(256)]
    trainer = trainers.BpeTrainer(vocab_size=420, special_tokens=special + letters, show_progress=False)
    tokenizer.train_from_iterator([f"USER: {t.user} ASSISTANT: {t.assistant}" for t in PSR], trainer)
    tokenizer.post_processor = processors.TemplateProcessing(single="<s> $A", special_tokens=[("<s>", 1)])
    named = {"bos_token": "<s>", "eos_token": "</s>", "unk_token": "<unk>", "pad_token": "<unk>"}
    return PreTrainedTokenizerFast(tokenizer_object=tokenizer, **named)


@pytest.fixture(scope="module", params=[pytest.param("smollm2", marks=pytest.mark.slow), "bytes", "sentence pieces"])
def spoken(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[object, str]:
    """A tokenizer, and its format with `generation` blocks."""
    if request.param == "smollm2":
        tokenizer = AutoTokenizer.from_pretrained(request.getfixturevalue("smollm2_folder"))
        said = "message['content'] + '<|im_end|>' + '\n'"
        assert said in tokenizer.chat_template
        template = tokenizer.chat_template.replace(
            "+ '\n' + " + said,
            "+ '\n' }}{% if message['role'] == 'assistant' %}{% generation %}{{ message['content'] + '<|im_end|>' }}"
            "{% endgeneration %}{% else %}{{ message['content'] + '<|im_end|>' }}{% endif %}{{ '\n'",
        )
    elif request.param == "bytes":
        tokenizer = AutoTokenizer.from_pretrained(write_llama(tmp_path_factory.mktemp("llama")))
        template = VICUNA
    else:
        tokenizer, template = sentence_piece(), VICUNA
    add_tactile_tokens(tokenizer)
    return tokenizer, template


def reference(
    turns: tuple[Turn, ...], tokenizer: PreTrainedTokenizerBase, template: str, system: str, frames: int
) -> tuple[list[int], list[int]]:
    """Token ids and labels by transformers alone."""
    video = "<tact_start>" + frames * "<tact_frame>" + "<tact_end>"
    said = [("system", system)] if system else []
    for turn in turns:
        said += [("user", turn.user.replace(TACTILE, video)), ("assistant", turn.assistant)]
    messages = [{"role": role, "content": text} for role, text in said]
    found = tokenizer.apply_chat_template(
        messages, chat_template=template, return_assistant_tokens_mask=True, return_dict=True
    )
    ids = found["input_ids"]
    labels = [i if own else IGNORE_INDEX for i, own in zip(ids, found["assistant_masks"], strict=True)]
    if tokenizer.chat_template is None:
        # Without a template, the tokenizer itself begins the text.
        return [tokenizer.bos_token_id, *ids], [IGNORE_INDEX, *labels]
    return ids, labels


TURNS = st.builds(Turn, user=WORDS, assistant=WORDS.map("It is {}".format))
TALKS = st.lists(TURNS, min_size=1, max_size=3).map(tuple)


@settings(max_examples=30)
@given(turns=TALKS | st.sampled_from([PSR, PSR[:1]]), system=st.sampled_from(["", "Be kind."]))
def test_any_text_as_trained(spoken: tuple[PreTrainedTokenizerBase, str], turns: tuple[Turn, ...], system: str) -> None:
    """Labels are those of transformers, one end token an answer, and prompts begin the conversation."""
    tokenizer, template = spoken
    how = {"system_prompt": system, "frames": 5}
    encoded = encode(render(turns, tokenizer, complete=True, **how), tokenizer)
    assert (list(encoded.input_ids), list(encoded.labels)) == reference(turns, tokenizer, template, system, frames=5)
    for number in range(1, len(turns) + 1):
        asked = encode(render(turns[:number], tokenizer, complete=False, **how), tokenizer)
        assert encoded.input_ids[: len(asked.input_ids)] == asked.input_ids
        assert encoded.labels[len(asked.input_ids)] != IGNORE_INDEX
        assert sum(label in end_ids(tokenizer) for label in asked.labels) == number - 1
    assert sum(label in end_ids(tokenizer) for label in encoded.labels) == len(turns)


IM = "<|im_start|>{role}\n{text}<|im_end|>\n"
CHATML = (
    "{% for m in messages %}<|im_start|>{{ m.role }}\n{{ m.content }}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}"
)
LLAMA3 = (
    "{{ bos_token }}{% for m in messages %}<|head|>{{ m.role }}<|/head|>\n\n{{ m.content | trim }}<|eot|>{% endfor %}"
    "{% if add_generation_prompt %}<|head|>assistant<|/head|>\n\n{% endif %}"
)
"""As Llama-3 writes it, with shorter names."""
QWEN3 = """{%- set ns = namespace(last=-1) %}
{%- for m in messages %}{% if m.role == 'user' %}{% set ns.last = loop.index0 %}{% endif %}{% endfor %}
{%- for m in messages %}
    {%- set content = m.content.split('</think>')[-1].lstrip('\\n') if m.role == 'assistant' else m.content %}
    {%- if m.role == 'assistant' and loop.index0 > ns.last %}
        {{- '<|im_start|>' + m.role + '\\n<think>\\n\\n</think>\\n\\n' + content }}
    {%- else %}
        {{- '<|im_start|>' + m.role + '\\n' + content }}
    {%- endif %}
    {{- '<|im_end|>\\n' }}
{%- endfor %}
{%- if add_generation_prompt %}{{- '<|im_start|>assistant\\n' }}{% endif %}"""
"""As Qwen3 writes it: the last answer alone has a block of thoughts, which is empty, and a prompt has none."""
ALWAYS = CHATML.replace("{{ m.content }}", "{% if m.role == 'assistant' %}[FINAL]{% endif %}{{ m.content }}")
FAMILIES = {
    "chatml": (CHATML, "", IM),
    "qwen3": (QWEN3, "<think>\n\n</think>\n\n", IM),
    "always": (ALWAYS, "[FINAL]", IM),
    "llama3": (LLAMA3, "", "<|head|>{role}<|/head|>\n\n{text}<|eot|>"),
}
"""Templates by family, with what each writes before an answer of its own, and how it writes a message."""
OWN = ("<|im_start|>", "<|im_end|>", "<|head|>", "<|/head|>", "<|eot|>")


@pytest.fixture(scope="module", params=[False, True])
def knows_all(request: pytest.FixtureRequest) -> PreTrainedTokenizerFast:
    """A tokenizer of the families' tokens; those around thoughts may be special ones."""
    tokenizer = sentence_piece()
    tokenizer.add_special_tokens({"additional_special_tokens": list(OWN)})
    tokenizer.add_tokens(["<think>", "</think>"], special_tokens=request.param)
    add_tactile_tokens(tokenizer)
    return tokenizer


@pytest.mark.parametrize("family", FAMILIES)
@settings(max_examples=20)
@given(talk=TALKS)
def test_a_templates_lead_is_not_learnt(
    family: str, knows_all: PreTrainedTokenizerFast, talk: tuple[Turn, ...]
) -> None:
    """Before each answer alike, in training and in every prompt, against the format written by hand."""
    template, lead, message = FAMILIES[family]
    knows_all.chat_template = template
    turns = tuple(Turn(user=f"Feel {t.user}.", assistant=f"{t.assistant}.") for t in talk)
    whole = render(turns, knows_all, system_prompt="", frames=1, complete=True)
    trained = encode(whole, knows_all)
    opening, _, closing = message.format(role="assistant", text="|text|").partition("|text|")
    end = knows_all.convert_tokens_to_ids(closing.strip())
    text = "<s>" if family == "llama3" else ""
    for number, turn in enumerate(turns, 1):
        text += message.format(role="user", text=turn.user) + opening + lead
        prompt = render(turns[:number], knows_all, system_prompt="", frames=1, complete=False)
        assert prompt.text == text
        asked = encode(prompt, knows_all)
        place = len(asked.input_ids)
        assert trained.input_ids[:place] == asked.input_ids
        text += turn.assistant + closing
        learnt = list(takewhile(lambda label: label != IGNORE_INDEX, trained.labels[place:]))
        assert [trained.labels[place - 1], learnt[-1]] == [IGNORE_INDEX, end]
        assert str(knows_all.decode(learnt[:-1])).strip() == turn.assistant
    assert whole.text == text
    assert sum(label != IGNORE_INDEX and a == IGNORE_INDEX for a, label in pairwise(trained.labels)) == len(turns)
    assert end_ids(knows_all) == (2, end)


def test_no_day_is_in_a_conversation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Llama 3.2's template asks for today's: the text is what transformers itself wrote on the day of ours."""
    tokenizer, said = sentence_piece(), [{"role": "user", "content": "a"}, {"role": "assistant", "content": "b"}]
    tokenizer.chat_template = "\n  {% if strftime_now is defined %}{{ strftime_now('%d %b %Y') }}{% endif %}" + VICUNA
    for day in (date(2024, 7, 26), date(2026, 1, 1)):
        monkeypatch.setattr("transformers.utils.chat_template_utils.datetime", mock.Mock(now=lambda day=day: day))
        ours = render([Turn(user="a", assistant="b")], tokenizer, system_prompt="", frames=1, complete=True).text
        assert (ours == tokenizer.apply_chat_template(said, tokenize=False)) == (day.year == 2024)


REFUSED = {
    "{{ messages | length }}{% for m in messages %}{{ m.content }}</s>{% endfor %}": "writes a prompt otherwise once",
    "{% for m in messages %}{{ m.content }}\n{% endfor %}": "ends an answer with none of </s>; the model could not",
    "{{ raise_exception('no\nsystem') }}": r"fails \(no system\); .*empty language.system_prompt",
}


@pytest.mark.parametrize("template", REFUSED)
def test_a_template_that_cannot_be_trained_on_is_one_line(template: str, tmp_path: Path) -> None:
    folder = write_llama(tmp_path)
    (folder / "chat_template.jinja").write_text(template)
    with refused(rf"^language.weights: the chat template in .* {REFUSED[template]}"):
        load_tokenizer(folder)


def test_nothing_that_a_folder_brings_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A configuration may name code of its own; transformers would ask, and run it on "y"."""
    ran, folder = tmp_path / "ran", write_llama(tmp_path / "llama")
    (folder / "own.py").write_text(f'open({str(ran)!r}, "w").close()')
    model, tokenizer = {"AutoConfig": "own.Config", "AutoModelForCausalLM": "own.Model"}, [None, "own.Tokenizer"]
    edit(folder / "config.json", model_type="own", auto_map=model)
    edit(folder / "tokenizer_config.json", tokenizer_class="Tokenizer", auto_map={"AutoTokenizer": tokenizer})
    monkeypatch.setattr("builtins.input", lambda *_: "y")
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n" * 4))
    with suppress(UserError):
        load_tokenizer(folder)
    with refused(r"^language\.weights: "):
        load_llm(folder, torch.float32)
    assert not ran.exists()
