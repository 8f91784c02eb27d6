"""The bench of the language side: counts against torch's counter, ways that compute the same, and the whole, tiny."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode
from transformers import LlamaConfig

from pipeline.io import write_json
from pipeline.benchmarks import language as bench
from pipeline.benchmarks import language_formats, language_ways
from pipeline.benchmarks.language_bed import FRAMES, Bed, take_turns
from pipeline.benchmarks.language_counts import Batch, Card, Llama, Tower, answering, backward, encoding, forward, step
from pipeline.benchmarks.language_device import Size, device_rows
from pipeline.benchmarks.language_memory import answering_bytes, kept, kept_of, training_bytes
from pipeline.benchmarks.language_paper import batches, counted_rows
from pipeline.benchmarks.language_ways import PUBLISHED, WAYS, Way, encode, loss
from pipeline.language.conversations import evaluation_features
from pipeline.encoder.clip import load_visual_tower
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.chat import IGNORE_INDEX
from pipeline.config import LoraTrainConfig
from pipeline.speed.questions import gather
from pipeline.language.training import add_lora
from tests.checkpoints import CLIP_CONFIG, write_clip, write_llama
from tests.closure import ROOT

SHAPES = {
    "hidden_size": 64,
    "intermediate_size": 160,
    "num_hidden_layers": 3,
    "num_attention_heads": 4,
    "num_key_value_heads": 2,
}
LLAMA = Llama(hidden=64, layers=3, heads=4, kv_heads=2, head_size=16, ffn=160, vocabulary=260, tactile=24)
CARD = Card("any", 1e12, 1e11)


def counter() -> FlopCounterMode:
    return FlopCounterMode(display=False)


@pytest.mark.parametrize("rank", [0, 8])
def test_counted_training_is_what_torch_counts(rank: int, tmp_path: Path) -> None:
    model = OctopiForCausalLM.from_base(write_llama(tmp_path, **SHAPES), 24)
    if rank:
        add_lora(model, LoraTrainConfig(samples=1, rank=rank, alpha=8))
    ids = torch.randint(4, 200, (3, 50), generator=torch.manual_seed(0))
    ids[:, 4:14] = model.frame_id
    labels = torch.full_like(ids, IGNORE_INDEX)
    labels[0, 30:45] = labels[1, 25:40] = 7
    batch = Batch(rows=3, length=50, logits=3 * 20, frames=30)
    with counter() as ahead:
        found = model(ids, torch.randn(3, 10, 24), labels=labels).loss
    with counter() as back:
        found.backward()
    assert forward(LLAMA, batch, rank) == pytest.approx(ahead.get_total_flops(), rel=0.02)
    assert backward(LLAMA, batch, rank) == pytest.approx(back.get_total_flops(), rel=0.02)
    whole = step(LLAMA, batch, CARD, rank, again=True)
    assert whole.flops == pytest.approx(2 * ahead.get_total_flops() + back.get_total_flops(), rel=0.02)


def test_counted_answering_is_what_torch_counts(tmp_path: Path) -> None:
    model = OctopiForCausalLM.from_base(write_llama(tmp_path, **SHAPES), 24).eval()
    ids = torch.randint(4, 200, (3, 30), generator=torch.manual_seed(0))
    ids[:, 4:14] = model.frame_id
    with counter() as found:
        new = model.generate(ids, torch.randn(3, 10, 24), torch.ones_like(ids), max_new_tokens=12, do_sample=False)
    assert new.shape == (3, 12)
    cost = answering(LLAMA, Batch(rows=3, length=30, logits=3, frames=30), 12, CARD)
    assert cost.flops == pytest.approx(found.get_total_flops(), rel=0.02)
    # Weights are read for each token, keys and values of all that is held but for the newest once more.
    held = sum(range(31, 42)) * 3 * 2 * 2 * 3 * 2 * 16
    assert cost.bytes == 12 * 2 * LLAMA.weights + held
    assert cost.seconds >= max(cost.flops / CARD.rate, cost.bytes / CARD.bandwidth)


def test_counted_frames_are_what_torch_counts(tmp_path: Path) -> None:
    visual = load_visual_tower(write_clip(tmp_path)).module
    form: dict[str, Any] = CLIP_CONFIG["model_cfg"]["vision_cfg"]  # type: ignore[index, assignment]
    tokens = (form["image_size"] // form["patch_size"]) ** 2 + 1
    tower = Tower(width=32, layers=2, ffn=128, tokens=tokens, patch=3 * form["patch_size"] ** 2)
    frames = torch.randn(5, 3, 32, 32, requires_grad=True)  # so that no fused kernel hides from the counter
    with counter() as found:
        visual(frames)
    # CLIP's last projection is not among a tower's shapes: the published code reads the state before it.
    last = 2 * 5 * 32 * 16
    assert encoding(tower, 5, CARD).flops == pytest.approx(found.get_total_flops() - last, rel=0.02)


def test_true_shapes_are_those_that_are_known() -> None:
    """Llama-2-7B has 6.74 billion parameters, ViT-L/14's visual tower 304 million."""
    assert Llama().weights + 32000 * 4096 == pytest.approx(6.738e9, rel=1e-3)
    assert Tower().weights == pytest.approx(304e6, rel=0.01)


@pytest.mark.parametrize("rank", [0, 8])
def test_counted_memory_is_what_autograd_keeps(rank: int, tmp_path: Path) -> None:
    """Against a model of three layers that is there, with the stages' own adapters."""
    base = write_llama(tmp_path, **SHAPES | {"num_key_value_heads": 4})
    model = OctopiForCausalLM.from_base(base, 24, dtype="bfloat16")
    if rank:
        add_lora(model, LoraTrainConfig(samples=1, rank=rank, alpha=8))
    llm = model.train().llm
    embeddings = torch.randn(3, 20, 64, dtype=torch.bfloat16, requires_grad=True)
    tensors = {**dict(llm.named_parameters()), **dict(llm.named_buffers())}
    found = kept(replace(LLAMA, kv_heads=4), Batch(rows=3, length=20, logits=3 * 10, frames=30), rank)
    # Without numbers, the masks of attention are made, which a batch without padding does not need.
    assert found.total(3, again=False) == pytest.approx(kept_of(llm, tensors, embeddings, 10), rel=0.02)
    assert found.entry == embeddings.nbytes
    assert found.layer * 3 > found.total(3, again=True) - found.rest > found.layer


def test_counted_memory_holds_what_is_known() -> None:
    """Llama-2-7B's weights take 13.5 GB in bfloat16; keys and values of a token half a megabyte."""
    llama = Llama()
    weights = answering_bytes(llama, 1, 0)
    assert weights == pytest.approx(13.48e9 + 4 * 21e6, rel=1e-3)
    assert answering_bytes(llama, 16, 100) - weights == 16 * 100 * 524288
    small = Batch(1, 8, 8, 0)
    plain, adapted = (training_bytes(llama, small, rank, again=True) for rank in (0, 128))
    # The paper's adapters: 67 million parameters.
    assert adapted - plain == pytest.approx(16 * 67.1e6, rel=0.02)


def test_counted_rows_compare_the_same_work() -> None:
    lengths = [(50, 30, 1), (115, 75, 2), (158, 104, 2), (210, 120, 3)] * 8
    rows = {row.case: row for row in counted_rows(lengths, CARD)}
    assert all(row.source == "counted" and row.flops and row.gigabytes and row.megabytes for row in rows.values())
    assert all(row.share and 0 < row.share <= 1 for row in rows.values())
    for row in rows.values():
        assert row.baseline in rows
        assert row.ratio == pytest.approx(row.cost / rows[row.baseline].cost, rel=0.01)
        assert row.tokens == rows[row.baseline].tokens
    both = [rows[f"paper-7b on any, alignment, 4 at a time{x}"] for x in (", gradient checkpointing", "")]
    assert both[0].cost < both[1].cost
    assert (both[0].megabytes or 0) < (both[1].megabytes or 0)
    cut = batches(lengths, 8)
    assert [b.length for b in cut] == [50, 115, 158, 210]
    assert [b.logits for b in cut] == [8 * 30, 8 * 75, 8 * 104, 8 * 120]
    assert sum(b.frames for b in cut) == FRAMES * sum(v for _, _, v in lengths)


@pytest.fixture(scope="module")
def bed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bed]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield bench.stand_ins(ROOT, tmp_path_factory.mktemp("bed"), (4, 4))
    torch.set_num_threads(threads)


@pytest.mark.parametrize("way", WAYS, ids=lambda way: way.case)
def test_every_way_has_the_same_loss(way: Way, bed: Bed) -> None:
    """But for encoding, which draws no mirrored frames."""
    data = bed.conversations(bed.training)
    some = slice(0, 3) if way.batch > 1 else slice(0, 1)
    asked, samples = data.questions[some], [data[i] for i in range(len(data))][some]
    samples = [
        {**s, "features": evaluation_features(q, bed.store, FRAMES)} for q, s in zip(asked, samples, strict=True)
    ]
    bed.model.eval()
    with torch.no_grad():
        found = loss(bed, way, asked, samples, 100)  # type: ignore[arg-type]
        single = Way("alone")
        alone = [loss(bed, single, [q], [s], 100) for q, s in zip(asked, samples, strict=True)]  # type: ignore[list-item]
    torch.testing.assert_close(found, torch.stack(alone).sum(), atol=1e-4, rtol=1e-5)


def test_encoding_anew_gives_the_cached_embeddings(bed: Bed) -> None:
    for question in bed.asked[:4]:
        torch.testing.assert_close(
            encode(bed, question), evaluation_features(question, bed.store, FRAMES), atol=1e-4, rtol=0
        )


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for module, name, value in (
        (bench, "REPEATS", 1),
        (bench, "TRAINED", 4),
        (bench, "WARM", 4),
        (bench, "ASKED", 4),
        (bench, "LIMIT", 6),
        (bench, "BATCHES", (1, 4)),
        (language_formats, "REPEATS", 1),
        (language_ways, "CUTOFF", 256),
    ):
        monkeypatch.setattr(module, name, value)


def test_the_whole_tiny(small: None, monkeypatch: pytest.MonkeyPatch) -> None:
    weighed: list[str] = []
    monkeypatch.setattr(bench, "_in_fresh_process", lambda root, case: weighed.append(case) or 5.0)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    threads = torch.get_num_threads()
    rows = {row.case: row for row in bench.measure(ROOT)}
    assert torch.get_num_threads() == threads
    for row in rows.values():
        assert row.baseline in rows
        assert row.unit == rows[row.baseline].unit
        assert row.cost > 0
        assert row.low <= row.cost <= row.high
        assert row.ratio == 1 or row.case != row.baseline
    assert set(weighed) <= set(rows)
    assert {case for case, row in rows.items() if row.megabytes and row.source == "measured"} == set(weighed)
    assert {row.source for row in rows.values()} == {"measured", "counted"}
    trained = [rows[f"training, {way.case}"] for way in WAYS]
    assert len({row.tokens for row in trained}) == 1
    flops = [row.flops or 0 for row in trained]
    assert flops[0] > flops[1] > flops[2] > flops[3], "each part saves operations"
    answers = [row for case, row in rows.items() if case.startswith("answering, ") and "weights" not in case]
    assert [row.error for row in answers] == [0.0] * 4, "all ways answer alike"
    half = rows[language_formats.case_of("bfloat16")]
    assert half.logit_error is not None
    assert 0 < half.logit_error < 0.1
    assert half.error is not None
    for row in (*answers, half):
        assert row.error is not None
        assert row.error_low is not None
        assert row.error_high is not None
        assert 0 <= row.error_low <= row.error <= row.error_high <= 1
    assert all(row.error_low is None for row in trained)
    assert rows[language_formats.case_of("float32")].logit_error == 0
    write_json(Path("reports/bench/language.json"), [row.model_dump() for row in rows.values()])
    found, _ = gather(Path("reports"))
    settings = {answer.question.key: [r.setting for r in answer.rows] for answer in found}
    assert settings["number format, language model"] == list(language_formats.FORMATS)
    assert len(settings["language model, answering"]) == len(answers)
    assert len(settings["language model, training"]) == len(WAYS) + 1
    for answer in found:
        assert all(r.flops for r in answer.rows) == (answer.question.key != "number format, language model")


def test_memory_is_that_of_the_case(small: None) -> None:
    """In this process, which holds torch and more."""
    sent: list[float] = []

    class Sender:
        send = staticmethod(sent.append)

    kept = torch.get_num_threads()
    bench._peak(Sender(), ROOT, f"training, {PUBLISHED.case}", (1, 1))  # type: ignore[arg-type]
    torch.set_num_threads(kept)
    assert [100 < peak < 100_000 for peak in sent] == [True]


def test_true_shapes_run_with_tiny_ones(small: None) -> None:
    """The code that a CUDA device runs, on the CPU."""
    size = Size(
        name="tiny",
        llama=LlamaConfig(vocab_size=4000, max_position_embeddings=1024, **SHAPES),
        tower="ViT-S-32-alt",
        device="cpu",
        dtype="bfloat16",
        updates=1,
        published_updates=1,
        rank=4,
        asked=2,
        published_asked=1,
        batch=4,
        limit=3,
        product=64,
    )
    size = replace(size, runtime=size.runtime.model_copy(update={"device": "cpu"}))
    rows = {row.case: row for row in device_rows(ROOT, size)}
    assert len(rows) == 6
    for row in rows.values():
        assert row.cost > 0
        assert row.baseline in rows
        assert row.share is not None
        assert row.flops
    assert rows["tiny measured, LoRA, pipeline's way"].samples == 16
    lora, aligned = (rows[f"tiny measured, {x}, published way"].flops for x in ("LoRA", "alignment"))
    assert lora > aligned  # type: ignore[operator]


def test_turns_are_fair_and_rates_are_amounts_a_second() -> None:
    seen: list[str] = []
    cases = {name: (lambda name=name: seen.append(name)) for name in "ab"}  # type: ignore[misc]
    rates = take_turns(cases, {"a": 1.0, "b": 1e9}, 3)
    assert seen == ["a", "b"] * 3
    assert all(len(repeats) == 3 for repeats in rates.values())
    assert min(rates["b"]) > max(rates["a"])
