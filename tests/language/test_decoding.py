"""Greedy decoding against transformers' own, row for row; answers by hand, at the limits of tokens and positions."""

import copy
from pathlib import Path

import pytest
import torch
from torch.nn import functional as F
from transformers import DynamicCache, LlamaForCausalLM, MistralConfig, MistralForCausalLM

from pipeline.config import LanguageConfig
from pipeline.core.records import Opd, Question, Turn
from pipeline.language import decoding
from pipeline.language.cache import AHEAD, roomy_cache
from pipeline.language.chat import IGNORE_INDEX, encode, render
from pipeline.language.conversations import evaluation_features
from pipeline.language.decoding import greedy
from pipeline.language.generate import answer, write_prompt
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import assemble
from pipeline.training.embeddings import EmbeddingStore
from tests.checkpoints import write_llama
from tests.conftest import refused
from tests.language.conftest import DIM, FRAMES, LORA, adapted, generation, material, taking

MANY = (5, 9, 13, 40, 41)
"""Tokens that end an answer: so many that rows end at different places."""


def by_transformers(model: OctopiForCausalLM, ids: list[int], features: torch.Tensor, limit: int) -> list[int]:
    """What follows one prompt, alone and without padding, by `generate` and its own cache."""
    row = torch.tensor([ids])
    given = {"inputs_embeds": model.embed(row, features[None]), "attention_mask": torch.ones_like(row)}
    how = {"max_new_tokens": limit, "do_sample": False, "eos_token_id": list(MANY), "pad_token_id": 0}
    return list(map(int, model.llm.generate(**given, **how)[0]))


def asked(model: OctopiForCausalLM, shared: int) -> tuple[list[list[int]], list[torch.Tensor]]:
    """Prompts of 3 to 30 tokens behind so many that are alike, every other one with frames."""
    draw = torch.Generator().manual_seed(shared)
    begun = torch.randint(4, 250, (shared,), generator=draw).tolist()
    prompts, features = [], []
    for number in range(9):
        ids = torch.randint(4, 250, (3 + (7 * number) % 28,), generator=draw).tolist()
        frames = 2 * (number % 2)
        video = [model.start_id, *[model.frame_id] * frames, model.end_id] if frames else []
        prompts.append([*begun, *video, *ids])
        features.append(torch.randn(frames, DIM, generator=draw))
    return prompts, features


def mistral(window: int | None) -> MistralForCausalLM:
    """Its layers see the last `window` tokens alone."""
    shapes = {"hidden_size": 32, "intermediate_size": 64, "num_hidden_layers": 2, "num_attention_heads": 4}
    return MistralForCausalLM(MistralConfig(vocab_size=260, num_key_value_heads=2, sliding_window=window, **shapes))


@pytest.fixture(scope="module", params=["llama", "window"])
def steady(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> OctopiForCausalLM:
    """A Llama, and a model whose layers see the last eight tokens alone."""
    folder = write_llama(tmp_path_factory.mktemp("llama"), seed=4)
    if request.param == "window":
        torch.manual_seed(2)
        mistral(window=8).save_pretrained(folder)
    torch.manual_seed(1)
    return OctopiForCausalLM.from_base(folder, DIM).eval()


@pytest.mark.parametrize(("shared", "read"), [(0, 1024), (1, 60), (25, 1), (25, 60)])
def test_each_row_as_alone(steady: OctopiForCausalLM, shared: int, read: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one part, in several, in as many as rows; each to its own limit or end."""
    monkeypatch.setattr(decoding, "READ", read)
    prompts, features = asked(steady, shared)
    limits = [1 + (5 * number) % 17 for number in range(len(prompts))]
    found = greedy(steady, prompts, features, MANY, limits)
    with torch.inference_mode():
        assert found == [by_transformers(steady, *each) for each in zip(prompts, features, limits, strict=True)]
    assert len({len(row) for row in found}) > 3, "rows end at different places"


def test_equal_prompts_and_a_prompt_that_begins_another(steady: OctopiForCausalLM) -> None:
    """What is shared is never the whole of a prompt."""
    ids = [7, 8, 9, 10]
    prompts, none = [ids, ids, [*ids, 11], ids[:1]], [torch.zeros(0, DIM)] * 4
    alone = [greedy(steady, [p], none[:1], (), [6])[0] for p in prompts]
    assert greedy(steady, prompts, none, (), [6] * 4) == alone
    assert greedy(steady, prompts[:3], none[:3], (), [6] * 3) == alone[:3]


@pytest.mark.parametrize("trained", ["connector", "lora", "words"])
@pytest.mark.parametrize("kind", ["shared", "one row", "nothing shared", "no frames", "checkpointing"])
def test_loss_and_gradients_are_those_of_all_at_once(language: LanguageConfig, trained: str, kind: str) -> None:
    torch.manual_seed(3)
    model = OctopiForCausalLM.from_base(language.weights, DIM).eval()
    if trained == "lora":
        adapted(model, LORA.model_copy(update={"target_modules": "all-linear"}))
    if trained == "words":
        model.train_words()
    model.double()
    if kind == "checkpointing":
        model.train().llm.gradient_checkpointing_enable(gradient_checkpointing_kwargs={"use_reentrant": False})
    ids = torch.randint(4, 250, (1 if kind == "one row" else 3, 24))
    if kind != "nothing shared":
        ids[1:, :10] = ids[0, :10]
    features = torch.randn(len(ids), 2, DIM, dtype=torch.float64)
    if kind != "no frames":
        ids[:, 12:16] = torch.tensor([model.start_id, model.frame_id, model.frame_id, model.end_id])
    labels = ids.clone()
    labels[:, :17] = IGNORE_INDEX
    parameters = [p for p in model.parameters() if p.requires_grad]

    def gradients(loss: torch.Tensor) -> list[torch.Tensor]:
        found = torch.autograd.grad(loss, parameters, allow_unused=True)
        return [torch.zeros_like(p) if g is None else g for p, g in zip(parameters, found, strict=True)]

    loss = model(ids, features, labels=labels).loss
    logits = model(ids, features).logits
    expected = F.cross_entropy(logits[:, :-1].flatten(0, 1), labels[:, 1:].flatten())
    torch.testing.assert_close(loss, expected, atol=1e-6, rtol=0)
    if kind == "no frames" and trained == "connector":
        assert not loss.requires_grad or max(float(g.abs().max()) for g in gradients(loss)) == 0
        return
    for found, whole in zip(gradients(loss), gradients(expected), strict=True):
        # transformers' normalisation computes in float32 whatever it is given.
        torch.testing.assert_close(found, whole, atol=1e-6, rtol=1e-5)


def test_what_all_rows_begin_with_is_read_for_one(language: LanguageConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    model = OctopiForCausalLM.from_base(language.weights, DIM).eval()
    places: list[int] = []
    model.llm.model.layers[0].mlp.register_forward_pre_hook(lambda _, given: places.append(given[0][..., 0].numel()))
    ids = torch.randint(4, 250, (4, 30), generator=torch.Generator().manual_seed(0))
    ids[:, :20] = ids[0, :20]
    ids[:, 20:23] = torch.tensor([model.start_id, model.frame_id, model.end_id])
    labels, features = ids.clone(), torch.randn(4, 1, DIM)
    labels[:, :25] = IGNORE_INDEX
    model(ids, features, labels=labels)
    assert sum(places) <= 20 + 4 * (30 - 20 + 1)
    places.clear()
    greedy(model, ids.tolist(), list(features), (), [1, 1, 1, 9])
    assert sum(places) == 20 + 4 * 10 + 8, "who has ended is computed no further"


@pytest.mark.parametrize("tied", [False, True])
def test_answers_are_those_of_a_llama_with_these_embeddings(tied: bool, tmp_path: Path) -> None:
    """Prompts that begin alike, read without a cache by transformers' own Llama, whose head is the old one."""
    folder = write_llama(tmp_path, tie_word_embeddings=tied)
    model = OctopiForCausalLM.from_base(folder, DIM).eval()
    torch.nn.init.normal_(model.train_words().weight, generator=torch.manual_seed(5))
    plain = LlamaForCausalLM.from_pretrained(folder)
    plain.lm_head.weight = torch.nn.Parameter(plain.lm_head.weight.detach().clone())
    plain.model.embed_tokens.weight = torch.nn.Parameter(model.words.weight.detach().clone())
    prompts = [[1, 50, 60, 70, 80, 90], [1, 50, 60, 71, 80, 93, 94]]
    said = greedy(model, prompts, [torch.zeros(0, DIM)] * 2, (), [8, 8])
    for ids, tokens in zip(prompts, said, strict=True):
        for token in tokens:
            assert token == plain(torch.tensor([ids])).logits[0, -1].argmax()
            ids.append(token)
    assert [len(tokens) for tokens in said] == [8, 8]
    assert said[0] != said[1]


@pytest.mark.parametrize("window", [None, 8])
def test_the_cache_gives_back_what_transformers_own_does(window: int | None) -> None:
    torch.manual_seed(0)
    llm = mistral(window).eval()
    own, other = roomy_cache(llm.config), DynamicCache(config=llm.config)
    for start, stop in ((0, 5), (5, 6), (6, 7), (7, 7 + AHEAD), (7 + AHEAD, 8 + AHEAD)):
        ids = torch.randint(0, 50, (3, stop - start), generator=torch.manual_seed(stop))
        with torch.no_grad():
            found, expected = (llm(ids, past_key_values=cache, use_cache=True).logits for cache in (own, other))
        torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
        assert own.get_seq_length() == other.get_seq_length() == stop


def prompt(question: Question, opd: Opd, model: OctopiForCausalLM) -> list[int]:
    turns = question.dialogue(opd).turns
    text = render(turns, model.tokenizer, system_prompt="", frames=FRAMES, complete=False)
    return list(encode(text, model.tokenizer).input_ids)


def by_hand(model: OctopiForCausalLM, question: Question, store: EmbeddingStore, opd: Opd, count: int) -> list[int]:
    """The likeliest tokens, the whole sequence anew for each, without cache or padding."""
    said, features = prompt(question, opd, model), evaluation_features(question, store, FRAMES)[None]
    for _ in range(count):
        said.append(int(model(torch.tensor([said]), features).logits[0, -1].argmax()))
    return said[-count:]


def test_an_answer_at_the_limit(model: OctopiForCausalLM, questions: list[Question], store: EmbeddingStore) -> None:
    """A token that the model says after some others is made the end token."""
    asked = [q for q in questions if q.task == "OPD"][:3]
    assert all(p.truncated and p.tokens == 8 for p in answer(model, store, asked, Opd.ALL, generation(4, 8), FRAMES))
    question, new = next((q, new) for q in asked if len(set(new := by_hand(model, q, store, Opd.ALL, 8))) > 1)
    place = next(i for i in range(1, 8) if new[i] not in new[:i])
    other = copy.copy(model)
    other.tokenizer = copy.deepcopy(model.tokenizer)
    other.tokenizer.eos_token = other.tokenizer.convert_ids_to_tokens(new[place])
    whole, cut = (answer(other, store, [question], Opd.ALL, generation(1, n), FRAMES)[0] for n in (place + 1, place))
    assert (whole.truncated, whole.tokens) == (False, place + 1)
    assert (cut.truncated, cut.tokens) == (True, place)
    assert whole.outputs == cut.outputs, "the end token says nothing"


def test_what_ends_where_positions_do(questions: list[Question], store: EmbeddingStore, tmp_path: Path) -> None:
    """Each row has its own limit; with the end token as padding, the cut must still be seen."""
    wide = OctopiForCausalLM.from_base(write_llama(tmp_path / "wide", pad="</s>"), DIM)
    asked = sorted((q for q in questions if q.task == "PSS"), key=lambda q: len(prompt(q, Opd.ALL, wide)))
    lengths = {q.question_id: len(prompt(q, Opd.ALL, wide)) for q in asked}
    most = max(lengths.values()) + 5
    folder = write_llama(tmp_path / "tight", pad="</s>", max_position_embeddings=most)
    tight = OctopiForCausalLM.from_base(folder, DIM)
    alone, together = (answer(tight, store, asked, Opd.ALL, generation(size, 40), FRAMES) for size in (1, 50))
    assert alone == together
    room = [min(40, most - lengths[p.question_id]) for p in together]
    assert len(set(room)) > 2
    assert all(p.tokens <= own and p.truncated == (p.tokens == own) for p, own in zip(together, room, strict=True))
    assert any(p.tokens == 5 for p in together)
    # What fills the positions in its first turn has nothing left to say in the second.
    twice = [q for q in questions if q.task == "PSR"]
    first = [Turn(user=q.dialogue(Opd.ALL).turns[0].user, assistant="") for q in twice]
    longest = max(len(write_prompt([t], wide.tokenizer, generation(1), FRAMES, single=False)) for t in first)
    folder = write_llama(tmp_path / "full", pad="</s>", max_position_embeddings=longest + 1)
    said = answer(OctopiForCausalLM.from_base(folder, DIM), store, twice, Opd.ALL, generation(2, 40), FRAMES)
    assert all(len(p.outputs) == 2 for p in said)
    assert any(p.truncated and p.outputs[1] == "" for p in said)
    setting = LanguageConfig(weights=str(write_llama(tmp_path, max_position_embeddings=60)))
    with refused(r"^[A-Z]+-train-\d+: takes \d+ tokens, .* 60 at once; lower frames.per_video"):
        assemble(material(setting, questions, store), taking(4), "test")
