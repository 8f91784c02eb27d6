"""The memory that each stage of a scale takes on a device, counted from shapes before anything runs.

Counted are weights, what training adds to them, the larger values that a backward pass reads again, the widest passing
ones, and the keys and values of an answer in the making. Not counted are Python and its libraries, or a CUDA context
with fragmentation: one or two GiB. The scale `rehearsal` was measured (docs/scale.md), and tests hold this to it.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import yaml

from pipeline.config import Params
from pipeline.core.records import Part
from pipeline.running.errors import UserError
from pipeline.scenes.invented import catalogue_of
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions, counts_by_task
from pipeline.videos.catalogue import Catalogue
from pipeline.weights.check import TOKENIZER, layers, linear, parameters, read_language, read_tokenizer, read_tower

if TYPE_CHECKING:
    from open_clip.transformer import VisionTransformer
    from transformers import PreTrainedModel

GIB = 2**30
BYTES = {"none": 4, "auto": 4, "float32": 4, "bfloat16": 2, "float16": 2}
"""Bytes a value; for `auto` the most, since its format depends on the device."""
NF4 = 0.5 + 1 / 64 + 4 / (64 * 256)
"""Bytes a value: four bits, a byte of scale for 64 of them, and a float32 for 256 such bytes (Dettmers et al. 2023)."""
ADAM = 12
"""Bytes a trained value besides its own: its gradient, and Adam's two means."""
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


class Shapes(NamedTuple):
    """What memory and disk are counted from; models lie on torch's meta device, and are None where not known."""

    catalogue: Catalogue
    tower: VisionTransformer | None
    llm: PreTrainedModel | None
    longest: tuple[int, int]
    """Tokens of the longest conversation, and those of them that are learnt."""
    embedding: int
    """Values of a frame's embedding as the language model gets it; where the encoder's shapes are not known, as many as
    a word's embedding has."""
    notes: list[str]
    """Sentences on what was assumed or left out."""


def read_shapes(params: Params) -> Shapes:
    """Read the base models' shapes, and look for the longest conversation; UserError for an unknown scenes.objects."""
    catalogue, config = catalogue_of(params), params.encoder
    if unknown := [o for o in params.scenes.objects if o not in catalogue.objects]:
        raise UserError(f"scenes.objects: {unknown[0]} is not in {params.data.catalogue}/objects.csv; [] takes all")
    encoder, language = Path(config.weights), Path(params.language.weights)
    tower, llm = read_tower(encoder), read_language(language)
    notes = ["language.dtype is auto: counted as float32."] if params.language.dtype == "auto" else []
    for folder, model in ((encoder, tower), (language, llm)):
        if model is None:
            notes.append(f"{folder}: its shapes are not known; stages that run it are not counted.")
        elif not folder.is_dir():
            notes.append(f"{folder} is not there: counted with the shapes that are published for {folder.name}.")
    embedding = llm.config.hidden_size if llm is not None else 0
    if config.embedding == "logits":
        embedding = sum(len(p.levels) for p in catalogue.properties)
    elif tower is not None:
        embedding = features(params, tower)
    return Shapes(catalogue, tower, llm, longest(params, catalogue, language), embedding, notes)


def features(params: Params, tower: VisionTransformer) -> int:
    """Values of a picture that are read of a tower."""
    recipe, embedding = params.encoder.recipe, params.encoder.embedding
    whole = recipe == "release" or (recipe == "paper" and embedding == "class_token")
    return int(tower.transformer.width if whole else tower.output_dim)


def count(params: Params, shapes: Shapes) -> Iterator[Use]:
    """The memory of each stage that runs a base model of known shapes; `finetune_encoder` with prompts alone.

    None where nothing is trained.
    """
    if not params.ablation.train:
        return
    config, tower = params.encoder, shapes.tower
    if tower is not None:
        blocks: Any = layers(tower)
        width, wide, depth = tower.transformer.width, blocks[0].mlp.c_fc.out_features, len(blocks)
        tokens, weights = len(tower.positional_embedding) + config.prompts, 4 * parameters(tower)
        if config.recipe in ("paper", "release"):
            classes = sum(len(p.levels) for p in shapes.catalogue.properties)
            hidden = features(params, tower) if config.recipe == "paper" else 512
            trained = min(depth, config.prompt_layers or depth) * config.prompts * width
            trained += (width + 1) * (width if config.recipe == "paper" else 512) + (hidden + 1) * classes
            shown = params.frames.per_video * min(config.micro_batch_size or config.batch_size, config.batch_size)
            size = BYTES[config.autocast]
            # A layer keeps what its norms read, in float32, attention's four, and both factors of the activation.
            layer = 2 * width * 4 + (4 * width + 2 * wide) * size
            # Autocast makes copies of the frozen weights, and the derivatives keep them.
            copies = size * parameters(blocks) if size < 4 else 0
            activations = shown * tokens * (depth * layer + 4 * wide * size) + copies
            yield Use("finetune_encoder", 1, weights + 4 * trained, ADAM * trained, activations)
        yield Use("embed", 1, weights, 0, 4 * config.embed_batch_size * tokens * wide * 4)
    if shapes.llm is not None:
        yield from language_uses(params, shapes.llm, shapes)


def language_uses(params: Params, llm: PreTrainedModel, shapes: Shapes) -> Iterator[Use]:
    """Alignment, LoRA and answering."""
    language, (longest, learnt) = params.language, shapes.longest
    hidden, vocabulary, maps, blocks = llm.config.hidden_size, llm.config.vocab_size, linear(llm), len(layers(llm))
    size, middle, (_, keys) = BYTES[language.dtype], maps["down_proj"][0], maps["k_proj"]
    held = NF4 if language.quantization == "nf4" else size
    # Linear maps alone are held in four bits.
    mapped, outside = sum(a * b for a, b in maps.values()), parameters(llm) - parameters(layers(llm))
    frozen = blocks * mapped * held + (parameters(llm) - blocks * mapped) * size
    connector, words, adapters = trained_parameters(params, llm, shapes.embedding)
    devices, sharded = launched(params.runtime.launcher)
    shards = devices if sharded else 1
    # A sharded training holds two layers whole: the one that computes and the one that is fetched.
    gathered = 2 * mapped * held + outside * size + 4 * (connector + words) if shards > 1 else 0.0
    every = connector + words + adapters
    for stage, config, trained in (("align", params.align, connector + words), ("lora", params.lora, every)):
        tokens, logits = config.micro_batch_size * longest, config.micro_batch_size * learnt * vocabulary * 4
        # A layer keeps what its norms read, in float32, attention's four, and three of its middle; for each adapter
        # what it reads in float32, and in a byte whether that was dropped.
        layer = 2 * hidden * 4 + (2 * (maps["q_proj"][1] + keys) + 3 * middle) * size
        if stage == "lora":
            layer += sum(5 * maps[name][0] for name in adapted(params, llm))
        # With checkpointing, of each layer what it reads is kept; one at a time is computed again.
        stay = blocks * hidden * size + layer if params.runtime.gradient_checkpointing else blocks * layer
        # What comes and goes at the widest place: the logits and their gradient, or three of a layer's middle.
        activations = tokens * stay + logits + max(2 * logits, 3 * tokens * middle * size)
        yield Use(
            stage,
            devices,
            parameters=(frozen + 4 * trained) / shards + gathered,
            # Gradients are shared among devices at the end of an update; until then each adds up its own.
            optimizer=4 * trained + (ADAM - 4) * trained / shards,
            # The newest gradient of all words, when what the layers kept is gone.
            activations=max(activations, 4 * words),
        )
    rows = language.generation_batch_size
    # The prompts are read at once: the widest maps' outcomes, and a mask for each pair of tokens.
    passing = rows * longest * (3 * middle + 2 * hidden + longest) * size
    cache = 2 * rows * (longest + language.max_new_tokens) * blocks * keys * size
    yield Use("answer", 1, frozen + 4 * every, 0, passing, cache)


def trained_parameters(params: Params, llm: PreTrainedModel, embedding: int) -> tuple[int, int, int]:
    """Trained parameters of: the connector with the two tactile tokens, word embeddings if trained, and adapters.

    Words are a copy beside the frozen ones, which a tied head still needs.
    """
    hidden, maps = llm.config.hidden_size, linear(llm)
    connector = (embedding + 1) * hidden + (hidden + 1) * hidden + 2 * hidden
    words = llm.config.vocab_size * hidden if params.align.train_embeddings == "all" else 0
    return connector, words, len(layers(llm)) * params.lora.rank * sum(sum(maps[n]) for n in adapted(params, llm))


def adapted(params: Params, llm: PreTrainedModel) -> list[str]:
    """The linear maps of a layer that get an adapter."""
    targets = params.lora.target_modules
    return [name for name in linear(llm) if targets == "all-linear" or name in targets]


def launched(launcher: str) -> tuple[int, bool]:
    """Devices that a launcher starts a training on, and whether they share the layers among them."""
    parser = argparse.ArgumentParser(exit_on_error=False, add_help=False, allow_abbrev=False)
    parser.add_argument("--config_file", "--config-file", type=Path)
    parser.add_argument("--num_processes", "--num-processes", type=int)
    try:
        given, _ = parser.parse_known_args(shlex.split(launcher))
        settings = yaml.safe_load(given.config_file.read_text(encoding="utf-8")) if given.config_file else {}
        return given.num_processes or int(settings.get("num_processes", 1)), settings.get("distributed_type") == "FSDP"
    except (argparse.ArgumentError, OSError, yaml.YAMLError, AttributeError, TypeError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise UserError(f"runtime.launcher: {launcher}: {reason}; name a configuration of accelerate's") from None


def longest(params: Params, catalogue: Catalogue, language: Path) -> tuple[int, int]:
    """Look for the longest conversation among questions on all objects: its tokens, and those of them that are learnt.

    Tokens are the folder's language model's, where its tokenizer is there.
    """
    tokenizer = read_tokenizer(language) if (language / TOKENIZER).is_file() else None

    def tokens(text: str) -> int:
        return len(tokenizer.encode(text).ids) if tokenizer else -(-len(text) // LETTERS)

    config, found = params.questions, [(0, 0)]
    questions = build_questions(
        Pool(Part.TRAIN, catalogue, {o: [f"{o}_0"] for o in catalogue.objects}),
        {t: min(n, ASKED) for part in ("train", "evaluation") for t, n in counts_by_task(config, part).items() if n},
        distinct=False,
        **config.model_dump(include={"seed", "facts", "restate", "two_turns"}),
    )
    for question, turns in ((q, d.turns) for q in questions for d in q.dialogues if d.opd in params.ablation.opd):
        shown = [f"USER: {turn.user} ASSISTANT: {turn.assistant}" for turn in turns]
        text = " ".join([params.language.system_prompt, *shown]).replace("{tactile}", "")
        # A video is its frames and two delimiters.
        length = tokens(text) + len(question.videos) * (params.frames.per_video + 2)
        found.append((length, sum(tokens(turn.assistant) + 1 for turn in turns)))
    return max(found)


def table(uses: Sequence[Use]) -> str:
    """The stages as lines of text, in GiB on each device."""
    line = "{:<16}  {:>7}  {:>10}  {:>9}  {:>11}  {:>5}  {:>5}".format
    rows = [(u.stage, u.devices, *(f"{size / GIB:.2f}" for size in (*u[2:], u.total))) for u in uses]
    return "\n".join(line(*row) for row in (("stage", "devices", *Use._fields[2:], "total"), *rows))
