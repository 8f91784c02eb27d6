"""The memory that each stage of a scale takes on a device, counted from shapes before anything runs.

Counted are weights, what training adds to them, the values that a backward pass reads again, the widest passing values,
and the keys and values of an answer in the making. Not counted are the CUDA context, fragments, and the kernels' own
rooms: a GiB or two on a card.
"""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import yaml

from pipeline.config import EncoderConfig, LoraTrainConfig, Params, TrainConfig
from pipeline.core.errors import UserError
from pipeline.core.records import Dialogue, Part, Question, Turn
from pipeline.scenes.invented import catalogue_of
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions, counts_by_task
from pipeline.videos.catalogue import Catalogue
from pipeline.weights.check import TOKENIZER, read_tokenizer
from pipeline.weights.shapes import FULL, Llama, Vision

GIB = 2**30
BYTES = {"auto": 4, "float32": 4, "bfloat16": 2, "float16": 2}
"""Bytes a value; for `auto` the most, since its format depends on the device."""
NF4 = 0.5 + 1 / 64 + 4 / (64 * 256)
"""Bytes a value: four bits, a byte of scale for 64 of them, and a float32 for 256 such bytes (Dettmers et al. 2023)."""
ADAM = 3 * FULL
"""Bytes a trained value besides its own: its gradient, and Adam's two means."""
GATHERED = 2
"""Layers whose weights a sharded training holds whole: the one that computes and the one that is fetched."""
ASKED = 30
"""Questions of each task that the longest is looked for among."""
LETTERS = 4
"""Letters a token of English text, where the tokenizer is not there to ask."""


@dataclass(frozen=True)
class Use:
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
        """Of all."""
        return self.parameters + self.optimizer + self.activations + self.cache


@dataclass(frozen=True)
class Lengths:
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


def count(params: Params) -> tuple[list[Use], list[str]]:
    """Count all stages that run a base model; the sentences say what was assumed or left out."""
    catalogue = catalogue_of(params)
    uses: list[Use] = []
    notes: list[str] = ["language.dtype is auto: counted as float32."] if params.language.dtype == "auto" else []
    tower, encoder = Vision.read(Path(params.encoder.weights)), Path(params.encoder.weights)
    if tower is None:
        notes.append(f"{encoder}: no open_clip model whose shapes are known; the encoder's stages are not counted.")
    else:
        if not encoder.is_dir():
            notes.append(f"{encoder} is not there: counted with the shapes that are published for {encoder.name}.")
        uses += encoder_uses(params, tower, sum(len(p.levels) for p in catalogue.properties))
    language = Path(params.language.weights)
    llama = Llama.read(language)
    if llama is None:
        notes.append(f"{language}: no Llama whose shapes are known; the language model's stages are not counted.")
        return uses, notes
    if not language.is_dir():
        notes.append(f"{language} is not there: counted with the shapes that are published for {language.name}.")
    lengths = longest(params, catalogue, language)
    if not (language / TOKENIZER).is_file():
        notes.append(f"Without its tokenizer, a token is taken for {LETTERS} letters.")
    notes.append(
        f"Longest conversation {lengths.training} tokens, {lengths.answer} of them learnt; longest question "
        f"{lengths.prompt}, answered in at most {params.language.max_new_tokens}."
    )
    embedding = embedding_length(params.encoder, tower) if tower else llama.hidden_size
    return [*uses, *language_uses(params, llama, embedding, lengths)], notes


def embedding_length(config: EncoderConfig, tower: Vision) -> int:
    """Values of a frame's embedding as the language model gets it."""
    whole = config.recipe == "release" or (config.recipe == "paper" and config.embedding == "class_token")
    return tower.width if whole else tower.embed_dim


def encoder_uses(params: Params, tower: Vision, classes: int) -> Iterator[Use]:
    """Fine-tuning by gradients (recipes `paper` and `release`), and embedding; `classes` counts all properties'."""
    config, frames = params.encoder, params.frames.per_video
    if config.recipe in ("paper", "release"):
        layers = min(tower.layers, config.prompt_layers or tower.layers)
        trained = layers * config.prompts * tower.width
        if config.recipe == "paper":
            trained += (tower.width + 1) * tower.width + (embedding_length(config, tower) + 1) * classes
        else:
            trained += (tower.width + 1) * 512 + 513 * classes
        pictures = frames * min(config.micro_batch_size or config.batch_size, config.batch_size)
        size = BYTES["bfloat16" if config.autocast == "bfloat16" else "float32"]
        yield Use(
            "finetune_encoder",
            1,
            parameters=FULL * (tower.parameters + trained),
            optimizer=ADAM * trained,
            activations=tower.saved(pictures, config.prompts, size) + tower.passing(pictures, config.prompts, size),
        )
    passing = tower.passing(config.embed_batch_size, config.prompts, FULL)
    yield Use("embed", 1, parameters=FULL * tower.parameters, optimizer=0, activations=passing)


def language_uses(params: Params, llama: Llama, embedding: int, lengths: Lengths) -> Iterator[Use]:
    """Alignment, LoRA and answering; `embedding` is the length of a tactile one."""
    language, hidden = params.language, llama.hidden_size
    size = BYTES[language.dtype]
    linear = llama.num_hidden_layers * llama.layer_linear
    held = NF4 if language.quantization == "nf4" else size
    frozen = linear * held + (llama.parameters - linear) * size
    connector = (embedding + 1) * hidden + (hidden + 1) * hidden + 2 * hidden
    adapters = llama.adapters(params.lora.target_modules, params.lora.rank)
    # A copy beside the frozen ones, which a tied head still needs.
    words = llama.vocab_size * hidden if params.align.train_embeddings == "all" else 0
    devices, sharded = launched(params.runtime.launcher)
    trainings: tuple[tuple[str, TrainConfig, int], ...] = (
        ("align", params.align, connector + words),
        ("lora", params.lora, connector + words + adapters),
    )
    for stage, config, trained in trainings:
        whole, layer = frozen + FULL * trained, llama.layer_linear * held
        shards = devices if sharded else 1
        gathered = GATHERED * layer + llama.words * size + FULL * (connector + words) if shards > 1 else 0.0
        rows = config.micro_batch_size
        # What comes and goes at the widest place: the logits and their gradient, or three of a layer's middle.
        middle = 3 * rows * lengths.training * llama.intermediate_size * size
        passing = max(2 * llama.saved_loss(rows * lengths.answer), middle)
        yield Use(
            stage,
            devices,
            parameters=whole / shards + gathered,
            # Gradients are shared among devices at the end of an update; until then each adds up its own.
            optimizer=FULL * trained + (ADAM - FULL) * trained / shards,
            # The newest gradient of all words, when what the layers kept is gone.
            activations=max(language_saved(params, llama, config, lengths) + passing, FULL * words),
        )
    rows = language.generation_batch_size
    read = rows * lengths.prompt
    yield Use(
        "answer",
        1,
        parameters=frozen + FULL * (connector + words + adapters),
        optimizer=0,
        # The prompts are read at once: the widest maps' outcomes, and a mask for each pair of tokens.
        activations=read * (3 * llama.intermediate_size + 2 * hidden + lengths.prompt) * size,
        cache=llama.cache(rows * (lengths.prompt + language.max_new_tokens), size),
    )


def language_saved(params: Params, llama: Llama, config: TrainConfig, lengths: Lengths) -> int:
    """Bytes that a training's forward keeps: a batch of the longest conversations."""
    size, tokens = BYTES[params.language.dtype], config.micro_batch_size * lengths.training
    layer = llama.saved_layer(size)
    if isinstance(config, LoraTrainConfig):
        layer += llama.saved_adapters(config.target_modules, config.rank, size, config.dropout > 0)
    if params.runtime.gradient_checkpointing:
        # Of each layer what it reads is kept; one at a time is computed again.
        kept = llama.num_hidden_layers * tokens * llama.hidden_size * size + tokens * layer
    else:
        kept = llama.num_hidden_layers * tokens * layer
    loss = llama.saved_loss(config.micro_batch_size * lengths.answer)
    return kept + tokens * (llama.hidden_size + 1) * FULL + loss


def launched(launcher: str) -> tuple[int, bool]:
    """Devices that a launcher starts a training on, and whether they share the layers among them."""
    parser = argparse.ArgumentParser(exit_on_error=False, add_help=False, allow_abbrev=False)
    parser.add_argument("--config_file", "--config-file", type=Path)
    parser.add_argument("--num_processes", "--num-processes", type=int)
    try:
        given, _ = parser.parse_known_args(shlex.split(launcher))
    except (argparse.ArgumentError, ValueError) as error:
        raise UserError(f"runtime.launcher: {error}") from None
    if given.config_file is None:
        return given.num_processes or 1, False
    try:
        settings = yaml.safe_load(given.config_file.read_text(encoding="utf-8"))
        return given.num_processes or int(settings.get("num_processes", 1)), settings.get("distributed_type") == "FSDP"
    except (OSError, yaml.YAMLError, AttributeError, TypeError, ValueError):
        raise UserError(
            f"runtime.launcher: {given.config_file} is no configuration of accelerate's; name one that is"
        ) from None


def longest(params: Params, catalogue: Catalogue, language: Path) -> Lengths:
    """Look for the longest conversations among questions on all objects, in tokens of the folder's language model."""
    known = read_tokenizer(language) if (language / TOKENIZER).is_file() else None

    def tokens(text: str) -> int:
        return len(known.encode(text).ids) if known else -(-len(text) // LETTERS)

    def length(question: Question, turns: Sequence[Turn]) -> int:
        text = " ".join([params.language.system_prompt, *(f"USER: {t.user} ASSISTANT: {t.assistant}" for t in turns)])
        # A video is its frames and two delimiters.
        return tokens(text.replace("{tactile}", "")) + len(question.videos) * (params.frames.per_video + 2)

    training = [
        (length(q, d.turns), sum(tokens(t.assistant) + 1 for t in d.turns))
        for q, d in _dialogues(params, catalogue, Part.TRAIN)
    ]
    prompts = [
        length(q, [*d.turns[:-1], Turn(user=d.turns[-1].user, assistant="")])
        for q, d in _dialogues(params, catalogue, Part.TEST)
    ]
    most, learnt = max(training, default=(0, 0))
    columns = ([t for t, _ in training], [a for _, a in training], prompts)
    means = (sum(numbers) / max(1, len(numbers)) for numbers in columns)
    return Lengths(most, learnt, max(prompts, default=0), *means)


def _dialogues(params: Params, catalogue: Catalogue, part: Part) -> Iterator[tuple[Question, Dialogue]]:
    """Questions to train or evaluate with on all objects, under each OPD mode that is trained."""
    config, trained = params.questions, part == Part.TRAIN
    wanted = counts_by_task(config, "train" if trained else "evaluation")
    questions = build_questions(
        Pool(part, catalogue, {o: [f"{o}_0"] for o in catalogue.objects}),
        {task: min(number, ASKED) for task, number in wanted.items()},
        seed=config.seed,
        distinct=False,
        facts=config.facts,
        restate=config.restate,
        two_turns=config.two_turns if trained else 0.0,
    )
    return ((q, d) for q in questions for d in q.dialogues if d.opd in params.ablation.opd)


def table(uses: Sequence[Use]) -> str:
    """The stages as lines of text, in GiB on each device."""
    names = [f.name for f in fields(Use)]
    rows = [[*names, "total"]]
    for use in uses:
        stage, devices, *sizes = astuple(use)
        rows.append([stage, str(devices), *(f"{s / GIB:.2f}" for s in (*sizes, use.total))])
    first, *widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ([row[0].ljust(first), *map(str.rjust, row[1:], widths)] for row in rows)
    return "\n".join("  ".join(cells) for cells in lines)
