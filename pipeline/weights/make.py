"""Making base models: from packages that hold pretrained weights, or tiny and at random.

A folder is written beside its place, with a card and the licence, and renamed when it is whole.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import yaml

from pipeline.core.io import atomic_folder, write_text
from pipeline.running.errors import UserError
from pipeline.weights import DOWNLOADED, MADE, REPOSITORIES, installed, tiny
from pipeline.weights.check import VICUNA_7B

if TYPE_CHECKING:
    import torch

CATALOGUE = Path(__file__).parents[1] / "physiclear"
LITE_MEAN, LITE_STD = 127 / 255, 128 / 255
"""Of pixels in [0, 1]: MEAN_RGB and STDDEV_RGB of TensorFlow's efficientnet_lite_builder.py."""


def write_efficientnet(folder: Path, source: Path, seed: int) -> None:
    """Write EfficientNet-Lite0 (Tan and Le 2019, arXiv:1905.11946; "lite": no squeezing, ReLU6) as timm lays it out.

    `source` is a state dict of efficientnet-lite-pytorch, read without running any code of it.
    """
    import timm
    import torch
    from timm.models import save_for_hf

    stored: dict[str, torch.Tensor] = torch.load(source, map_location="cpu", weights_only=True)
    model = timm.create_model("tf_efficientnet_lite0", pretrained=False)
    # Both list the same layers in the order in which pictures pass them, under names of their own.
    model.load_state_dict(dict(zip(model.state_dict(), stored.values(), strict=True)))
    means = {"mean": (LITE_MEAN,) * 3, "std": (LITE_STD,) * 3}
    save_for_hf(model, str(folder), model_config={"pretrained_cfg": means}, data_config=means, safe_serialization=True)


def write_smollm2(folder: Path, source: Path, seed: int) -> None:
    """Write SmolLM2-135M-Instruct (Allal et al. 2025, arXiv:2502.02737), a GGUF file, as transformers' in float32."""
    import torch
    from transformers import AutoModelForCausalLM, AutoTokenizer

    where, file = source.parent, source.name
    safely = {"local_files_only": True, "trust_remote_code": False}
    model = AutoModelForCausalLM.from_pretrained(where, gguf_file=file, dtype=torch.float32, **safely)
    # The weights have been widened, but transformers still marks them as quantized and would not save them.
    if hasattr(model.config, "quantization_config"):
        del model.config.quantization_config
    model.is_quantized, model.hf_quantizer = False, None
    model.save_pretrained(folder)
    AutoTokenizer.from_pretrained(where, gguf_file=file, **safely).save_pretrained(folder)


class PackagedWeights(NamedTuple):
    """How a base model is made."""

    write: Callable[[Path, Path, int], None]
    """Writes it into an empty folder. Further arguments: the file with the published weights (for a model that is drawn
    the catalogue's folder) and the seed."""
    card: Mapping[str, object]
    """Front matter of its card, in Hugging Face's keys; `taught` is what reports say of it."""
    about: str
    """The text of its card."""


RECIPES = {
    "efficientnet-lite0": PackagedWeights(
        write_efficientnet,
        {
            "license": "apache-2.0",
            "library_name": "timm",
            "datasets": ["imagenet-1k"],
            "taught": "pretrained on ImageNet's photographs by Google",
        },
        "EfficientNet-Lite0, trained on ImageNet-1k and published by Google for TensorFlow, converted to PyTorch by\n"
        "ML Illustrated and renamed here to timm's `tf_efficientnet_lite0`. It wants RGB as (value - 127) / 128.",
    ),
    "smollm2": PackagedWeights(
        write_smollm2,
        {
            "license": "apache-2.0",
            "base_model": [REPOSITORIES["smollm2"]],
            "library_name": "transformers",
            "language": ["en"],
            "taught": "pretrained on English text and tuned to follow instructions by its makers",
        },
        "SmolLM2-135M-Instruct by Hugging Face as a Llama in float32, with its tokenizer and chat template. The "
        "published\nweights were rounded to blocks of four bits (Q4_1) before they came into the package; here they "
        "are widened and\nstay rounded.",
    ),
    **{
        name: PackagedWeights(
            partial(write, name=name, **how),
            {"license": "mit", "library_name": library, "taught": "drawn at random and taught nothing"},
            "A model with random weights. It knows nothing: figures that it makes are chance.",
        )
        for name, library, write, how in (
            ("tiny-clip", "open_clip", tiny.write_clip, {"form": tiny.CLIP}),
            ("random-clip-vit-large", "open_clip", tiny.write_clip, {"form": tiny.VIT_LARGE}),
            ("tiny-llama", "transformers", tiny.write_llama, {"form": tiny.LLAMA}),
            ("random-vicuna-7b", "transformers", tiny.write_llama, {"form": VICUNA_7B, "dtype": "bfloat16"}),
        )
    },
}
"""By name; `pipeline.weights.MADE` says which kind each is, and where its weights come from."""
PACKAGED = {name for name, made in MADE.items() if made.origin}
"""Those that an installed package holds."""


def make(name: str, folder: Path, *, seed: int = 0, catalogue: Path = CATALOGUE) -> None:
    """Make a base model of `RECIPES`, whole or not at all; what lies in the folder is replaced.

    Args:
        seed: Of the weights of a random model.
        catalogue: Folder whose words the tokenizer of a random language model knows.

    Raises:
        UserError: for an unknown name, or a package that is missing or holds another file than was tested.
    """
    if name not in RECIPES:
        raise UserError(f"weights {name!r} are not known; allowed: {', '.join((*RECIPES, *DOWNLOADED))}")
    recipe, origin = RECIPES[name], MADE[name].origin
    source = origin.find() if origin else catalogue
    with atomic_folder(folder) as temporary:
        recipe.write(temporary, source, seed)
        told = "Drawn from a seed by this pipeline."
        if origin:
            told = f"Made of `{origin.file}` of the package {origin.package} {origin.version}, sha256 {origin.sha256}."
            for file in installed(origin.package).files or ():
                if file.name == "LICENSE":
                    shutil.copyfile(str(file.locate()), temporary / "LICENSE")
        front = yaml.safe_dump(dict(recipe.card), sort_keys=False)
        write_text(temporary / "README.md", f"---\n{front}---\n# {name}\n\n{recipe.about}\n\n{told}\n")
