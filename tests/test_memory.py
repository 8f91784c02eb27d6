"""Counted memory against what torch keeps and holds at once, and published numbers of parameters."""

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
from transformers import DynamicCache, LlamaConfig, LlamaForCausalLM

from pipeline.core.errors import UserError
from pipeline.encoder.vpt import VisualPrompts
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.scales import compose
from pipeline.scales.memory import ADAM, GIB, Lengths, Use, count, language_saved, launched, table
from pipeline.weights.shapes import PUBLISHED_LANGUAGE, PUBLISHED_VISION, Llama, Vision
from tests.checkpoints import write_clip, write_llama
from tests.closure import ROOT

LINEAR = ("q_proj", "k_proj", "v_proj", "o_proj", "gate_proj", "up_proj", "down_proj")
ROWS, LENGTH, RANK = 2, 60, 8


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


def llama(keys: int) -> tuple[LlamaForCausalLM, Llama]:
    form = LlamaConfig(
        hidden_size=64,
        intermediate_size=160,
        num_hidden_layers=3,
        num_attention_heads=4,
        num_key_value_heads=keys,
        vocab_size=100,
    )
    return LlamaForCausalLM(form).requires_grad_(False), Llama(64, 160, 3, 4, 100, keys, 16)


def tower_of(shape: Vision) -> open_clip.transformer.VisionTransformer:
    """Frozen, with fresh weights."""
    tower = open_clip.transformer.VisionTransformer(
        image_size=shape.image_size,
        patch_size=shape.patch_size,
        width=shape.width,
        layers=shape.layers,
        heads=shape.width // shape.head_width,
        mlp_ratio=4.0,
        output_dim=shape.embed_dim,
        act_layer=open_clip.transformer.QuickGELU if shape.quick_gelu else nn.GELU,
    )
    return tower.requires_grad_(False).eval()


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("dropout", [0.0, 0.1])
@pytest.mark.parametrize("targets", [(), LINEAR[:2], LINEAR[3:], LINEAR])
@pytest.mark.parametrize("keys", [4, 2])
def test_a_llama_keeps_what_is_counted(keys: int, targets: tuple[str, ...], dropout: float, dtype: torch.dtype) -> None:
    model, shape = llama(keys)
    assert shape.parameters == sum(p.numel() for p in model.parameters())
    body: nn.Module = model.to(dtype)
    size = dtype.itemsize
    expected = 3 * shape.saved_layer(size)
    if targets:
        body = get_peft_model(model, LoraConfig(r=RANK, lora_dropout=dropout, target_modules=list(targets)))
        adapters = [p for p in body.parameters() if p.requires_grad]
        assert shape.adapters(targets, RANK) == sum(p.numel() for p in adapters)
        for parameter in adapters:
            parameter.data = parameter.data.float()
        expected += 3 * shape.saved_adapters(targets, RANK, size, dropout > 0)
        if dropout:
            # A GPU remembers what is dropped in one byte, a CPU in four.
            expected += 3 * 3 * sum(shape.linear[t][0] for t in targets)
    start = torch.randn(ROWS, LENGTH, 64, dtype=dtype, requires_grad=True)
    found = kept(lambda: model.model(inputs_embeds=start * 1, use_cache=False).last_hidden_state, [body.train()])
    assert found == pytest.approx(ROWS * LENGTH * (expected + 4 * 65), rel=0.01)


@pytest.mark.parametrize("quick", [True, False])
@pytest.mark.parametrize("autocast", [False, True])
def test_a_tower_with_prompts_keeps_what_is_counted(autocast: bool, quick: bool) -> None:
    shape = Vision(3, 64, patch_size=4, image_size=32, embed_dim=24, head_width=16, quick_gelu=quick)
    tower = tower_of(shape)
    assert shape.parameters == sum(p.numel() for p in tower.parameters())
    prompts = VisualPrompts(3, 5, 64, 48)
    prompts.attach(tower)

    def run() -> torch.Tensor:
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            return tower(torch.randn(6, 3, 32, 32))

    expected = shape.saved(6, 5, 2 if autocast else 4)
    if autocast:
        # A GPU's autocast normalises in float32, a CPU's in the format that comes.
        expected -= 6 * (shape.tokens + 5) * 64 * 2 * (2 * 3 + 1)
    assert kept(run, [tower, prompts]) == pytest.approx(expected, rel=0.015)


@pytest.mark.parametrize(("stage", "words"), [("align", False), ("align", True), ("lora", False), ("lora", True)])
def test_a_whole_training_step_keeps_what_is_counted(stage: str, words: bool, tmp_path: Path) -> None:
    weights = write_llama(tmp_path, hidden_size=64, intermediate_size=160, num_hidden_layers=3)
    params = compose(
        "smoke",
        [f"language.weights={weights}", "lora.rank=8", "lora.dropout=0", "align.micro_batch_size=2"],
        ROOT / "conf",
    )
    config, shape = getattr(params, stage), Llama.read(weights)
    assert shape is not None
    model = OctopiForCausalLM.from_base(weights, 6)
    if words:
        model.train_words()
    if stage == "lora":
        model.llm = get_peft_model(model.llm, LoraConfig(r=8, target_modules=list(config.target_modules)))
    rows, learnt = config.micro_batch_size, 40
    ids = torch.randint(4, 200, (rows, 120), generator=torch.manual_seed(0))
    ids[:, 5:10] = model.frame_id
    labels = torch.full_like(ids, -100)
    labels[:, -learnt:] = ids[:, -learnt:]
    found = kept(lambda: model.train()(ids, torch.randn(rows, 5, 6), labels=labels).loss, [model])
    assert found == pytest.approx(language_saved(params, shape, config, Lengths(120, learnt, 0)), rel=0.03)


def test_an_optimizer_and_a_cache_hold_what_is_counted() -> None:
    model, shape = llama(2)
    part = model.model.layers[0].requires_grad_(True)
    model(torch.ones(ROWS, 7, dtype=torch.long)).logits.sum().backward()
    optimizer = torch.optim.AdamW(part.parameters())
    optimizer.step()
    means = [v for s in optimizer.state.values() for k, v in s.items() if k != "step"]
    tensors = [*means, *(p.grad for p in part.parameters() if p.grad is not None)]
    assert sum(t.nbytes for t in tensors) == ADAM * sum(p.numel() for p in part.parameters())
    cache = DynamicCache(config=model.config)
    model(torch.ones(ROWS, 7, dtype=torch.long), past_key_values=cache)
    assert sum(layer.keys.nbytes + layer.values.nbytes for layer in cache.layers) == shape.cache(ROWS * 7, 4)


def test_published_models_have_their_published_sizes() -> None:
    towers = {name: Vision(**form) for name, form in PUBLISHED_VISION.items()}
    (large,) = towers.values()
    # transformers' CLIPVisionModelWithProjection of openai/clip-vit-large-patch14.
    assert large.parameters == 303_966_208
    # Counted before, by hooks, at true shapes: 32 videos of five frames with eight prompts.
    assert large.saved(160, 8, 4) / GIB == pytest.approx(54.6, rel=0.01)
    sizes = {}
    for name in PUBLISHED_LANGUAGE:
        shape = Llama.read(Path("nowhere") / name)
        assert shape is not None
        sizes[name] = shape.parameters
    # Those of Llama 2 (Touvron et al. 2023), which Vicuna v1.5 was tuned from; and of what data/weights/smollm2 holds.
    assert sizes == {
        "vicuna-7b-v1.5": 6_738_415_616,
        "vicuna-13b-v1.5": 13_015_864_320,
        "smollm2": 134_515_008,
    }


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
    shape = Vision(8, 256, patch_size=16, image_size=224, embed_dim=64, head_width=64, quick_gelu=True)
    tower = tower_of(shape)
    VisualPrompts(8, 8, 256, 768).attach(tower)
    with Held() as held:
        for parameter in tower.parameters():
            parameter.view(-1)
        weights = held.now
        tower(torch.zeros(8, 3, 224, 224)).sum().backward()
    expected = shape.saved(8, 8, 4) + shape.passing(8, 8, 4)
    assert held.most - weights == pytest.approx(expected, rel=0.05)
    assert shape.saved(8, 8, 4) * 1.05 < held.most - weights, "what is kept alone is less"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("autocast", [False, True])
def test_a_gpu_takes_what_is_counted(autocast: bool) -> None:
    """CLIP ViT-L/14 at its true shapes, four videos of five frames."""
    shape, size = Vision(**PUBLISHED_VISION["clip-vit-large-patch14"]), 2 if autocast else 4
    with torch.device("cuda"):
        tower = tower_of(shape)
        prompts = VisualPrompts(24, 8, 1024, 588)
        frames = torch.zeros(20, 3, 224, 224)
    prompts.attach(tower)
    before = torch.cuda.memory_allocated()
    torch.cuda.reset_peak_memory_stats()
    with torch.autocast("cuda", torch.bfloat16, enabled=autocast):
        loss = tower(frames).sum()
    loss.backward()
    expected = shape.saved(20, 8, size) + shape.passing(20, 8, size)
    assert torch.cuda.max_memory_allocated() - before == pytest.approx(expected, rel=0.15)


def test_all_linear_maps_are_those_that_peft_adapts() -> None:
    model, shape = llama(2)
    adapted = get_peft_model(model, LoraConfig(r=RANK, target_modules="all-linear", task_type="CAUSAL_LM"))
    assert shape.adapters("all-linear", RANK) == sum(p.numel() for p in adapted.parameters() if p.requires_grad) > 0
    for dropout in (True, False):
        assert shape.saved_adapters("all-linear", RANK, 4, dropout) == shape.saved_adapters(LINEAR, RANK, 4, dropout)


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
        (
            f"accelerate launch --config_file {shlex.quote(f'{ROOT}/Makefile')}",
            "Makefile is no configuration of accelerate's",
        ),
    ):
        with pytest.raises(UserError, match=rf"^runtime.launcher: .*{message}"):
            launched(wrong)


def test_the_papers_scales_fit_the_cards_they_name() -> None:
    """7b on one card of 48 GB, or of 24 GB, and 13b on two of 48 GB, with room left for what is not counted."""
    less = ("runtime.gradient_checkpointing=true",)
    for scale, overrides, card in (("paper-7b", (), 48e9), ("paper-7b", less, 24e9), ("paper-13b", (), 48e9)):
        uses, notes = count(compose(scale, overrides))
        assert [use.stage for use in uses] == ["finetune_encoder", "embed", "align", "lora", "answer"]
        assert max(use.total for use in uses) < card - GIB
        assert "published" in " ".join(notes)
        assert table(uses).count("\n") == len(uses)
    two, usual = (count(compose("paper-7b", [f"encoder.micro_batch_size={n}"]))[0][0].total / GIB for n in (2, 8))
    assert two < 5 < usual, "the paper's encoder took less than 5 GB"
    assert f"eight {usual:.1f} GiB in all, and two at a time {two:.1f} GiB" in Path("conf/paper-7b.yaml").read_text()


def test_settings_move_what_they_should() -> None:
    def uses(*overrides: str) -> dict[str, Use]:
        return {use.stage: use for use in count(compose("paper-7b", overrides))[0]}

    usual = uses()
    whole = uses("encoder.micro_batch_size=0")["finetune_encoder"]
    assert whole.activations == pytest.approx(4 * usual["finetune_encoder"].activations)
    assert uses("encoder.autocast=bfloat16")["finetune_encoder"].activations < usual["finetune_encoder"].activations
    assert uses("runtime.gradient_checkpointing=true")["lora"].activations < usual["lora"].activations / 4
    assert uses("language.quantization=nf4")["lora"].parameters < usual["lora"].parameters / 2.5
    assert uses("language.generation_batch_size=32")["answer"].cache == 2 * usual["answer"].cache
    assert uses("lora.rank=64")["lora"].optimizer < usual["lora"].optimizer
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
    projected = uses("encoder.embedding=projected")
    assert usual["finetune_encoder"].optimizer - projected["finetune_encoder"].optimizer == 12 * 256 * 9
    assert usual["align"].optimizer - projected["align"].optimizer == 12 * 256 * 4096


def test_folders_are_read_and_unknown_ones_named(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "clip")
    uses, notes = count(compose("smoke", [f"encoder.weights={clip}", f"language.weights={tmp_path / 'model'}"]))
    assert [use.stage for use in uses] == ["finetune_encoder", "embed"]
    assert any(str(tmp_path / "model") in note and "not counted" in note for note in notes)
