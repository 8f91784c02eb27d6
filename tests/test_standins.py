"""The stand-ins load offline, keep within their limits, and were taught what they may be taught."""

from __future__ import annotations

import csv
import itertools
import random
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.language.chat import add_tactile_tokens, encode, render
from pipeline.records import Part, Turn
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool
from standins.beginning import initialise
from standins.contrast import alter, contrastive_loss, describe, draw_captions
from standins.curriculum import FORMATS, phrases, vocabulary
from standins.gate import HEADER, exams
from standins.images import TOPICS, WORDS, caption, draw, draw_scene, shows
from standins.outputs import wilson
from standins.settings import FOLDER, load_settings
from standins.vocabulary import EOS, build_tokenizer
from standins.world import combinations, make_world, questions, real_catalogue
from standins.zero_shot import ASKED, Reader

MEGABYTE = 2**20
TEXT = st.characters(exclude_categories=["Cs"])
FIRST_BYTE, LAST_BYTE = 3, 258
"""Ids of the single bytes, between the special tokens and the words."""


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


@cache
def llama_tokenizer() -> Any:
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(FOLDER / "llama")
    add_tactile_tokens(tokenizer)
    return tokenizer


def corpus(seed: int, count: int = 40) -> list[str]:
    rng = random.Random(seed)
    world = make_world(combinations(load_settings().llama.held_out, held=False), questions("training"), rng, held=False)
    return [f.write(world, rng).text for f in FORMATS for _ in range(count)]


def pipeline_texts() -> list[str]:
    """Conversations about the real catalogue: every task, every mode."""
    real, rng = real_catalogue(), random.Random(3)
    pool = Pool(part=Part.TRAIN, catalogue=real, videos={o: [f"{o}_0"] for o in real.objects})
    drafts = [t.draft(pool, i, rng) for t in TASKS.values() for i in range(t.strata(real)) for _ in range(3)]
    dialogues = [d for draft in drafts if draft is not None for d in draft.dialogues]
    return [render(d.turns, llama_tokenizer(), system_prompt="", frames=2, complete=True).text for d in dialogues]


def test_folder_is_small() -> None:
    sizes = {p: p.stat().st_size for p in FOLDER.rglob("*") if p.is_file() and "__pycache__" not in p.parts}
    assert sum(sizes.values()) <= 10 * MEGABYTE
    assert sizes[FOLDER / "llama" / "model.safetensors"] <= 7 * MEGABYTE
    assert sizes[FOLDER / "clip" / "open_clip_model.safetensors"] <= 3 * MEGABYTE


def test_clip_loads_as_float32_and_reads_and_sees() -> None:
    import open_clip
    import torch

    name = f"local-dir:{FOLDER / 'clip'}"
    model, _, preprocess = open_clip.create_model_and_transforms(name, precision="fp32")
    assert {p.dtype for p in model.parameters()} == {torch.float32}
    size = load_settings().clip.image_size
    ids = open_clip.get_tokenizer(name)(["a red striped circle", "unheard-of words"])
    with torch.no_grad():
        image, text = model.encode_image(torch.zeros(2, 3, size, size)), model.encode_text(ids)
    assert image.shape == text.shape == (2, load_settings().clip.embed_dim)
    assert torch.isfinite(image).all()
    assert torch.isfinite(text).all()
    from PIL import Image

    assert preprocess(Image.new("RGB", (320, 240))).shape == (3, size, size)


def test_llama_loads_in_both_precisions_and_generates() -> None:
    import torch
    from transformers import AutoModelForCausalLM

    model = AutoModelForCausalLM.from_pretrained(FOLDER / "llama")
    assert model.dtype == torch.bfloat16
    model = AutoModelForCausalLM.from_pretrained(FOLDER / "llama", dtype=torch.float32).eval()
    tokenizer = llama_tokenizer()
    assert len({tokenizer.bos_token_id, tokenizer.eos_token_id, tokenizer.pad_token_id}) == 3
    assert model.generation_config.eos_token_id == tokenizer.eos_token_id
    batch = tokenizer(["USER: Describe this. ASSISTANT:"], return_tensors="pt")
    assert model.generate(**batch, max_new_tokens=4, do_sample=False).shape[1] > batch["input_ids"].shape[1]


@settings(max_examples=100, deadline=None)
@given(st.text(TEXT, max_size=60))
def test_any_text_comes_back_exactly_with_right_offsets(text: str) -> None:
    tokenizer = llama_tokenizer()
    batch = tokenizer(text, return_offsets_mapping=True, add_special_tokens=False)
    assert tokenizer.decode(batch["input_ids"]) == text
    covered = 0
    for start, stop in batch["offset_mapping"]:
        # The bytes of one character share its place; otherwise tokens follow each other without a gap.
        assert start in (covered, covered - 1)
        assert start < stop
        covered = stop
    assert covered == len(text)


@settings(max_examples=50, deadline=None)
@given(st.text(TEXT, max_size=30), st.text(TEXT, max_size=30))
def test_prompt_tokens_begin_the_whole_conversation(question: str, answer: str) -> None:
    tokenizer = llama_tokenizer()
    turns = [Turn(user=question, assistant=answer)]
    prompt = render(turns, tokenizer, system_prompt="", frames=2, complete=False).text
    whole = render(turns, tokenizer, system_prompt="", frames=2, complete=True).text
    ids = tokenizer(prompt)["input_ids"]
    assert tokenizer(whole)["input_ids"][: len(ids)] == ids


def test_words_of_the_catalogue_and_the_tasks_are_whole_tokens() -> None:
    tokenizer = llama_tokenizer()
    texts = [f" {o.name}" for o in real_catalogue().objects.values()] + pipeline_texts()
    for text in texts:
        tokens = [i for i in tokenizer(text, add_special_tokens=False)["input_ids"] if FIRST_BYTE <= i <= LAST_BYTE]
        spelt = {tokenizer.decode([i]) for i in tokens if len(tokenizer.decode([i])) == 1}
        # Articles and the letters of a list are words of one letter.
        assert not {c for c in spelt if c.isalnum()} - set("abcxs0123456789AI"), text


def test_property_words_are_single_tokens() -> None:
    tokenizer = llama_tokenizer()
    for p in real_catalogue().properties:
        for word in (*p.levels, p.more, p.less, p.most, p.least):
            assert len(tokenizer(f" {word}", add_special_tokens=False)["input_ids"]) == 1, word


def test_tactile_tokens_can_be_added_and_answers_are_labelled() -> None:
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(FOLDER / "llama")
    size = len(tokenizer)
    add_tactile_tokens(tokenizer)
    assert len(tokenizer) == size + 3
    turns = [Turn(user="How does {tactile} feel?", assistant="It is hard."), Turn(user="Really?", assistant="Yes.")]
    encoded = encode(render(turns, tokenizer, system_prompt="", frames=2, complete=True), tokenizer)
    assert tokenizer.decode([i for i in encoded.labels if i >= 0]) == f" It is hard.{EOS} Yes.{EOS}"


def test_generators_are_deterministic() -> None:
    assert corpus(5) == corpus(5) != corpus(6)
    first, second = (draw_scene(random.Random(1), held_out=False) for _ in range(2))
    assert first == second
    assert (draw(first, 32) == draw(second, 32)).all()
    assert caption(first) == caption(second)


def test_pictures_are_in_range_and_held_out_pairs_stay_out() -> None:
    rng = random.Random(2)
    for held_out, _ in itertools.product((False, True), range(20)):
        scene = draw_scene(rng, held_out=held_out)
        picture = draw(scene, 64)
        assert scene.held_out == held_out
        assert picture.shape == (64, 64, 3)
        assert 0 <= picture.min() <= picture.max() <= 1
        assert caption(scene, TOPICS) != caption(scene, ())


def test_captions_speak_of_what_can_be_seen() -> None:
    rng = random.Random(3)
    scenes = [draw_scene(rng, held_out=False) for _ in range(200)]
    for scene, topic in itertools.product(scenes, set(TOPICS) - {"shape"}):
        assert (caption(scene, (topic,)) == caption(scene, ())) == (not shows(scene, topic))
    plain = [s for s in scenes if s.shape == "surface" and s.pattern == "plain"]
    assert plain
    assert {t for t in TOPICS if shows(plain[0], t)} == {"colour", "pattern", "light"}
    for scene in scenes:
        other = alter(rng, scene)
        assert caption(other) != caption(scene)
        assert not other.held_out
        assert sum(getattr(other, topic) != getattr(scene, topic) for topic in TOPICS) == 1


def test_captions_of_a_batch_find_their_pictures() -> None:
    rng = random.Random(4)
    scenes = [draw_scene(rng, held_out=False) for _ in range(40)]
    for everything in (0.0, 1.0):
        sets = draw_captions(rng, scenes, everything)
        assert len(sets) == len(TOPICS) + 1
        for topic, captions in zip(TOPICS, sets, strict=False):
            assert len(set(captions.texts)) == len(captions.texts) <= len(WORDS[topic])
            for row, place in zip(captions.rows, captions.wanted, strict=True):
                assert getattr(scenes[row], topic) in captions.texts[place]
        assert (len(sets[-1].texts) > len(scenes)) == bool(everything)


def test_contrastive_loss_shares_targets_and_counts_hard_negatives() -> None:
    import torch
    import torch.nn.functional as F

    rng = random.Random(5)
    scenes = [draw_scene(rng, held_out=False) for _ in range(12)]
    captions = describe(scenes, ("light",), "", ("a thing lit from nowhere",))
    image = torch.randn(12, 8, generator=torch.Generator().manual_seed(0))
    text = F.normalize(torch.randn(len(captions.texts), 8, generator=torch.Generator().manual_seed(1)), dim=1)
    forward = backward = 0.0
    named = len(set(captions.wanted))
    assert named == len(captions.texts) - 1
    for row, place in zip(captions.rows, captions.wanted, strict=True):
        forward -= float((image[row] @ text.T).log_softmax(0)[place]) / 12
        backward -= float((image @ text[place]).log_softmax(0)[row]) / captions.wanted.count(place) / named
    loss, found = contrastive_loss(image, text, captions)
    assert float(loss) == pytest.approx((forward + backward) / 2, rel=1e-5)
    assert 0 <= float(found) <= 1


def test_attention_begins_near_the_identity() -> None:
    import open_clip
    import torch

    torch.manual_seed(0)
    model = open_clip.create_model(f"local-dir:{FOLDER / 'clip'}", load_weights=False)
    initialise(model, temperature=0.1)
    assert float(model.logit_scale.detach().exp()) == pytest.approx(10, rel=1e-5)
    attention = model.visual.transformer.resblocks[0].attn
    width = attention.embed_dim
    query, key, value = attention.in_proj_weight.detach().chunk(3)
    match, output = query.T @ key, attention.out_proj.weight.detach() @ value
    assert float(match.trace()) / width > 0.5
    assert float(output.trace()) / width == pytest.approx(-0.4, abs=0.1)


def test_texts_are_embedded_as_open_clip_does() -> None:
    import open_clip
    import torch

    name = f"local-dir:{FOLDER / 'clip'}"
    model = open_clip.create_model(name, precision="fp32")
    reader = Reader(model, open_clip.get_tokenizer(name).tokenizer, load_settings().clip)
    texts = ["a red circle", "here is a large raised fine blue brick star lit from above"]
    with torch.no_grad():
        expected = model.encode_text(open_clip.get_tokenizer(name)(texts), normalize=True)
        torch.testing.assert_close(reader.texts(texts), expected, rtol=1e-4, atol=1e-5)


def test_gate_and_zero_shot_tables_are_whole() -> None:
    gate = list(csv.DictReader((FOLDER / "gate.csv").open(encoding="utf-8")))
    assert tuple(gate[0]) == HEADER
    assert [(row["task"], float(row["goal"])) for row in gate] == [(exam.name, exam.goal) for exam in exams()]
    for row in gate:
        assert int(row["n"]) >= 500
        assert row["passed"] == ("yes" if float(row["accuracy"]) >= float(row["goal"]) else "no"), row["task"]
    zero_shot = list(csv.DictReader((FOLDER / "clip_zero_shot.csv").open(encoding="utf-8")))
    assert list(zero_shot[0]) == ["question", "accuracy", "low", "high", "n", "chance"]
    assert [row["question"] for row in zero_shot] == ["caption", *ASKED]
    for row in zero_shot:
        assert float(row["low"]) > float(row["chance"]), row["question"]
    for row in (*gate, *zero_shot):
        assert 0 <= float(row["low"]) <= float(row["accuracy"]) <= float(row["high"]) <= 1
        assert int(row["n"]) >= 200


def test_wilson_interval_against_a_published_example() -> None:
    # Newcombe 1998, table I: 81 of 263.
    share, low, high = wilson(81, 263)
    assert (round(share, 4), round(low, 4), round(high, 4)) == (0.308, 0.2553, 0.3662)
    assert wilson(0, 20)[1] == 0
    assert wilson(20, 20)[2] == 1


def test_settings_name_the_wrong_key(tmp_path: Path) -> None:
    from pipeline.errors import UserError

    broken = tmp_path / "params.yaml"
    broken.write_text((FOLDER / "params.yaml").read_text().replace("warmup_steps", "warmup"))
    with pytest.raises(UserError, match="warmup"):
        load_settings(broken)


def test_committed_tokenizer_is_the_recipes() -> None:
    from transformers import AutoTokenizer

    made = build_tokenizer(vocabulary(), phrases())
    assert AutoTokenizer.from_pretrained(FOLDER / "llama").get_vocab() == made.get_vocab()
