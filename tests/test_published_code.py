"""The numbers that the published code gave on tiny models, and its checkpoint, converted and asked.

They lie beside the checkout, in shared/data/published-tiny (its README: shapes, versions, quirks).
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.config import EncoderConfig, FramesConfig, LanguageConfig, LoraTrainConfig
from pipeline.core.records import Turn
from pipeline.encoder.model import PropertyClassifier
from pipeline.encoder.release import property_classifier, sinusoid
from pipeline.language.chat import IGNORE_INDEX, PIECE, TACTILE, encode, render
from pipeline.language.generate import reply, write_prompt
from pipeline.language.lora import add_lora
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.use.model import Octopi
from pipeline.use.published import PROPERTIES, SYSTEM
from pipeline.weights.check import PUBLISHED_LANGUAGE
from pipeline.weights.clip_layout import to_open_clip
from tests.checkpoints import cut
from tests.conftest import ROOT, refused
from tests.frame_rules import scanned

GOLDEN = ROOT.parent / "shared/data/published-tiny"
pytestmark = pytest.mark.skipif(not GOLDEN.is_dir(), reason="needs shared/data/published-tiny beside the checkout")
TINY = {"hidden_size": 64, "intermediate_size": 160, "num_hidden_layers": 2, "num_attention_heads": 4}
START, END = 1001, 1000
Numbers = dict[str, torch.Tensor]


def numbers(name: str) -> Numbers:
    with np.load(GOLDEN / "golden" / f"{name}.npz") as file:
        return {key: torch.from_numpy(file[key]) for key in file}


def texts(name: str) -> Any:
    return json.loads((GOLDEN / name).read_text())


def close(ours: torch.Tensor, theirs: torch.Tensor, most: float = 5e-5) -> None:
    torch.testing.assert_close(ours.detach().to(theirs.dtype), theirs, rtol=0, atol=most)


def same_gradient(ours: torch.Tensor | None, theirs: torch.Tensor) -> None:
    """To 1e-4 of the tensor's largest value."""
    assert ours is not None
    close(ours, theirs, 1e-4 * float(theirs.abs().max()))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The whole download: the heads lie beside the rest."""
    folder = tmp_path_factory.mktemp("download") / "octopi"
    shutil.copytree(GOLDEN / "checkpoints/lora", folder)
    shutil.copy(GOLDEN / "checkpoints/encoder/classifier.pt", folder)
    return folder


@pytest.fixture(autouse=True, scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """An empty folder, and a Vicuna published at the fixture's widths."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("here"))
        known = PUBLISHED_LANGUAGE["vicuna-7b-v1.5"]
        patch.setitem(PUBLISHED_LANGUAGE, "vicuna-7b-v1.5", known | TINY | {"vocab_size": 1000})
        yield


def convert(source: Path, *more: str, to: str = "models/octopi-7b") -> str:
    """What `octopi weights octopi-7b` prints; its UserError is raised."""
    shutil.rmtree("weights", ignore_errors=True)
    bases = ["--base", str(GOLDEN / "base/vicuna"), "--clip", str(GOLDEN / "base/clip")]
    arguments = ["weights", "octopi-7b", str(source), *bases, "--to", to, *more]
    return CliRunner().invoke(app, arguments, catch_exceptions=False).output


@pytest.fixture(scope="module")
def octopi(source: Path) -> Octopi:
    assert "every tensor is used" in convert(source, "--trust-pickle")
    return Octopi.from_pretrained("models/octopi-7b", device="cpu")


@pytest.fixture
def classifier(octopi: Octopi, monkeypatch: pytest.MonkeyPatch) -> PropertyClassifier:
    """Given the pictures as CLIP's own processor made them."""
    made = octopi.encoder.classifier
    monkeypatch.setattr(type(made.encoder), "pixels", lambda _, pictures: pictures)
    return made


# ---- the encoder ----


def test_features_and_heads(classifier: PropertyClassifier) -> None:
    known = numbers("encoder")
    for video in range(6):
        own = {key.split(".")[1]: value for key, value in known.items() if key.startswith(f"{video}.")}
        frames, places = own["pixel_values"], own["frame_indices"]
        close(classifier.encoder(frames, places), own["llm_features_plus_sinusoid"])
        mean = classifier.encoder.describe(frames, places).mean(0)
        close(mean / mean.norm(), own["video_features"])
        logits = classifier(frames[None], places[None])["logits"][0].split(3)
        for name, found in zip(PROPERTIES, logits, strict=True):
            close(found, own[name])


def test_sinusoid() -> None:
    """Theirs is computed in float32, and off by up to 1e-5 at late frames."""
    known = numbers("sinusoid_1024")
    places, theirs = (known[key] for key in sorted(known, key=lambda key: known[key].ndim))
    close(sinusoid(places.flatten(), theirs.shape[-1]), theirs.reshape(-1, theirs.shape[-1]), 2e-5)


def test_one_step_of_the_encoder(octopi: Octopi, monkeypatch: pytest.MonkeyPatch) -> None:
    known = numbers("step_encoder")
    config = EncoderConfig(recipe="release", weights=str(octopi.folder / "encoder/backbone"))
    model = property_classifier(config, [3, 3, 3])
    monkeypatch.setattr(type(model.encoder), "pixels", lambda _, pictures: pictures)
    model.heads.dropout = nn.Identity()  # As in theirs.
    own = dict(model.named_parameters())
    prompts = own["encoder.prompts.prompts"]
    heads = {"fc": "shared", **{f"{name}_fc": f"properties.{i}" for i, name in enumerate(PROPERTIES)}}
    names = {f"heads.{t}.{part}": f"heads.{h}.{part}" for t, h in heads.items() for part in ("weight", "bias")}
    layers = ["VPT", *(f"encoder.layers.{i}.VPT_shallow" for i in range(1, 4))]
    layers = [f"prompts.clip_model.vision_model.{layer}" for layer in layers]
    with torch.no_grad():
        prompts.copy_(torch.stack([known[f"before.{layer}"] for layer in layers]))
        for theirs, ours in names.items():
            own[ours].copy_(known[f"before.{theirs}"])
    inputs = {"frames": known["pixel_values"], "frame_indices": known["frame_indices"], "labels": known["labels"]}
    loss = model(**inputs)["loss"]
    close(loss, known["loss_before"], 1e-5)
    loss.backward()
    for layer, name in enumerate(layers):
        assert prompts.grad is not None
        same_gradient(prompts.grad[layer], known[f"gradient.{name}"])
    for theirs, ours in names.items():
        same_gradient(own[ours].grad, known[f"gradient.{theirs}"])
    torch.optim.AdamW([own[name] for name in own if own[name].requires_grad], lr=1e-3).step()
    close(model(**inputs)["loss"], known["loss_after"], 1e-4)


def test_frames_that_are_kept() -> None:
    ((name, known),) = texts("golden/processing.json").items()
    kept = scanned(GOLDEN / "video" / name, FramesConfig(selection="release", pixels=16)).kept
    assert [frame.index + 1 for frame in kept] == known["kept"]


# ---- the prompts ----


def turn_of(pieces: list[str], answer: str = "") -> Turn:
    """A question in the published layout, whose pieces are marked."""
    shown = [piece for piece in pieces if piece != f"{SYSTEM}\n\n"]
    text = PIECE.join(shown).replace(f"<tact_start>{PIECE}<img_tokens>{PIECE}<tact_end>", TACTILE)
    return Turn(user=text, assistant=answer)


def ours(ids: torch.Tensor, model: OctopiForCausalLM) -> tuple[int, ...]:
    """Published ids with our numbers of the tactile tokens."""
    names = {-1: model.frame_id, START: model.start_id, END: model.end_id}
    return tuple(names.get(i, i) for i in ids.tolist())


LANGUAGE = LanguageConfig(weights="", system_prompt=SYSTEM, chat="published", bos=False, max_new_tokens=48)


@pytest.mark.parametrize("number", range(5))
def test_prompts_and_loss(octopi: Octopi, number: int) -> None:
    known, (_, asked, told) = numbers(f"answers_lora_{number}"), texts("questions/eval.json")[number]
    turn = turn_of(asked["content"], told["content"][0])
    tokenizer = octopi.llm.tokenizer
    rendered = render([turn], tokenizer, system_prompt=SYSTEM, frames=5, complete=True, chat="published")
    encoded = encode(rendered, tokenizer, bos=False)
    learnt = [label for label in encoded.labels if label != IGNORE_INDEX]
    assert write_prompt([turn], octopi.llm.tokenizer, LANGUAGE, 5) == ours(known["input_ids"], octopi.llm)
    assert learnt == known["answer_ids"].tolist()
    features = known["features_plus_sinusoid"].flatten(0, 1)[None]
    ids = torch.tensor([encoded.input_ids])
    embeddings = octopi.llm.embed(ids, features)[0, : len(known["input_ids"])]
    close(embeddings, known["prompt_embeddings"])
    close(octopi.llm(ids, features, torch.tensor([encoded.labels])).loss, known["loss_over_base_words"], 1e-5)


def test_a_second_turn(octopi: Octopi) -> None:
    """As the published script for chats writes it; it cuts the text where a video is named."""
    known, said = numbers("interact"), texts("golden/interact.json")
    first = said["said"][0].removeprefix("ASSISTANT: ").removesuffix("</s>")
    turns = [Turn(user=f"Describe the touch in {PIECE}{TACTILE}{PIECE}.", assistant=first)]
    turns.append(Turn(user=f"Is it rougher than the one in {PIECE}{TACTILE}{PIECE}? Describe both.", assistant=""))
    for number in (1, 2):
        prompt = write_prompt(turns[:number], octopi.llm.tokenizer, LANGUAGE, 5, single=False)
        words = torch.tensor(prompt) != octopi.llm.frame_id
        found = octopi.llm.embed(torch.tensor([prompt]), torch.zeros(1, 10, 128))[0]
        assert len(prompt) == said["prompt_lengths"][number - 1]
        close(found[words], known[f"{number - 1}.prompt_embeddings"][words])


@pytest.mark.parametrize("single", [True, False])
def test_labels_cover_answers_alone(octopi: Octopi, single: bool) -> None:
    tokenizer = octopi.llm.tokenizer
    turns = [Turn(user=f"a {TACTILE} ü 東", assistant="Ja, 東."), Turn(user="b", assistant="No.")][: 1 if single else 2]
    rendered = render(turns, tokenizer, system_prompt="s", frames=2, complete=True, chat="published")
    encoded = encode(rendered, tokenizer, bos=True)
    learnt = tokenizer.decode([label for label in encoded.labels if label != IGNORE_INDEX])
    assert learnt == "".join(f" {turn.assistant}</s>" for turn in turns).strip()
    assert encoded.input_ids[0] == tokenizer.bos_token_id


# ---- one step of the language model ----


@pytest.mark.parametrize("stage", ["align", "lora"])
def test_one_step_of_the_language_model(octopi: Octopi, stage: str) -> None:
    known, base = numbers(f"step_{stage}"), octopi.config.base.folder
    model = OctopiForCausalLM.from_base(base, 128)
    words = model.train_words()
    if stage == "lora":
        whole = torch.load(GOLDEN / "checkpoints/align/llm_weights/pytorch_model.bin", weights_only=True)
        same = {key: value for key, value in model.llm.state_dict().items() if key not in EXTENDED}
        assert all(torch.equal(value, whole[key]) for key, value in same.items())
        add_lora(model, LoraTrainConfig(samples=1, dropout=0.0))
    # Two random words share the published softmax.
    head = model.llm.get_output_embeddings()
    new = known["lm_head_new_rows"] if "lm_head_new_rows" in known else whole["lm_head.weight"][1000:]
    head.weight = nn.Parameter(torch.cat([head.weight[:1000], new]), requires_grad=False)
    own = {name: value for name, value in model.named_parameters() if value.requires_grad}
    matrix = next(name for name in known if name.startswith("before.") and "embed_tokens" in name)
    with torch.no_grad():
        words.weight.copy_(known[matrix][:1000])
        model.connector.delimiters.copy_(known[matrix][[START, END]])
        for name, theirs in places(known).items():
            own[name].copy_(known[f"before.{theirs}"])
    ids = torch.tensor([[*ours(known["input_ids"], model), *known["answer_ids"].tolist()]])
    labels = ids.masked_fill(torch.arange(ids.shape[1]) < len(known["input_ids"]), IGNORE_INDEX)
    features = known["features_plus_sinusoid"].flatten(0, 1)[None]
    close(model.embed(ids, features)[0, : len(known["input_ids"])], known["prompt_embeddings"])
    loss = model(ids, features, labels).loss
    close(loss, known["loss"], 1e-5)
    loss.backward()
    of_words, of_new = words.weight.grad, model.connector.delimiters.grad
    assert of_words is not None
    assert of_new is not None
    same_gradient(torch.cat([of_words, of_new.flip(0)]), known[matrix.replace("before", "gradient")])
    for name, theirs in places(known).items():
        same_gradient(own[name].grad, known[f"gradient.{theirs}"])
    torch.optim.AdamW(own.values(), lr=2e-4).step()
    close(model(ids, features, labels).loss, known["loss_after"], 1e-4)


EXTENDED = ("model.embed_tokens.weight", "lm_head.weight")


def places(known: Numbers) -> dict[str, str]:
    """Our names of projection and adapter, and theirs."""
    theirs = [n.removeprefix("before.") for n in known if n.startswith("before.") and "embed_tokens" not in n]
    adapted = {n: n.removeprefix("llm.").replace("_A.weight", "_A.default.weight") for n in theirs if "lora_" in n}
    adapted = {n: f"llm.{name.replace('_B.weight', '_B.default.weight')}" for n, name in adapted.items()}
    return {adapted.get(n, n.replace("project", "connector.projection")): n for n in theirs}


# ---- the converted checkpoint ----


@pytest.mark.parametrize("together", [True, False])
def test_published_tokens(octopi: Octopi, classifier: PropertyClassifier, together: bool) -> None:
    prompts, features, wanted = [], [], []
    for number, question in enumerate(texts("questions/eval.json")):
        known = numbers(f"answers_lora_{number}")
        prompts.append(write_prompt([turn_of(question[1]["content"])], octopi.llm.tokenizer, LANGUAGE, 5))
        frames, places = (known[key].flatten(0, 1) for key in ("pixel_values", "frame_indices"))
        features.append(classifier.encoder(frames, places).detach())
        wanted.append(octopi.llm.tokenizer.decode(known["generated"][1:], skip_special_tokens=True).strip())
    if together:
        said = reply(octopi.llm, prompts, features, LANGUAGE)
    else:
        said = [reply(octopi.llm, [p], [f], LANGUAGE)[0] for p, f in zip(prompts, features, strict=True)]
    assert [answer.text for answer in said] == wanted
    assert [answer.tokens for answer in said] == [len(numbers(f"answers_lora_{i}")["generated"]) - 1 for i in range(5)]


VIDEO = GOLDEN / "video/drawn_press_0.mov"


def test_without_heads_the_sentence_names_the_classes(octopi: Octopi) -> None:
    convert(GOLDEN / "checkpoints/lora", "--trust-pickle", to="models/headless")
    headless = Octopi.from_pretrained("models/headless", device="cpu")
    found, known = headless.describe(VIDEO), octopi.describe(VIDEO)
    assert found.probabilities == {}
    assert found.sentence == known.sentence
    assert found.levels.keys() <= {"hardness", "roughness", "bumpiness"}
    assert all(level in found.sentence for level in found.levels.values())
    assert any("no property heads" in note for note in found.notes)
    assert known.probabilities["hardness"].keys() == {"soft", "moderately hard", "hard"}
    assert "orange" not in headless.config.objects
    assert "ice_block" in headless.config.objects


def test_a_wrong_file_is_named(source: Path, octopi: Octopi, tmp_path: Path) -> None:
    with refused("name it with --base"):
        bases = ["--base", str(GOLDEN / "base/vicuna"), "--clip", str(GOLDEN / "base/clip"), "--trust-pickle"]
        arguments = ["weights", "octopi-7b", str(source), *bases, "--to", "models/again"]
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    with refused("encoder.pt is a pickle"):
        convert(source, to="models/untrusted")
    shutil.copytree(source, tmp_path / "broken")
    cut(tmp_path / "broken/project.pt", 500)
    with refused("project.pt is cut off"):
        convert(tmp_path / "broken", "--trust-pickle", to="models/broken")
    (tmp_path / "broken/project.pt").unlink()
    with refused("project.pt does not exist"):
        convert(tmp_path / "broken", "--trust-pickle", to="models/broken")
    state = torch.load(source / "encoder.pt", weights_only=True)
    del state["model.vision_model.encoder.layers.3.VPT_shallow"]
    shutil.copy(source / "project.pt", tmp_path / "broken")
    torch.save(state, tmp_path / "broken/encoder.pt")
    with refused("prompts of 3 layers for 4"):
        convert(tmp_path / "broken", "--trust-pickle", to="models/broken")
    assert not Path("models/broken").exists()


def test_clip_of_transformers_is_the_same_in_open_clip(octopi: Octopi, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without prompts, by transformers' own model, whose features the published code gave."""
    from pipeline.encoder.release import base_encoder

    known = numbers("encoder")
    encoder = base_encoder(EncoderConfig(recipe="release", weights=str(octopi.folder / "encoder/backbone")))
    monkeypatch.setattr(type(encoder), "pixels", lambda _, pictures: pictures)
    found = encoder(known["0.pixel_values"], known["0.frame_indices"]) - known["0.sinusoid"]
    close(found, known["0.base_clip_features"])
    assert to_open_clip({"vision_model.embeddings.position_ids": torch.arange(3)}) == {}
