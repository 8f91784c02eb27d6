"""Counted memory and disk against what torch keeps, the measured rehearsal, and published sizes."""

import re
import shlex
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest
import torch
from peft import LoraConfig, get_peft_model
from torch import nn

from pipeline.core.records import Part
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.scales import compose
from pipeline.scales.cost import card, costs, disk, embedded
from pipeline.scales.memory import GIB, Use, count, launched, read_shapes, trained_parameters
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.split import ENOUGH, MORE, few
from pipeline.weights.check import parameters, read_language, read_tower
from tests.checkpoints import write_clip, write_llama
from tests.conftest import ROOT, octopi, refused


@pytest.fixture(autouse=True)
def at_home(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the catalogue lies that scales name."""
    monkeypatch.chdir(ROOT)


def kept(run: Callable[[], torch.Tensor], modules: Iterable[nn.Module]) -> int:
    """Bytes that autograd keeps of a computation, the modules' own aside; each storage once."""
    own = {t.untyped_storage().data_ptr() for m in modules for t in (*m.parameters(), *m.buffers())}
    seen: dict[int, torch.Tensor] = {}

    def pack(tensor: torch.Tensor) -> torch.Tensor:
        if tensor.untyped_storage().data_ptr() not in own:
            seen[tensor.untyped_storage().data_ptr()] = tensor
        return tensor

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
        run()
    return sum(tensor.untyped_storage().nbytes() for tensor in seen.values())


@pytest.mark.parametrize(
    ("stage", "words", "targets", "keys", "dtype"),
    [
        ("align", False, "all-linear", 2, "bfloat16"),
        ("align", True, "all-linear", 4, "float32"),
        ("lora", False, "[q_proj,k_proj]", 2, "float32"),
        ("lora", True, "all-linear", 2, "bfloat16"),
    ],
)
def test_a_step_is_as_counted(stage: str, words: bool, targets: str, keys: int, dtype: str, tmp_path: Path) -> None:
    """Of what autograd keeps, the small change is not counted, and a byte for dropout that is not there is."""
    weights = write_llama(
        tmp_path, hidden_size=64, intermediate_size=160, num_hidden_layers=3, num_key_value_heads=keys
    )
    params = compose(
        "smoke",
        [
            *(f"language.weights={weights}", f"language.dtype={dtype}", "align.micro_batch_size=2"),
            *(f"lora.target_modules={targets}", "lora.rank=8", "lora.dropout=0"),
            f"align.train_embeddings={'all' if words else 'new'}",
        ],
    )
    config, length, learnt = getattr(params, stage), 120, 40
    shapes = read_shapes(params)._replace(longest=(length, learnt), embedding=6)
    assert shapes.llm is not None
    model = OctopiForCausalLM.from_base(weights, 6, dtype=params.language.dtype)
    assert parameters(shapes.llm) == parameters(model.llm)
    if words:
        model.train_words()
    connector, vocabulary, adapters = trained_parameters(params, shapes.llm, 6)
    assert connector + vocabulary == sum(p.numel() for p in model.parameters() if p.requires_grad)
    if stage == "lora":
        wanted = targets if targets == "all-linear" else list(config.target_modules)
        model.llm = get_peft_model(model.llm, LoraConfig(r=8, target_modules=wanted, task_type="CAUSAL_LM"))
        trained = [p for name, p in model.llm.named_parameters() if "lora_" in name]
        assert adapters == sum(p.numel() for p in trained)
        for parameter in trained:
            parameter.data = parameter.data.float()
    rows = config.micro_batch_size
    ids = torch.randint(4, 200, (rows, length), generator=torch.manual_seed(0))
    ids[:, 5:10] = model.frame_id
    labels = torch.full_like(ids, -100)
    labels[:, -learnt:] = ids[:, -learnt:]
    found = kept(lambda: model.train()(ids, torch.randn(rows, 5, 6), labels=labels).loss, [model])
    use = next(use for use in count(params, shapes) if use.stage == stage)
    vocabulary = shapes.llm.config.vocab_size
    passing = max(2 * rows * learnt * vocabulary * 4, 3 * rows * length * 160 * (2 if dtype == "bfloat16" else 4))
    assert found == pytest.approx(use.activations - passing, rel=0.15)


def test_published_models_have_their_published_sizes() -> None:
    large = read_tower(Path("nowhere/clip-vit-large-patch14"))
    assert large is not None
    # transformers' CLIPVisionModelWithProjection of openai/clip-vit-large-patch14.
    assert parameters(large) == 303_966_208
    # Those of Llama 2 (Touvron et al. 2023), which Vicuna v1.5 was tuned from; and of what data/weights/smollm2 holds.
    sizes = {"vicuna-7b-v1.5": 6_738_415_616, "vicuna-13b-v1.5": 13_015_864_320, "smollm2": 134_515_008}
    for name, size in sizes.items():
        model = read_language(Path("nowhere") / name)
        assert model is not None
        assert parameters(model) == size


def test_the_rehearsal_took_what_is_counted() -> None:
    """Peaks of the processes in GiB, as they were measured: docs/scale.md. Python and its libraries take the rest."""
    params = compose("rehearsal")
    counted = {use.stage: use.total / GIB for use in count(params, read_shapes(params))}
    peaks = {"finetune_encoder": 4.8, "embed": 3.2, "align": 17.1, "lora": 18.0, "answer": 15.1}
    assert counted.keys() == peaks.keys()
    assert all(1.5 < peak - counted[stage] < 2.0 for stage, peak in peaks.items()), counted


def test_launchers_are_read() -> None:
    assert launched("python") == (1, False)
    assert launched("accelerate launch --num_processes 1") == (1, False)
    named = f"accelerate launch --config_file {shlex.quote(f'{ROOT}/conf/accelerate/fsdp.yaml')}"
    assert launched(named) == (2, True)
    assert launched(f"{named} --num_processes 4") == launched(f"{named} --num-processes=4") == (4, True)
    for wrong, message in (
        ("a --num_processes b", "int"),
        ("accelerate launch --config_file nowhere.yaml", "No such file.*nowhere.yaml"),
        (f"a --config_file {shlex.quote(f'{ROOT}/Makefile')}", "Makefile.*; name a configuration of accelerate's"),
    ):
        with refused(rf"^runtime.launcher: .*{message}"):
            launched(wrong)


def test_the_papers_scales_fit_the_cards_they_name() -> None:
    """On cards of 48 GB, the paper's two for 13b, with room left for what is not counted."""
    said = {}
    for scale in ("paper-7b", "paper-13b"):
        params = compose(scale)
        shapes = read_shapes(params)
        uses = [*count(params, shapes)]
        assert [use.stage for use in uses] == ["finetune_encoder", "embed", "align", "lora", "answer"]
        assert max(use.total for use in uses) < 48e9 - GIB
        assert "published" in " ".join(shapes.notes)
        said[scale] = "\n".join(costs(params, shapes))
    # 6.738e9 weights of 2 bytes, in pickles and converted, and CLIP's.
    ((total, parts),) = re.findall(r"GB: ([\d.]+) in all \((.*)\)", said["paper-7b"])
    assert f"downloads {1.7 + 4 * 6.738:.0f}" in parts
    assert float(total) == pytest.approx(sum(float(part) for part in re.findall(r" ([\d.]+)", parts)), abs=1)
    assert "Hours: 26, " in said["paper-7b"], "one encoder of 6 and four language models of 5"
    seven = compose("paper-7b")
    assert "Card: 40 GB" in card(seven, [*count(seven, read_shapes(seven))])
    smaller = compose("paper-7b", ["runtime.gradient_checkpointing=true"])
    assert "Card: 24 GB" in card(smaller, [*count(smaller, read_shapes(smaller))]), "as docs/scale.md says"
    assert "clip_224.openai, 1.7 GB with its text tower, to" in said["paper-7b"]
    sparsh = compose("small", ["encoder.weights=weights/sparsh-dino-base"])
    assert "facebook/sparsh-dino-base, to weights" in "\n".join(costs(sparsh, read_shapes(sparsh))), "of unknown size"
    # 13.016e9 weights of 2 bytes, by transformers' own count of this configuration.
    words = "each of 2 processes loads the whole language model (26 GB) before it keeps its share, 52.1 GB"
    assert words in said["paper-13b"]


def test_settings_move_what_they_should() -> None:
    shapes = read_shapes(compose("paper-7b"))

    def uses(*overrides: str, embedding: int = 1024) -> dict[str, Use]:
        return {u.stage: u for u in count(compose("paper-7b", overrides), shapes._replace(embedding=embedding))}

    usual, two = uses(), uses("encoder.micro_batch_size=2")["finetune_encoder"]
    assert two.total / GIB < 5 < usual["finetune_encoder"].total / GIB, "the paper's encoder took less than 5 GB"
    assert two.activations == pytest.approx(usual["finetune_encoder"].activations / 4)
    checkpointed = uses("runtime.gradient_checkpointing=true")
    assert checkpointed["lora"].activations < usual["lora"].activations / 4
    assert max(use.total for use in checkpointed.values()) < 24e9 - GIB
    assert uses("language.quantization=nf4")["lora"].parameters < usual["lora"].parameters / 2.5
    shared = uses("runtime.launcher=accelerate launch --config_file conf/accelerate/fsdp.yaml")["lora"]
    assert shared.devices == 2
    assert usual["lora"].parameters / 2 < shared.parameters < usual["lora"].parameters
    assert usual["lora"].optimizer / 2 < shared.optimizer < usual["lora"].optimizer
    new, words = uses("align.train_embeddings=new"), 32000 * 4096
    for stage in ("align", "lora"):
        assert usual[stage].parameters - new[stage].parameters == 4 * words
        assert usual[stage].optimizer - new[stage].optimizer == 12 * words
    assert usual["answer"].total - new["answer"].total == 4 * words
    # Of ViT-L/14: a class token of 1024 values, or 768 behind its projection; 9 classes.
    projected = uses("encoder.embedding=projected", embedding=768)
    assert usual["finetune_encoder"].optimizer - projected["finetune_encoder"].optimizer == 12 * 256 * 9
    assert usual["align"].optimizer - projected["align"].optimizer == 12 * 256 * 4096


def test_folders_are_read_and_unknown_ones_named(tmp_path: Path) -> None:
    clip, none = write_clip(tmp_path / "clip"), tmp_path / "model"
    params = compose("smoke", [f"encoder.weights={clip}", f"language.weights={none}"])
    shapes = read_shapes(params)
    assert [use.stage for use in count(params, shapes)] == ["finetune_encoder", "embed"]
    assert any(str(none) in note and "not counted" in note for note in shapes.notes)
    # By the heads' logits the language model gets 9 classes, whatever the encoder.
    for embedding, length in (("projected", 768), ("class_token", 1024), ("logits", 9)):
        changed = [f"encoder.embedding={embedding}", "encoder.standardize=true", "language.weights=weights/none"]
        assert read_shapes(compose("paper-7b", changed)).embedding == length


def test_embeddings_are_counted_of_kept_frames_and_mirrored_where_trained_on(catalogue: Catalogue) -> None:
    """By hand: 7 of 24 frames are kept, and not `frames.per_video`, the 5 that are shown."""
    lists = ["ablation.encoders=[finetuned,base]", "ablation.seeds=[0,1]", "encoder.embedding=logits"]
    params = compose("smoke", lists)
    objects = [*params.scenes.objects] * 2
    trained = 2 * sum(catalogue.objects[o].splits["paper"] is Part.TRAIN for o in params.scenes.objects)
    rows = 7 * (4 * trained + len(objects) - trained)
    assert embedded(params, catalogue, objects) == 2 * 2 * rows
    plain = embedded(compose("smoke", [*lists, "encoder.flip_probability=0"]), catalogue, objects)
    assert plain == 2 * 2 * 7 * len(objects)
    shapes = read_shapes(params)._replace(embedding=1000)
    written = f"{4e3 * 4 * rows / 1e9:.2g}"
    assert f"(embeddings {written}" in disk(params, shapes, objects)


def test_a_plan_needs_nothing_and_writes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.scales.write_params", lambda *_: 1 / 0)
    monkeypatch.setattr("pipeline.scales.check_inputs", lambda *_: 1 / 0)
    assert "8 variants; nothing is written." in octopi("scale", "paper-13b", "--plan")
    said = octopi("scale", "evaluate", "--plan")
    assert "Nothing is trained: " in said
    assert "lora" not in said


def test_few_objects_are_named_before_anything_runs(tmp_path: Path, catalogue: Catalogue) -> None:
    """Of twelve, a fold of three has seven to train on; files need not decode for that."""
    for name in list(catalogue.objects)[:12]:
        (tmp_path / f"{name}_0.mp4").touch()
    videos = ["data.source=videos", f"data.dir={tmp_path}"]
    said = octopi("scale", "small", "--plan", *videos)
    assert f"Objects under seed 0: 7 objects to train on, 1 to validate, 4 to test; {MORE}." in said
    document, _, section = MORE.partition("(")[2].strip(")").partition(", ")
    assert f"\n## {section}\n" in (ROOT / document).read_text()
    parts = dict.fromkeys(list(catalogue.objects)[:ENOUGH], Part.TRAIN)
    assert not few(parts, parts)
    assert few(parts, list(parts)[1:]).startswith("9 objects to train on")
