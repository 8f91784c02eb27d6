"""Counted memory, work and disk against what torch keeps, holds at once and counts itself, and published sizes."""

from __future__ import annotations

import shlex
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import open_clip
import pytest
import torch
from peft import LoraConfig, get_peft_model
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode
from transformers import DynamicCache, LlamaForCausalLM
from typer.testing import CliRunner

from pipeline.cli import app
from pipeline.core.errors import UserError
from pipeline.core.records import Encoder, Part
from pipeline.encoder.clip import VisualPrompts
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.scales import compose
from pipeline.scales.cost import Hours, costs, disk, embedded, measured_rate, work
from pipeline.scales.memory import (
    GIB,
    Lengths,
    Use,
    adapted,
    count,
    language_kept,
    language_uses,
    launched,
    read_shapes,
    tower_kept,
    trained_parameters,
)
from pipeline.videos.catalogue import Catalogue
from pipeline.weights.check import parameters, read_language, read_tower
from tests.checkpoints import write_clip, write_llama
from tests.closure import ROOT


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


def tower_of(layers: int, width: int, heads: int, *, quick: bool = True, **sides: int) -> Any:
    """open_clip's, frozen, with fresh weights."""
    tower = open_clip.transformer.VisionTransformer(
        width=width,
        layers=layers,
        heads=heads,
        mlp_ratio=4.0,
        act_layer=open_clip.transformer.QuickGELU if quick else nn.GELU,
        **sides,
    )
    return tower.requires_grad_(False).eval()


@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize("autocast", [False, True])
def test_a_tower_with_prompts_keeps_what_is_counted(autocast: bool, quick: bool) -> None:
    tower = tower_of(3, 64, 4, quick=quick, patch_size=4, image_size=32, output_dim=24)
    prompts = VisualPrompts(tower, 5)
    prompts.attach(tower)

    def run() -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            found: torch.Tensor = tower(torch.randn(6, 3, 32, 32))
        return found

    expected, _ = tower_kept(tower, 6, 5, 2 if autocast else 4)
    if autocast:
        # A GPU's autocast normalises in float32, a CPU's in the format that comes.
        expected -= 6 * (65 + 5) * 64 * 2 * (2 * 3 + 1)
    assert kept(run, [tower, prompts]) == pytest.approx(expected, rel=0.015)


@pytest.mark.parametrize(
    ("stage", "words", "targets", "dropout", "keys", "dtype"),
    [
        ("align", False, "all-linear", 0.0, 2, "bfloat16"),
        ("align", True, "all-linear", 0.0, 4, "float32"),
        ("lora", False, "[q_proj,k_proj]", 0.0, 2, "float32"),
        ("lora", False, "[q_proj,k_proj]", 0.1, 4, "bfloat16"),
        ("lora", False, "[o_proj,up_proj]", 0.0, 4, "float32"),
        ("lora", False, "all-linear", 0.1, 2, "float32"),
        ("lora", True, "all-linear", 0.0, 2, "bfloat16"),
    ],
)
def test_a_training_step_trains_and_keeps_what_is_counted(
    stage: str, words: bool, targets: str, dropout: float, keys: int, dtype: str, tmp_path: Path
) -> None:
    weights = write_llama(
        tmp_path, hidden_size=64, intermediate_size=160, num_hidden_layers=3, num_key_value_heads=keys
    )
    lora = [f"lora.target_modules={targets}", "lora.rank=8", f"lora.dropout={dropout}"]
    params = compose(
        "smoke",
        [
            *(f"language.weights={weights}", f"language.dtype={dtype}", "align.micro_batch_size=2", *lora),
            f"align.train_embeddings={'all' if words else 'new'}",
        ],
    )
    config, shapes = getattr(params, stage), read_language(weights)
    assert shapes is not None
    model = OctopiForCausalLM.from_base(weights, 6, dtype=params.language.dtype)
    assert parameters(shapes) == parameters(model.llm)
    rows, length, learnt = config.micro_batch_size, 120, 40
    expected = language_kept(params, shapes, config, Lengths(length, learnt, 0))
    if words:
        model.train_words()
    connector, vocabulary, adapters = trained_parameters(params, shapes, 6)
    assert connector + vocabulary == sum(p.numel() for p in model.parameters() if p.requires_grad)
    if stage == "lora":
        wanted = targets if targets == "all-linear" else list(config.target_modules)
        form = LoraConfig(r=8, lora_dropout=dropout, target_modules=wanted, task_type="CAUSAL_LM")
        model.llm = get_peft_model(model.llm, form)
        trained = [p for name, p in model.llm.named_parameters() if "lora_" in name]
        assert adapters == sum(p.numel() for p in trained)
        for parameter in trained:
            parameter.data = parameter.data.float()
        # A GPU remembers what is dropped in one byte, a CPU in four.
        ends = adapted(shapes, config).values()
        expected += 3 * rows * length * 3 * sum(a for a, _ in ends) if dropout else 0
    ids = torch.randint(4, 200, (rows, length), generator=torch.manual_seed(0))
    ids[:, 5:10] = model.frame_id
    labels = torch.full_like(ids, -100)
    labels[:, -learnt:] = ids[:, -learnt:]
    found = kept(lambda: model.train()(ids, torch.randn(rows, 5, 6), labels=labels).loss, [model])
    assert found == pytest.approx(expected, rel=0.03)


def test_a_cache_holds_what_is_counted(tmp_path: Path) -> None:
    model = LlamaForCausalLM.from_pretrained(write_llama(tmp_path), dtype=torch.float32)
    cache = DynamicCache(config=model.config)
    model(torch.ones(2, 7 + 8, dtype=torch.long), past_key_values=cache)
    params = compose("smoke", ["language.generation_batch_size=2", "language.max_new_tokens=8"])
    *_, answer = language_uses(params, model, 6, Lengths(0, 0, prompt=7))
    assert sum(layer.keys.nbytes + layer.values.nbytes for layer in cache.layers) == answer.cache


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


class Held(TorchDispatchMode):
    """The bytes of all tensors that exist at once, counted as operations make them: no process or heap is measured."""

    def __init__(self) -> None:
        super().__init__()
        self.now = self.most = 0
        self._known: weakref.WeakSet[torch.UntypedStorage] = weakref.WeakSet()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = func(*args, **(kwargs or {}))
        for tensor in tree_leaves(made):
            if isinstance(tensor, torch.Tensor) and (storage := tensor.untyped_storage()) not in self._known:
                self._known.add(storage)
                self._add(storage.nbytes())
                weakref.finalize(storage, self._add, -storage.nbytes())
        return made

    def _add(self, size: int) -> None:
        self.now += size
        self.most = max(self.most, self.now)


def test_what_passes_is_counted_too() -> None:
    """Forward and backward through a tower: the largest sum of all tensors that exist at once, its weights aside."""
    tower = tower_of(8, 128, 4, patch_size=8, image_size=112, output_dim=32)
    VisualPrompts(tower, 8).attach(tower)
    with Held() as held:
        for parameter in tower.parameters():
            parameter.view(-1)
        weights = held.now
        tower(torch.zeros(4, 3, 112, 112)).sum().backward()
    alone, passing = tower_kept(tower, 4, 8, 4)
    assert held.most - weights == pytest.approx(alone + passing, rel=0.05)
    assert alone * 1.05 < held.most - weights, "what is kept alone is less"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("autocast", [False, True])
def test_a_gpu_takes_what_is_counted(autocast: bool) -> None:
    """CLIP ViT-L/14 at its true shapes, four videos of five frames."""
    with torch.device("cuda"):
        tower = tower_of(24, 1024, 16, patch_size=14, image_size=224, output_dim=768)
        prompts = VisualPrompts(tower, 8)
        frames = torch.zeros(20, 3, 224, 224)
    prompts.attach(tower)
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    with torch.autocast("cuda", torch.bfloat16, enabled=autocast):
        loss = tower(frames).sum()
    loss.backward()
    expected = sum(tower_kept(tower, 20, 8, 2 if autocast else 4))
    assert torch.cuda.max_memory_allocated() - before == pytest.approx(expected, rel=0.15)


def test_launchers_are_read() -> None:
    assert launched("python") == (1, False)
    assert launched("accelerate launch --num_processes 1") == (1, False)
    named = f"accelerate launch --config_file {shlex.quote(f'{ROOT}/conf/accelerate/fsdp.yaml')}"
    assert launched(named) == (2, True)
    assert launched(f"{named} --num_processes 4") == launched(f"{named} --num-processes=4") == (4, True)
    for wrong, message in (
        ("accelerate launch --config_file", "expected one argument"),
        ("a --num_processes b", "int"),
        ("accelerate launch --config_file nowhere.yaml", "nowhere.yaml is no configuration of accelerate's"),
        (f"a --config_file {shlex.quote(f'{ROOT}/Makefile')}", "Makefile is no configuration of accelerate's"),
    ):
        with pytest.raises(UserError, match=rf"^runtime.launcher: .*{message}"):
            launched(wrong)


def test_the_papers_scales_fit_the_cards_they_name_and_what_does_not_is_said() -> None:
    """7b on one card of 48 GB, or of 24 GB, and 13b on two of 48 GB, with room left for what is not counted."""
    said = {}
    for scale, card in (("paper-7b", 48e9), ("paper-13b", 48e9)):
        params = compose(scale)
        shapes = read_shapes(params)
        uses = count(params, shapes)
        assert [use.stage for use in uses] == ["finetune_encoder", "embed", "align", "lora", "answer"]
        assert max(use.total for use in uses) < card - GIB
        assert "published" in " ".join(shapes.notes)
        said |= {(scale, gpu): "\n".join(costs(params, shapes, uses, gpu)) for gpu in ("rtx4090", "h100")}
        with pytest.raises(UserError, match="--card a600: not known; did you mean a6000"):
            list(costs(params, shapes, uses, "a600"))
    for words in ("lmsys/vicuna-7b-v1.5, 13 GB", "lora nears 24 GiB: set lora.micro_batch_size=1", "(8 runs)"):
        assert words in said["paper-7b", "rtx4090"]
    assert "nears" not in said["paper-7b", "h100"]
    assert "Host memory" not in said["paper-7b", "h100"]
    assert "answer exceeds 24 GiB: set language.quantization=nf4" in said["paper-13b", "rtx4090"]
    # 13.016e9 weights of 2 bytes, by transformers' own count of this configuration.
    words = "each of 2 processes loads the whole language model (26 GB) before it keeps its share, 52.1 GB"
    assert words in said["paper-13b", "rtx4090"]


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


def test_a_training_s_operations_are_torch_s_own_count(tmp_path: Path) -> None:
    """Of a Llama whose weights are frozen, but not what it reads; attention's own products, which grow with the length,
    are left out."""
    folder = write_llama(tmp_path / "llama", hidden_size=128, intermediate_size=320, num_hidden_layers=3)
    model = LlamaForCausalLM.from_pretrained(folder, dtype=torch.float32)
    model.requires_grad_(False)
    tokens = 24
    embedded = model.get_input_embeddings()(torch.zeros(1, tokens, dtype=torch.long)).requires_grad_()
    with FlopCounterMode(display=False) as counter:
        model.model(inputs_embeds=embedded).last_hidden_state.sum().backward()
    params = compose(
        "smoke",
        [
            *("ablation.encoders=[finetuned]", "ablation.lora=[with]", "ablation.opd=[all]"),
            *("align.samples=1", "align.epochs=1", f"language.weights={folder}"),
        ],
    )
    lengths = Lengths(tokens, 0, 0, mean_training=tokens, mean_answer=0, mean_prompt=0)
    found = work(params, read_shapes(params)._replace(lengths=lengths), 0, {})
    aligned = next(h for h in found if h.stage == "align")
    assert aligned.work == pytest.approx(counter.get_total_flops(), rel=0.1)


def test_embeddings_are_counted_of_kept_frames_and_mirrored_where_trained_on(catalogue: Catalogue) -> None:
    """By hand: 7 of 24 frames are kept, and not `frames.per_video`, the 5 that are shown."""
    lists = ["ablation.encoders=[finetuned,base,words]", "ablation.seeds=[0,1]", "encoder.embedding=logits"]
    params = compose("smoke", lists)
    objects = [*params.scenes.objects] * 2
    trained = 2 * sum(catalogue.objects[o].splits["paper"] is Part.TRAIN for o in params.scenes.objects)
    rows = 7 * (4 * trained + len(objects) - trained)
    found = embedded(params, catalogue, objects)
    assert found == {"finetuned": (2 * rows, 2 * rows), "base": (rows, 2 * rows), "words": (0, 2 * rows)}
    plain = embedded(compose("smoke", [*lists, "encoder.flip_probability=0"]), catalogue, objects)
    assert plain[Encoder.BASE] == (7 * len(objects), 2 * 7 * len(objects))
    shapes = read_shapes(params)._replace(embedding=1000)
    written = f"{4e3 * 6 * rows / 1e9:.2g}"
    assert f"(embeddings {written}" in disk(params, shapes, found, {"align": 0, "lora": 0})


def test_hours_are_the_longer_of_computing_and_reading() -> None:
    assert Hours("answer", 1, work=3600e12, read=0).on(1e12, 1e9) == 1
    assert Hours("answer", 1, work=3600e12, read=7200e9).on(1e12, 1e9) == 2
    assert Hours("answer", 1, work=3600e12, read=7200e9).on(1e12, None) == 1
    assert 1e8 < measured_rate(side=256, seconds=0.05) < 1e14


def test_a_plan_needs_nothing_and_writes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("pipeline.scales.write_params", lambda *_: 1 / 0)
    monkeypatch.setattr("pipeline.scales.check_inputs", lambda *_: 1 / 0)
    said = CliRunner().invoke(app, ["scale", "paper-13b", "--plan", "--card", "a6000"])
    assert said.exit_code == 0, said.output
    assert "8 variants; nothing is written." in said.output
