"""The renderer: what training and evaluation see is the same text, and only answers carry labels."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from transformers import PreTrainedTokenizerBase

from pipeline.language.base import load_tokenizer
from pipeline.language.chat import IGNORE_INDEX, TACT_END, TACT_FRAME, TACT_START, encode, render
from pipeline.records import Assignment, Part, Question, Turn
from pipeline.tasks import TASKS
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.videos.catalogue import load_catalogue
from tests.checkpoints import write_llama
from tests.closure import ROOT

WORDS = st.text(
    alphabet=st.characters(codec="utf-8", exclude_categories=("Cs",), exclude_characters="<>{}"), max_size=60
)


@pytest.fixture(scope="module", params=["random", "standin"])
def tokenizer(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> PreTrainedTokenizerBase:
    if request.param == "standin":
        return load_tokenizer(ROOT / "standins" / "llama")
    return load_tokenizer(write_llama(tmp_path_factory.mktemp("llama")))


@pytest.fixture(scope="module")
def questions() -> list[Question]:
    catalogue = load_catalogue(ROOT / "pipeline" / "physiclear")
    videos = [
        Assignment(video_id=f"{o}_{n}", object_id=o, part=Part.TEST)
        for o in list(catalogue.objects)[::3]
        for n in (0, 1)
    ]
    return build_questions(pool_of(Part.TEST, videos, catalogue), dict.fromkeys(TASKS, 12), seed=1, distinct=True)


def test_vicuna_layout() -> None:
    turns = [Turn(user="Feel {tactile}.", assistant="Soft."), Turn(user="Sure?", assistant="Yes.")]
    rendered = render(turns, system_prompt="Be kind.", frames=2, eos="</s>", complete=True)
    assert rendered.text == (
        f"Be kind. USER: Feel {TACT_START}{TACT_FRAME}{TACT_FRAME}{TACT_END}. ASSISTANT: Soft.</s>"
        "USER: Sure? ASSISTANT: Yes.</s>"
    )
    assert [rendered.text[a:b] for a, b in rendered.answers] == [" Soft.</s>", " Yes.</s>"]


def test_every_question_is_prompted_as_it_was_trained(
    tokenizer: PreTrainedTokenizerBase, questions: list[Question]
) -> None:
    eos = str(tokenizer.eos_token)
    for question in questions:
        for dialogue in question.dialogues:
            for last in range(1, len(dialogue.turns) + 1):
                turns = dialogue.turns[:last]
                full = encode(render(turns, system_prompt="", frames=5, eos=eos, complete=True), tokenizer)
                asked = encode(render(turns, system_prompt="", frames=5, eos=eos, complete=False), tokenizer)
                assert full.input_ids[: len(asked.input_ids)] == asked.input_ids
                assert set(asked.labels[-3:]) == {IGNORE_INDEX}
                answer = [i for i, y in zip(full.input_ids, full.labels, strict=True) if y != IGNORE_INDEX]
                assert answer[-1] == tokenizer.eos_token_id, "the model must learn to stop"
                said = " ".join(t.assistant for t in turns)
                heard = tokenizer.decode(answer, skip_special_tokens=True)
                assert heard.split() == said.split(), "labels are exactly the answers"


def test_each_video_has_its_frames(tokenizer: PreTrainedTokenizerBase, questions: list[Question]) -> None:
    start, frame, end = tokenizer.convert_tokens_to_ids([TACT_START, TACT_FRAME, TACT_END])
    for question in questions:
        for dialogue in question.dialogues:
            ids = encode(
                render(dialogue.turns, system_prompt="", frames=5, eos="</s>", complete=True), tokenizer
            ).input_ids
            assert ids.count(frame) == 5 * len(question.videos)
            assert ids.count(start) == ids.count(end) == len(question.videos)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(WORDS, WORDS), min_size=1, max_size=3))
def test_labels_cover_answers_for_any_text(tokenizer: PreTrainedTokenizerBase, talk: list[tuple[str, str]]) -> None:
    turns = [Turn(user=u, assistant=a) for u, a in talk]
    encoded = encode(render(turns, system_prompt="", frames=1, eos="</s>", complete=True), tokenizer)
    labelled = [i for i, y in zip(encoded.input_ids, encoded.labels, strict=True) if y != IGNORE_INDEX]
    assert labelled.count(tokenizer.eos_token_id) == len(turns)
    assert len(encoded.input_ids) == len(encoded.labels)
    assert encoded.labels[0] == IGNORE_INDEX


def test_padding_is_not_the_end_token(tmp_path: Path, tokenizer: PreTrainedTokenizerBase) -> None:
    assert tokenizer.pad_token_id != tokenizer.eos_token_id
    folder = write_llama(tmp_path)
    config = folder / "tokenizer_config.json"
    config.write_text(config.read_text().replace('"pad_token": "<pad>",', ""))
    bare = load_tokenizer(folder)
    assert bare.pad_token_id == bare.unk_token_id
