"""The memory that each stage of a scale takes on a device, counted from shapes before anything runs.

Counted are weights, what training adds to them, the values that a backward pass reads again, the widest passing values,
and the keys and values of an answer in the making. Not counted are the CUDA context, fragmentation and kernels'
workspaces: one or two GiB on a card. Tests compare the counted activations with what autograd keeps.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from pipeline.config import EncoderConfig, LoraTrainConfig, Params, TrainConfig
from pipeline.core.errors import UserError
from pipeline.core.records import Part
from pipeline.scenes.invented import catalogue_of
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions, counts_by_task
from pipeline.videos.catalogue import Catalogue
from pipeline.weights.check import TOKENIZER, layers, linear, parameters, read_language, read_tokenizer, read_tower

if TYPE_CHECKING:
    from open_clip.transformer import VisionTransformer
    from transformers import PreTrainedModel

GIB = 2**30
FLOAT32_BYTES = 4
"""Bytes of a float32 value."""
BYTES = {"auto": 4, "float32": 4, "bfloat16": 2, "float16": 2}
"""Bytes a value; for `auto` the most, since its format depends on the device."""
NF4 = 0.5 + 1 / 64 + 4 / (64 * 256)
"""Bytes a value: four bits, a byte of scale for 64 of them, and a float32 for 256 such bytes (Dettmers et al. 2023)."""
ADAM = 3 * FLOAT32_BYTES
"""Bytes a trained value besides its own: its gradient, and Adam's two means."""
GATHERED = 2
"""Layers whose weights a sharded training holds whole: the one that computes and the one that is fetched."""
READ_TOGETHER = ({"q_proj", "k_proj", "v_proj"}, {"gate_proj", "up_proj"}, {"down_proj"})
"""Linear maps that read the same tensor, kept only for an adapter. What `o_proj` reads, attention keeps anyway."""
ASKED = 30
"""Questions of each task among which the longest conversation is looked for."""
LETTERS = 4
"""Letters a token of English text, where the tokenizer is not there to ask."""


class Use(NamedTuple):
    """Memory of a stage in bytes, on each of its devices."""

    stage: str
    devices: int
    parameters: float
    optimizer: float
    """Gradients and Adam's means of what is trained."""
    activations: float
    cache: float = 0.0
    """Keys and values of answers."""

    @property
    def total(self) -> float:
        """The sum of the four."""
        return sum(self[2:])


class Lengths(NamedTuple):
    """Tokens of the longest conversations, and the mean over all."""

    training: int
    """Question and answer, under any OPD mode that is trained."""
    answer: int
    """Of `training`, the tokens that are learnt."""
    prompt: int
    """The longest evaluation question, with the answers of earlier turns."""
    mean_training: float = 0.0
    mean_answer: float = 0.0
    mean_prompt: float = 0.0


class Shapes(NamedTuple):
    """What memory, time and disk are counted from; models lie on torch's meta device, without values."""

    catalogue: Catalogue
    tower: VisionTransformer | None
    llm: PreTrainedModel | None
    lengths: Lengths
    """All 0 where the language model's shapes are not known."""
    embedding: int
    """Values of a frame's embedding as the language model gets it; where the encoder's shapes are not known, as many as
    a word's embedding has."""
    notes: list[str]
    """Sentences on what was assumed or left out."""


def read_shapes(params: Params) -> Shapes:
    """Read the base models' shapes, and look for the longest conversations."""
    catalogue = catalogue_of(params)
    encoder, language = Path(params.encoder.weights), Path(params.language.weights)
    tower, llm = read_tower(encoder), read_language(language)
    notes = ["language.dtype is auto: counted as float32."] if params.language.dtype == "auto" else []
    for folder, model, kind, stages in (
        (encoder, tower, "open_clip model", "encoder's"),
        (language, llm, "Llama", "language model's"),
    ):
        if model is None:
            notes.append(f"{folder}: no {kind} whose shapes are known; the {stages} stages are not counted.")
        elif not folder.is_dir():
            notes.append(f"{folder} is not there: counted with the shapes that are published for {folder.name}.")
    lengths, embedding = Lengths(0, 0, 0), 0
    if llm is not None:
        lengths, embedding = longest(params, catalogue, language), llm.config.hidden_size
        if not (language / TOKENIZER).is_file():
            notes.append(f"Without its tokenizer, a token is taken for {LETTERS} letters.")
        notes.append(
            f"Longest conversation {lengths.training} tokens, {lengths.answer} of them learnt; longest question "
            f"{lengths.prompt}, answered in at most {params.language.max_new_tokens}."
        )
    if params.encoder.embedding == "logits":
        embedding = sum(len(p.levels) for p in catalogue.properties)
    elif tower is not None:
        embedding = features(params.encoder, tower)
    return Shapes(catalogue, tower, llm, lengths, embedding, notes)


def count(params: Params, shapes: Shapes) -> list[Use]:
    """The memory of each stage that runs a base model of known shapes; `finetune_encoder` with prompts alone."""
    uses, config, tower = list[Use](), params.encoder, shapes.tower
    if tower is not None:
        width, depth = tower.transformer.width, len(layers(tower))
        classes = sum(len(p.levels) for p in shapes.catalogue.properties)
        if config.recipe in ("paper", "release"):
            trained = min(depth, config.prompt_layers or depth) * config.prompts * width
            if config.recipe == "paper":
                trained += (width + 1) * width + (features(config, tower) + 1) * classes
            else:
                trained += (width + 1) * 512 + 513 * classes
            pictures = params.frames.per_video * min(config.micro_batch_size or config.batch_size, config.batch_size)
            size = BYTES["float32" if config.autocast == "none" else config.autocast]
            activations = sum(tower_kept(tower, pictures, config.prompts, size))
            held = FLOAT32_BYTES * (parameters(tower) + trained)
            uses.append(Use("finetune_encoder", 1, held, ADAM * trained, activations))
        _, passing = tower_kept(tower, config.embed_batch_size, config.prompts, FLOAT32_BYTES)
        uses.append(Use("embed", 1, FLOAT32_BYTES * parameters(tower), 0, passing))
    if shapes.llm is not None:
        uses += language_uses(params, shapes.llm, shapes.embedding, shapes.lengths)
    return uses


def features(config: EncoderConfig, tower: VisionTransformer) -> int:
    """Values of a picture that are read of a tower."""
    whole = config.recipe == "release" or (config.recipe == "paper" and config.embedding == "class_token")
    return int(tower.transformer.width if whole else tower.output_dim)


def layer_kept(width: int, heads: int, keys: int, queries: int, wide: int, statistics: int, size: int) -> int:
    """Bytes a token that autograd keeps of a frozen transformer layer; `size` is that of a computed value.

    Two norms keep what they read and their statistics, in float32; attention its queries and its outcome, its keys and
    values, and a sum a head; the wide part its factors.
    """
    return 2 * (width + statistics) * FLOAT32_BYTES + 2 * (queries + keys) * size + heads * FLOAT32_BYTES + wide * size


def tower_kept(tower: VisionTransformer, frames: int, prompts: int, size: int) -> tuple[int, int]:
    """Bytes that a forward pass in training keeps of a frozen tower, and its peak of temporary ones.

    Args:
        frames: Pictures at a time.
        prompts: Tokens beside a picture's own at each layer.
        size: Bytes of the value that linear layers compute in; below 4 it is autocast.
    """
    from open_clip.transformer import QuickGELU

    blocks, width = layers(tower), tower.transformer.width
    first: Any = blocks[0]
    wide, tokens = int(first.mlp.c_fc.out_features), frames * (len(tower.positional_embedding) + prompts)
    # x sigmoid(1.702 x) is a product: both factors are kept.
    factors = 2 if isinstance(first.mlp.gelu, QuickGELU) else 1
    layer = layer_kept(width, first.attn.num_heads, width, width, factors * wide, 2, size)
    # Autocast makes copies of the frozen weights, and the derivatives keep them.
    copies = size * sum(p.numel() for p in blocks.parameters() if p.ndim > 1) if size < FLOAT32_BYTES else 0
    return tokens * (len(blocks) * layer + (width + 2) * FLOAT32_BYTES) + copies, 4 * tokens * wide * size


def language_uses(params: Params, llm: PreTrainedModel, embedding: int, lengths: Lengths) -> Iterator[Use]:
    """Alignment, LoRA and answering; `embedding` is the length of a tactile one."""
    language = params.language
    hidden, maps, blocks = llm.config.hidden_size, linear(llm), len(layers(llm))
    size, middle = BYTES[language.dtype], maps["down_proj"][0]
    held = NF4 if language.quantization == "nf4" else size
    # Linear maps alone are held in four bits.
    layer = sum(a * b for a, b in maps.values())
    frozen = blocks * layer * held + (parameters(llm) - blocks * layer) * size
    connector, words, adapters = trained_parameters(params, llm, embedding)
    devices, sharded = launched(params.runtime.launcher)
    shards = devices if sharded else 1
    outside = parameters(llm) - parameters(layers(llm))
    gathered = GATHERED * layer * held + outside * size + FLOAT32_BYTES * (connector + words) if shards > 1 else 0.0
    all_trained = connector + words + adapters
    for stage, config, trained in (("align", params.align, connector + words), ("lora", params.lora, all_trained)):
        # What comes and goes at the widest place: the logits and their gradient, or three of a layer's middle.
        tokens, logits = config.micro_batch_size * lengths.training, config.micro_batch_size * lengths.answer
        passing = max(2 * logits * llm.config.vocab_size * FLOAT32_BYTES, 3 * tokens * middle * size)
        yield Use(
            stage,
            devices,
            parameters=(frozen + FLOAT32_BYTES * trained) / shards + gathered,
            # Gradients are shared among devices at the end of an update; until then each adds up its own.
            optimizer=FLOAT32_BYTES * trained + (ADAM - FLOAT32_BYTES) * trained / shards,
            # The newest gradient of all words, when what the layers kept is gone.
            activations=max(language_kept(params, llm, config, lengths) + passing, FLOAT32_BYTES * words),
        )
    rows = language.generation_batch_size
    yield Use(
        "answer",
        1,
        parameters=frozen + FLOAT32_BYTES * all_trained,
        optimizer=0,
        # The prompts are read at once: the widest maps' outcomes, and a mask for each pair of tokens.
        activations=rows * lengths.prompt * (3 * middle + 2 * hidden + lengths.prompt) * size,
        cache=2 * rows * (lengths.prompt + language.max_new_tokens) * blocks * maps["k_proj"][1] * size,
    )


def trained_parameters(params: Params, llm: PreTrainedModel, embedding: int) -> tuple[int, int, int]:
    """Trained parameters of: the connector with the two tactile tokens, word embeddings if trained, and adapters.

    Words are a copy beside the frozen ones, which a tied head still needs.
    """
    hidden = llm.config.hidden_size
    connector = (embedding + 1) * hidden + (hidden + 1) * hidden + 2 * hidden
    words = llm.config.vocab_size * hidden if params.align.train_embeddings == "all" else 0
    return connector, words, len(layers(llm)) * params.lora.rank * sum(map(sum, adapted(llm, params.lora).values()))


def adapted(llm: PreTrainedModel, config: LoraTrainConfig) -> dict[str, tuple[int, int]]:
    """Lengths of what goes in and comes out of the linear maps of a layer that get an adapter."""
    targets = config.target_modules
    return {name: ends for name, ends in linear(llm).items() if targets == "all-linear" or name in targets}


def language_kept(params: Params, llm: PreTrainedModel, config: TrainConfig, lengths: Lengths) -> int:
    """Bytes that a training's forward keeps: a batch of the longest conversations."""
    size, tokens = BYTES[params.language.dtype], config.micro_batch_size * lengths.training
    hidden, maps, blocks = llm.config.hidden_size, linear(llm), len(layers(llm))
    queries, keys, middle = maps["q_proj"][1], maps["k_proj"][1], maps["down_proj"][0]
    layer = layer_kept(hidden, llm.config.num_attention_heads, keys, queries, 3 * middle, 1, size)
    if isinstance(config, LoraTrainConfig):
        own = adapted(llm, config)
        # Each map casts or drops what it reads for itself; a GPU remembers in a byte whether a value was dropped.
        read = sum(ends[0] for ends in own.values()) * (FLOAT32_BYTES + (config.dropout > 0))
        if size == FLOAT32_BYTES and not config.dropout:
            read = FLOAT32_BYTES * sum(maps[min(each)][0] for each in READ_TOGETHER if each & own.keys())
        layer += len(own) * config.rank * FLOAT32_BYTES + read
    # With checkpointing, of each layer what it reads is kept; one at a time is computed again.
    each = blocks * hidden * size + layer if params.runtime.gradient_checkpointing else blocks * layer
    # The last norm, and logarithms of all words' probabilities.
    loss = config.micro_batch_size * lengths.answer * llm.config.vocab_size * FLOAT32_BYTES
    return int(tokens * (each + (hidden + 1) * FLOAT32_BYTES) + loss)


def launched(launcher: str) -> tuple[int, bool]:
    """Devices that a launcher starts a training on, and whether they share the layers among them."""
    parser = argparse.ArgumentParser(exit_on_error=False, add_help=False, allow_abbrev=False)
    parser.add_argument("--config_file", "--config-file", type=Path)
    parser.add_argument("--num_processes", "--num-processes", type=int)
    try:
        given, _ = parser.parse_known_args(shlex.split(launcher))
    except (argparse.ArgumentError, ValueError) as error:
        raise UserError(f"runtime.launcher: {error}") from None
    try:
        settings = yaml.safe_load(given.config_file.read_text(encoding="utf-8")) if given.config_file else {}
        return given.num_processes or int(settings.get("num_processes", 1)), settings.get("distributed_type") == "FSDP"
    except (OSError, yaml.YAMLError, AttributeError, TypeError, ValueError):
        raise UserError(
            f"runtime.launcher: {given.config_file} is no configuration of accelerate's; name one that is"
        ) from None


def longest(params: Params, catalogue: Catalogue, language: Path) -> Lengths:
    """Look for the longest conversations among questions on all objects, in tokens of the folder's language model."""
    tokenizer = read_tokenizer(language) if (language / TOKENIZER).is_file() else None
    config, rows = params.questions, {Part.TRAIN: list[tuple[int, int]](), Part.TEST: list[tuple[int, int]]()}

    def tokens(text: str) -> int:
        return len(tokenizer.encode(text).ids) if tokenizer else -(-len(text) // LETTERS)

    for part, found in rows.items():
        wanted = counts_by_task(config, "train" if part == Part.TRAIN else "evaluation")
        questions = build_questions(
            Pool(part, catalogue, {o: [f"{o}_0"] for o in catalogue.objects}),
            {task: min(number, ASKED) for task, number in wanted.items()},
            seed=config.seed,
            distinct=False,
            facts=config.facts,
            restate=config.restate,
            two_turns=config.two_turns if part == Part.TRAIN else 0.0,
        )
        for question, turns in ((q, d.turns) for q in questions for d in q.dialogues if d.opd in params.ablation.opd):
            said = [t.assistant for t in turns]
            if part == Part.TEST:
                said[-1] = ""  # What is asked for.
            shown = [f"USER: {t.user} ASSISTANT: {answer}" for t, answer in zip(turns, said, strict=True)]
            text = " ".join([params.language.system_prompt, *shown]).replace("{tactile}", "")
            # A video is its frames and two delimiters.
            length = tokens(text) + len(question.videos) * (params.frames.per_video + 2)
            found.append((length, sum(tokens(answer) + 1 for answer in said)))
    training, prompts = rows[Part.TRAIN], [length for length, _ in rows[Part.TEST]]
    columns = ([length for length, _ in training], [learnt for _, learnt in training], prompts)
    means = (sum(numbers) / max(1, len(numbers)) for numbers in columns)
    return Lengths(*max(training, default=(0, 0)), max(prompts, default=0), *means)


def table(uses: Sequence[Use]) -> str:
    """The stages as lines of text, in GiB on each device."""
    line = "{:<16}  {:>7}  {:>10}  {:>9}  {:>11}  {:>5}  {:>5}".format
    rows = [(u.stage, u.devices, *(f"{size / GIB:.2f}" for size in (*u[2:], u.total))) for u in uses]
    return "\n".join(line(*row) for row in (("stage", "devices", *Use._fields[2:], "total"), *rows))
