"""Where the chain's files lie, relative to the project's folder; dvc.yaml has the same places as outputs."""

from pathlib import Path

from pipeline.core.records import Encoder, Variant

DATA, RUNS, REPORTS, MODELS = Path("data"), Path("runs"), Path("reports"), Path("models")
CHECKPOINTS = Path("checkpoints")
"""Where unfinished work waits to be resumed, outside DVC's reach: DVC deletes the outputs of a killed stage."""
SHIPPED = Path(__file__).parents[1] / "pretrained" / "octopi-small"
"""The model that is part of the package."""
EXTERNAL = Path("external")
"""What models behind endpoints answered, by report and model: an input of the chain, where no stage asks a network."""
INVENTED = DATA / "invented"
"""The catalogue of invented objects; `data.catalogue` names it to have them."""
SCENES_DIR = DATA / "scenes" / "videos"
"""The videos that the chain makes itself."""
PRETRAINED = DATA / "pretrained" / "encoder.safetensors"
"""The network that is pretrained on synthetic pictures, the backbone `scenes`."""
VIDEOS, FRAMES, AUDIT, QUESTIONS = DATA / "videos.parquet", DATA / "frames", DATA / "audit", DATA / "questions"
GRADED, GRADED_VISION, EVALUATED = (DATA / f"{name}.parquet" for name in ("graded", "graded_vision", "evaluated"))
HISTORY_FILE, TRAINED_FILE, CLASSIFIED_FILE = "history.parquet", "encoder.safetensors", "classifications.parquet"
"""In a training's folder its curves, and in the encoder's its weights and what its heads say of held-out videos."""


def split_file(seed: int) -> Path:
    """Which video is for what, under one seed."""
    return DATA / "splits" / f"{seed}.parquet"


def questions_file(seed: int, name: str = "evaluation") -> Path:
    """The questions of one seed: `evaluation`, `train` or `examples`."""
    return QUESTIONS / str(seed) / f"{name}.jsonl"


def encoder_dir(seed: int) -> Path:
    """An encoder's training."""
    return DATA / "encoder" / str(seed)


def embeddings_dir(encoder: Encoder, seed: int) -> Path:
    """Embeddings of all kept frames."""
    return DATA / "embeddings" / f"{encoder}-{seed}"


def trained_dir(variant: Variant) -> Path:
    """The folder of a language model's training, whose name is also the key of its stage."""
    return DATA / "models" / variant.lora / f"{variant.encoder}-{variant.opd}-{variant.seed}"


def answers_dir(variant: Variant) -> Path:
    """What a variant answered, a file for each input ablation."""
    return DATA / "answers" / variant.key
