"""The checkpoints that Octopi's authors published, as a folder of models/.

Their layout (github.com/clear-nus/octopi, whose README links the files): `encoder.pt`, CLIP's vision tower with
prompts; `classifier.pt`, the property heads, which not every download has; `project.pt`; `tokenizer/`; and
`llm_weights/`, an adapter of peft 0.2 with the matrix of all word embeddings. Weights are pickles, of which tensors
alone are read.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.config import LANGUAGE_DIR, EncoderConfig, FramesConfig, LanguageConfig
from pipeline.core.io import atomic_folder, fingerprint, load_tensors, save_tensors, write_json
from pipeline.core.records import Encoder, Opd, Part
from pipeline.language.base import ADAPTER_CONFIG, ADAPTER_WEIGHTS, load_tokenizer
from pipeline.language.chat import TACT_END, TACT_START
from pipeline.language.octopi import ADAPTER_DIR, CONFIG_FILE, CONNECTOR_FILE, WORDS_FILE, OctopiConfig
from pipeline.running.errors import UserError
from pipeline.training.card import write_card
from pipeline.training.embeddings import STATISTICS_FILE, Statistics
from pipeline.use.folder import (
    BACKBONE_DIR,
    CATALOGUE,
    CONFIG,
    ENCODER_DIR,
    TRAINED,
    Base,
    ModelConfig,
    chat_sample,
    provenance,
)
from pipeline.videos.catalogue import load_catalogue
from pipeline.weights import DOWNLOADED
from pipeline.weights.backbones import CLIP_CONFIG, CLIP_WEIGHTS, clip_file
from pipeline.weights.check import LLM_CONFIG, TOKENIZER, read_form, stored_shapes
from pipeline.weights.clip_layout import open_clip_form, to_open_clip
from pipeline.weights.published import adopt, check_vicuna, new_folder, read_pickle, read_weights

if TYPE_CHECKING:
    import torch

CHECKPOINTS = {"octopi-7b": "vicuna-7b", "octopi-13b": "vicuna-13b"}
"""By the name that `octopi weights` takes, the language model that they stand on."""
SYSTEM = (
    "A chat between a curious user and an artificial intelligence assistant. The assistant gives helpful, detailed, "
    "and polite answers to the user's questions."
)
PROPERTIES = ("hardness", "roughness", "texture")
"""The published names of the heads, in the catalogue's order of properties."""
ADAPTER = "base_model.model.model.embed_tokens.weight"
LIMITS = (
    "Its authors state no licence for these weights.",
    "How strong noise alone is in its training videos is not known, so it also answers where nothing touches.",
    "Its heads' probabilities are not calibrated.",
)


def convert(
    name: str, source: Path, base: Path, clip: Path, to: Path | None = None, *, trust_pickle: bool = False
) -> tuple[Path, list[str]]:
    """Write a published checkpoint as a folder that `octopi ask --model` and `Octopi.from_pretrained` read.

    Args:
        name: In `CHECKPOINTS`.
        base: Vicuna's folder, as downloaded or as `octopi weights` left it.
        clip: CLIP ViT-L/14 in transformers' layout or open_clip's.
        to: Where it goes; without it, below models/.

    Returns:
        The folder, and the names of the tensors that nothing was made of.

    Raises:
        UserError: for a file that is missing, cut off or of another model, and for pickles that are not trusted.
    """
    import torch
    from peft import LoraConfig

    def read(file: str) -> dict[str, torch.Tensor]:
        if not (source / file).is_file():
            raise UserError(
                f"{name}: {source / file} does not exist; get the folder anew from the links in the README of "
                "github.com/clear-nus/octopi"
            )
        return read_pickle(source / file, name, trust_pickle)

    to = new_folder(to or Path("models") / name)
    encoder, project, adapter = read("encoder.pt"), read("project.pt"), read("llm_weights/adapter_model.bin")
    heads = read("classifier.pt") if (source / "classifier.pt").is_file() else None
    added = read_form(source / "tokenizer" / "added_tokens.json")
    settings = read_form(source / "llm_weights" / ADAPTER_CONFIG)
    if not ((base / TOKENIZER).is_file() and any(base.glob("*.safetensors"))):
        if (there := Path("weights") / DOWNLOADED[CHECKPOINTS[name]].folder).exists():
            raise UserError(
                f"{name}: {base} is as it was downloaded, and {there} is there already; name it with --base"
            )
        base = adopt(CHECKPOINTS[name], base, trust_pickle=trust_pickle)
    check_vicuna(base, CHECKPOINTS[name])
    words = read_form(base / LLM_CONFIG)["vocab_size"]
    matrix = adapter.pop(ADAPTER, torch.empty(0))
    new = sorted(added.get(token, 0) for token in (TACT_START, TACT_END))
    if len(matrix) != words + 2 or new != [words, words + 1]:
        raise UserError(
            f"{name}: {source} has {len(matrix)} word embeddings and the new tokens {added}, but {base} has {words} "
            "words; name the language model that it was trained on"
        )
    catalogue = load_catalogue(Path(__file__).parents[1] / "physiclear")
    with atomic_folder(to) as folder:
        prompts = _write_encoder(name, folder / ENCODER_DIR, encoder, heads, clip, trust_pickle)
        width = project["0.weight"].shape[1]
        form = read_form(folder / ENCODER_DIR / BACKBONE_DIR / CLIP_CONFIG)
        frames = FramesConfig(selection="release", pixels=form["model_cfg"]["vision_cfg"]["image_size"])
        # Embeddings are read as they come.
        statistics = Statistics(torch.zeros(width).double(), torch.ones(width).double(), fingerprint(frames))
        statistics.save(folder / ENCODER_DIR / STATISTICS_FILE)
        config = OctopiConfig(
            base_model=base.as_posix(), tactile_dim=width, hidden_size=matrix.shape[1], trained_embeddings="all"
        )
        write_json(folder / LANGUAGE_DIR / CONFIG_FILE, config.model_dump(mode="json"))
        projection = {f"projection.{key}": value.float() for key, value in project.items()}
        delimiters = matrix[[added[TACT_START], added[TACT_END]]].float()
        save_tensors(folder / LANGUAGE_DIR / CONNECTOR_FILE, {**projection, "delimiters": delimiters})
        save_tensors(folder / LANGUAGE_DIR / WORDS_FILE, {"weight": matrix[:words].float().contiguous()})
        used = {key: value for key, value in adapter.items() if ".lora_" in key}
        save_tensors(folder / LANGUAGE_DIR / ADAPTER_DIR / ADAPTER_WEIGHTS, used)
        kept = {key: settings[key] for key in ("r", "lora_alpha", "lora_dropout", "target_modules")}
        # As today's PEFT has them; the matrix of words is kept apart.
        lora = LoraConfig(**kept, task_type="CAUSAL_LM").to_dict()
        lora["target_modules"] = sorted(lora["target_modules"])
        write_json(folder / LANGUAGE_DIR / ADAPTER_DIR / ADAPTER_CONFIG, lora)
        write_json(folder / CATALOGUE, catalogue.model_dump(mode="json"))
        language = LanguageConfig(
            weights=base.as_posix(), system_prompt=SYSTEM, chat="published", bos=False, max_new_tokens=400
        )
        met = (Part.TRAIN, Part.VALIDATION)
        model = ModelConfig(
            **provenance(folder),
            variant=name,
            encoder_used=Encoder.FINETUNED,
            heads=heads is not None,
            opd=Opd.ALL,
            trained_on="videos",
            facts=False,
            frames=frames,
            encoder=EncoderConfig(recipe="release", weights=clip.as_posix(), prompts=prompts),
            language=language,
            base=Base.of(base),
            chat=chat_sample(load_tokenizer(base), language),
            quiet=0.0,
            usual=None,
            temperatures=dict.fromkeys(catalogue.property_names, 1.0),
            objects=tuple(sorted(o.object_id for o in catalogue.objects.values() if o.splits["release"] in met)),
            scores={},
        )
        write_json(folder / CONFIG, model.model_dump(mode="json"))
        write_card(
            folder,
            f"Octopi: the authors' published weights, {name}",
            bases={"language model": base, "tactile encoder": clip},
            data={"videos": "PhysiCLeAR, the published split", "source": "github.com/clear-nus/octopi"},
            settings={"recipe": "release", "heads": heads is not None, "prompts": prompts, **kept},
            limits=LIMITS,
        )
    return to, sorted(adapter.keys() - used.keys())


def _write_encoder(
    name: str,
    folder: Path,
    encoder: dict[str, torch.Tensor],
    heads: dict[str, torch.Tensor] | None,
    clip: Path,
    trust_pickle: bool,
) -> int:
    """Write tower, prompts and heads; the number of prompts a layer."""
    import torch

    theirs = not (clip / CLIP_CONFIG).is_file()
    if theirs:
        form, state = open_clip_form(clip), to_open_clip(read_weights(clip, name, trust_pickle))
    else:
        stored_shapes([clip_file(clip)], name)
        form, state = read_form(clip / CLIP_CONFIG), load_tensors(clip_file(clip))
    if not form["model_cfg"].get("quick_gelu"):
        raise UserError(f"{name}: {clip} is without quick-GELU; name OpenAI's CLIP ViT-L/14, which they trained on")
    tensors = {key.removeprefix("model."): value for key, value in encoder.items()}
    place = re.compile(r"vision_model\.(?:encoder\.layers\.(\d+)\.VPT_shallow|VPT)")
    found = {int(match[1] or 0): tensors.pop(key) for key in [*tensors] if (match := place.fullmatch(key))}
    tower = to_open_clip(tensors)
    wrong = [key for key, value in tower.items() if key not in state or state[key].shape != value.shape]
    layers = len({key.split(".")[3] for key in state if key.startswith("visual.transformer.resblocks.")})
    if wrong or sorted(found) != list(range(layers)) or len({p.shape for p in found.values()}) > 1:
        reason = f"{wrong[0]} has another shape or name" if wrong else f"prompts of {len(found)} layers for {layers}"
        raise UserError(f"{name}: encoder.pt does not fit {clip} ({reason}); take both from one model")
    # The tower is the checkpoint's own; the projection and the text tower, which nothing reads, are CLIP's.
    write_json(folder / BACKBONE_DIR / CLIP_CONFIG, form)
    whole = {key: value.contiguous() for key, value in {**state, **tower}.items()}
    save_tensors(folder / BACKBONE_DIR / CLIP_WEIGHTS[0], whole, {"format": "pt"})
    prompts = torch.stack([found[layer] for layer in range(layers)]).float()
    trained = {"encoder.prompts.prompts": prompts}
    for there, here in {"fc": "shared", **{f"{p}_fc": f"properties.{i}" for i, p in enumerate(PROPERTIES)}}.items():
        for part in ("weight", "bias"):
            if heads is not None:
                if f"{there}.{part}" not in heads:
                    raise UserError(f"{name}: classifier.pt has no {there}.{part}; get it anew")
                trained[f"heads.{here}.{part}"] = heads[f"{there}.{part}"].float()
    save_tensors(folder / TRAINED, trained)
    return prompts.shape[1]
