"""The language side: embeddings in their places, masks, adapters, checkpoints, answers."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torch.optim.optimizer import register_optimizer_step_pre_hook
from torch.utils.data import SequentialSampler

from pipeline import training as shared
from pipeline.config import LanguageConfig, LoraTrainConfig, RuntimeConfig
from pipeline.embeddings import EmbeddingStore
from pipeline.errors import UserError
from pipeline.language.base import load_llm
from pipeline.language.chat import IGNORE_INDEX, TACT_FRAME
from pipeline.language.conversations import ConversationCollator
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.training import Job, add_lora, align, assemble, finetune_lora
from pipeline.records import Opd, Question
from pipeline.trainable import trainable_state
from tests.checkpoints import write_llama
from tests.language.shared import DIM, FRAMES, SMALL, generation, language, material, model, questions, store

__all__ = ["language", "model", "questions", "store"]
"""Fixtures."""


def test_tactile_embeddings_stand_where_the_frames_are(model: OctopiForCausalLM) -> None:
    words = model.llm.get_input_embeddings().weight
    ids = torch.tensor([[5, model.start_id, model.frame_id, model.frame_id, model.end_id, 7], [8, 9, 10, 11, 12, 13]])
    features = torch.randn(2, 2, DIM)
    features[1] = float("nan")  # padding of a row without frames: must never be read
    output = model.embed(ids, features)
    expected = torch.stack(
        [
            words[5],
            model.connector.delimiters[0],
            model.connector.projection(features[0, 0]),
            model.connector.projection(features[0, 1]),
            model.connector.delimiters[1],
            words[7],
        ]
    )
    torch.testing.assert_close(output[0], expected)
    assert torch.equal(output[1], words[ids[1]])


def test_only_connector_is_trained_and_only_two_words_are_new(model: OctopiForCausalLM) -> None:
    trained = {name for name, p in model.named_parameters() if p.requires_grad}
    assert all(name.startswith("connector.") for name in trained)
    assert model.connector.delimiters.shape == (2, 32)


def test_loss_is_over_answers_only(
    model: OctopiForCausalLM, language: LanguageConfig, questions: list[Question], store: EmbeddingStore
) -> None:
    """By hand in float64, over rows of unlike lengths whose answers begin at other columns."""
    _, data = assemble(material(language, questions, store), 4, "test")
    batch = ConversationCollator(0)([data[i] for i in range(len(data))])
    labels = batch.pop("labels")
    logits = model(**batch).logits.double()
    losses = [
        -logits[row, column - 1].log_softmax(-1)[labels[row, column]]
        for row, column in (labels != IGNORE_INDEX).nonzero().tolist()
    ]
    output = model(**batch, labels=labels)
    torch.testing.assert_close(output.loss.double(), torch.stack(losses).mean(), atol=1e-5, rtol=0)
    share = model(**batch, labels=labels, num_items_in_batch=torch.tensor(1000)).loss
    torch.testing.assert_close(share.double(), torch.stack(losses).sum() / 1000, atol=1e-5, rtol=0)
    frames = batch["input_ids"] == model.frame_id
    assert (labels[frames] == IGNORE_INDEX).all()


def test_padding_changes_no_logit(
    model: OctopiForCausalLM, language: LanguageConfig, questions: list[Question], store: EmbeddingStore
) -> None:
    _, data = assemble(material(language, questions, store), 6, "test")
    samples = [data[i] for i in range(len(data))]
    batch = ConversationCollator(0)(samples)
    del batch["labels"]
    together = model(**batch).logits
    for row, sample in enumerate(samples):
        alone = model(sample["input_ids"][None], sample["features"][None]).logits[0]
        torch.testing.assert_close(together[row, : len(alone)], alone, atol=2e-5, rtol=0)


def test_same_draws_for_same_epoch_and_others_for_another(
    language: LanguageConfig, questions: list[Question], store: EmbeddingStore
) -> None:
    _, data = assemble(material(language, questions, store), 6, "test")
    first = [data[i]["features"] for i in range(len(data))]
    assert all(torch.equal(a, data[i]["features"]) for i, a in enumerate(first))
    data.follow(lambda: 1)
    assert not all(torch.equal(a, data[i]["features"]) for i, a in enumerate(first))


def test_fresh_adapter_changes_nothing_and_reloads_exactly(
    model: OctopiForCausalLM, language: LanguageConfig, tmp_path: Path
) -> None:
    ids = torch.tensor([[5, model.start_id, model.frame_id, model.end_id, 7]])
    call = {"input_ids": ids, "features": torch.randn(1, 1, DIM)}
    before = model(**call).logits
    add_lora(model, LoraTrainConfig(samples=1, rank=128, alpha=256))
    model.eval()
    torch.testing.assert_close(model(**call).logits, before, atol=0, rtol=0)
    for name, parameter in model.named_parameters():
        if "lora_B" in name:
            torch.nn.init.normal_(parameter, std=0.05)
    changed = model(**call).logits
    assert not torch.allclose(changed, before)
    model.save_pretrained(tmp_path, trainable_state(model))
    other = OctopiForCausalLM.from_pretrained(tmp_path)
    assert torch.equal(other(**call).logits, changed)
    merged = other.llm.merge_and_unload()
    torch.testing.assert_close(
        merged(inputs_embeds=other.embed(ids, call["features"])).logits, changed, atol=1e-4, rtol=0
    )


def test_unknown_target_module_is_named(model: OctopiForCausalLM) -> None:
    with pytest.raises(UserError, match="no layer q_projection"):
        add_lora(model, LoraTrainConfig(samples=1, target_modules=("q_projection",)))


@pytest.mark.parametrize("opd", list(Opd))
def test_batch_size_changes_no_answer(
    model: OctopiForCausalLM, questions: list[Question], store: EmbeddingStore, opd: Opd
) -> None:
    one = answer(model, store, questions, opd, generation(1))
    many = answer(model, store, questions, opd, generation(5))
    assert one == many
    mixed = answer(model, store, questions[::-1], opd, generation(len(questions)))
    assert sorted(mixed, key=lambda p: p.question_id) == sorted(one, key=lambda p: p.question_id)
    turns = {q.question_id: len(d.turns) for q in questions if (d := q.dialogue(opd))}
    assert {p.question_id: len(p.outputs) for p in one} == turns
    if opd is Opd.NONE:
        assert not [p for p in one if p.task == "OPD"], "without descriptions there is nothing to ask"


def test_running_into_the_limit_is_said(
    model: OctopiForCausalLM, questions: list[Question], store: EmbeddingStore
) -> None:
    predictions = answer(model, store, questions[:2], Opd.ALL, generation(2, tokens=1))
    assert all(p.truncated for p in predictions)
    assert all(p.tokens == len(p.outputs) for p in predictions)


def test_answers_equal_generation_by_hand(
    model: OctopiForCausalLM, questions: list[Question], store: EmbeddingStore
) -> None:
    from pipeline.language.chat import encode, render
    from pipeline.language.conversations import evaluation_features

    question = next(q for q in questions if q.task == "PC")
    dialogue = question.dialogue(Opd.ALL)
    assert dialogue is not None
    ids = list(
        encode(
            render(dialogue.turns, system_prompt="", frames=FRAMES, eos="</s>", complete=False), model.tokenizer
        ).input_ids
    )
    features = evaluation_features(question, store, FRAMES)[None]
    said: list[int] = []
    for _ in range(12):  # the whole sequence anew for each token, without cache or padding
        x = torch.tensor([ids + said])
        said.append(int(model(x, features).logits[0, -1].argmax()))
        if said[-1] == model.tokenizer.eos_token_id:
            break
    expected = model.tokenizer.decode(said, skip_special_tokens=True).strip()
    assert answer(model, store, [question], Opd.ALL, generation(1))[0].outputs == (expected,)


class Killed(Exception):
    """Stands in for a kill at some step."""


@pytest.mark.parametrize("kill_at", [None, 2, 3])
def test_killed_training_ends_like_an_uninterrupted_one(
    kill_at: int | None,
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shared, "CHECKPOINTS", tmp_path)
    config = LoraTrainConfig(**SMALL.model_dump(), rank=4, alpha=8, learning_rate=1e-3, dropout=0.1)
    runtime = RuntimeConfig(device="cpu", save_steps=1)

    def run(mark: str, stop: int | None) -> tuple[dict[str, torch.Tensor], list[float]]:
        def log(step: int, values: dict[str, float]) -> None:
            if step == stop:
                raise Killed

        model, data = assemble(material(language, questions, store), 8, "test")
        add_lora(model, config)
        trained = finetune_lora(model, data, config, runtime, Job("lora", mark, 0, log))
        return trained.state, [m.value for m in trained.history if m.name == "loss"]

    reference, curve = run("reference", None)
    if kill_at is not None:
        with pytest.raises(Killed):
            run("killed", kill_at)
        assert list((tmp_path / "lora" / "killed").glob("checkpoint-*")), "there must be something to resume from"
    state, again = run("killed", None)
    assert again == curve
    for name, value in reference.items():
        assert torch.equal(value, state[name]), name
    assert not (tmp_path / "lora" / "killed").exists(), "checkpoints go when the training is done"


def test_each_part_learns_at_its_own_rate(
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shared, "CHECKPOINTS", tmp_path)
    config = LoraTrainConfig(
        **{**SMALL.model_dump(), "projection_learning_rate": 1e-9}, rank=4, alpha=8, learning_rate=1e-2
    )
    model, data = assemble(material(language, questions, store), 8, "test")
    add_lora(model, config)
    before = {n: p.detach().clone() for n, p in model.named_parameters()}
    finetune_lora(model, data, config, RuntimeConfig(device="cpu"), Job("lora", "x", 0))
    moved = {n: float((p - before[n]).abs().max()) for n, p in model.named_parameters()}
    assert max(v for n, v in moved.items() if n.startswith("connector.")) < 1e-6
    assert min(v for n, v in moved.items() if "lora_B" in n) > 1e-3
    assert max(v for n, v in moved.items() if "base_layer" in n or "embed_tokens" in n) == 0


def test_diverging_training_stops_with_the_mend(
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(shared, "CHECKPOINTS", tmp_path)
    model, data = assemble(material(language, questions, store), 8, "test")
    with torch.no_grad():
        model.connector.delimiters.fill_(float("inf"))
    with pytest.raises(UserError, match="lower the learning rate"):
        align(model, data, SMALL, RuntimeConfig(device="cpu"), Job("align", "x", 0))


def test_checkpoint_of_another_model_is_refused(language: LanguageConfig, tmp_path: Path) -> None:
    folder = write_llama(tmp_path)
    config = folder / "config.json"
    config.write_text(config.read_text().replace('"num_hidden_layers": 2', '"num_hidden_layers": 3'))
    with pytest.raises(UserError, match="does not fit its config.json"):
        load_llm(folder, torch.float32)


def test_pickle_in_place_of_safetensors_is_refused(model: OctopiForCausalLM, tmp_path: Path) -> None:
    model.save_pretrained(tmp_path)
    torch.save(model.connector.state_dict(), tmp_path / "connector.safetensors")
    with pytest.raises(UserError, match="not a safetensors file"):
        OctopiForCausalLM.from_pretrained(tmp_path)
    save_file({"projection.0.weight": torch.zeros(1)}, tmp_path / "connector.safetensors")
    with pytest.raises(UserError, match="does not fit the model"):
        OctopiForCausalLM.from_pretrained(tmp_path)


def test_frame_token_never_comes_out_as_text(model: OctopiForCausalLM) -> None:
    assert model.frame_id >= model.llm.get_input_embeddings().num_embeddings
    assert TACT_FRAME not in model.tokenizer.decode(range(model.llm.config.vocab_size))


def test_accumulated_batches_weigh_every_token_alike(
    language: LanguageConfig,
    questions: list[Question],
    store: EmbeddingStore,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """By the gradient of the first update: rounding aside, four batches of one must give that of one of four."""
    monkeypatch.setattr(shared, "CHECKPOINTS", tmp_path)
    # Buckets depend on how many questions a batch has.
    monkeypatch.setattr("pipeline.language.training.LengthBuckets", lambda lengths, *_: SequentialSampler(lengths))
    gradients: list[torch.Tensor] = []
    for micro in (4, 2, 1):
        model, data = assemble(material(language, questions, store), 4, "test")
        counts = [sum(label != IGNORE_INDEX for label in e.labels) for e in data.encoded]
        assert max(counts) > 1.5 * min(counts), "or equal weights would do"
        config = SMALL.model_copy(update={"micro_batch_size": micro, "epochs": 1, "max_grad_norm": 1e9})
        kept = register_optimizer_step_pre_hook(
            lambda optimizer, *_: gradients.append(
                torch.cat([p.grad.flatten() for group in optimizer.param_groups for p in group["params"]])
            )
        )
        align(model.double(), data, config, RuntimeConfig(device="cpu"), Job("align", f"x{micro}", 0))
        kept.remove()
    assert len(gradients) == 3
    for other in gradients[1:]:
        # transformers' normalisation computes in float32 whatever it is given.
        torch.testing.assert_close(gradients[0], other, atol=1e-6 * float(gradients[0].abs().max()), rtol=0)
