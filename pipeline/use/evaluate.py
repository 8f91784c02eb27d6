"""Evaluation of trained models on a run's videos, whose objects they were not trained on."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch.utils.mkldnn import to_mkldnn

from pipeline.config import Params
from pipeline.core.layout import SHIPPED
from pipeline.core.records import Part
from pipeline.encoder.records import Classification
from pipeline.evaluation.grading import conclude, grade
from pipeline.evaluation.records import GradedVision, Shown
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.running.errors import UserError
from pipeline.running.progress import track
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions, counts_by_task
from pipeline.training.embeddings import EmbeddingStore
from pipeline.use.model import Octopi
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.records import Video

logger = logging.getLogger(__name__)

BATCH = 64
"""Answers of the shipped model in a batch; their keys and values take a gigabyte. Each step reads all weights once,
however many answers share it."""


def answers_about(
    octopi: Octopi, params: Params, videos: Sequence[Video], parts: Mapping[str, Part]
) -> list[GradedVision]:
    """Ask questions about the videos as `evaluate` has them, and grade the answers and what follows by rule from heads.

    Where embeddings are standardised, real videos are asked about twice: as they are, and standardised by their own
    mean and deviation, which takes no label. Another sensor shifts and scales embeddings. A model of other properties
    or classes is asked nothing, since it has no words for these.

    Args:
        parts: The part of the split that each object is in.

    Raises:
        UserError: for an object that the model was trained on, or a video that it cannot use.
    """
    config = params.evaluate
    catalogue = load_catalogue(Path(params.data.catalogue)).asking(params.questions.scenarios)
    catalogue = catalogue.called("number" if octopi.numbered else "catalogue")
    known, wanted = (
        "; ".join(f"{name}: {', '.join(levels)}" for name, levels in c.classes.items())
        for c in (octopi.catalogue, catalogue)
    )
    if known != wanted:
        logger.warning("%s is not asked: it knows %s, but %s has %s", octopi.name, known, params.data.catalogue, wanted)
        return []
    videos = [v for v in videos if config.objects == "all" or parts.get(v.object_id) is Part.TEST]
    of_object: dict[str, list[str]] = {}
    for video in videos:
        of_object.setdefault(video.object_id, []).append(video.video_id)
    if met := sorted({*(octopi.config.objects or octopi.catalogue.objects)} & of_object.keys()):
        raise UserError(
            f"evaluate.models: {octopi.name} was trained on {met[0]}, which it is to be asked about; leave the model "
            "out, or choose a split.name that tests on other objects"
        )
    counts = {task: count for task, count in counts_by_task(params.questions, "evaluation").items() if count}
    if config.questions:
        # Half of the questions are descriptions: their answers are short, and other answers follow from descriptions.
        shares = {task: max(1, len(counts) - 1) if task == "OPD" else 1 for task in counts}
        counts = {task: config.questions * share // sum(shares.values()) for task, share in shares.items()}
    asked = {}
    for repeat in range(config.repeats):
        pool, seed = Pool(Part.TEST, catalogue, of_object), params.questions.seed + repeat
        drawn = build_questions(pool, counts, seed=seed, distinct=True, facts=octopi.config.facts)
        asked[repeat] = [
            q.model_copy(update={"question_id": f"{q.question_id}-{repeat}"}) if repeat else q for q in drawn
        ]
    touches, rows, classified = touched(octopi, catalogue, Path(params.data.dir), videos)
    ways = {Shown.TOUCH: touches}
    if params.data.source == "videos" and octopi.config.encoder.standardize:
        std, mean = torch.std_mean(touches, dim=0, correction=0)
        ways[Shown.STANDARDISED] = (touches - mean) / torch.where(std > 0, std, 1.0)  # As `adapt` does.
    language, per_video = octopi.config.language, octopi.config.frames.per_video
    if params.kernels == "portable":
        use_onednn(octopi.llm)
    if octopi.folder == SHIPPED:
        language = language.model_copy(update={"generation_batch_size": BATCH})
    found = []
    for repeat, questions in asked.items():
        scored = {}
        for shown, features in ways.items():
            store = EmbeddingStore().with_rows(rows, features)
            said = answer(octopi.llm, store, questions, octopi.config.opd, language, per_video)
            scored[shown] = grade(questions, said, catalogue)
        if octopi.config.heads:
            scored[Shown.CLASSES] = conclude(questions, classified, catalogue)
        for shown, scores in scored.items():
            found += [
                GradedVision(
                    **score.model_dump(), model=octopi.name, shown=shown, seed=params.ablation.seeds[0] + repeat
                )
                for score in scores
            ]
    return found


def use_onednn(model: OctopiForCausalLM) -> None:
    """Have oneDNN compute a language model's layers where it is float32 and on a processor, its adapter added in.

    With `kernels: portable` MKL multiplies by SSE, the one code that it has for processors of all makers; oneDNN has
    AVX2 on all. So the shipped model answers in half of the time.
    """
    first = next(model.llm.parameters())
    if first.device.type != "cpu" or first.dtype != torch.float32 or not torch.backends.mkldnn.is_available():
        return
    merge = getattr(model.llm, "merge_and_unload", None)
    model.llm = to_mkldnn(merge() if merge else model.llm)


def touched(
    octopi: Octopi, catalogue: Catalogue, folder: Path, videos: Sequence[Video]
) -> tuple[torch.Tensor, dict[str, range], list[Classification]]:
    """Encode and classify videos.

    Returns:
        The features of all frames, one video after another (frames x dim), where each video's frames are in them, and
        what the heads say.
    """
    features, rows, classified = [torch.zeros(0, octopi.llm.octopi_config.tactile_dim)], dict[str, range](), []
    for video in track(videos, "touches", "video"):
        before = sum(map(len, features))
        features.append(octopi.encoder.encode(folder / video.path).features)
        rows[video.video_id] = range(before, before + len(features[-1]))
        if not octopi.config.heads:
            continue
        said = octopi.encoder.classify(folder / video.path)
        found = zip(catalogue.properties, catalogue.labels(video.object_id), *said, strict=True)
        classified += [
            Classification(
                video_id=video.video_id,
                object_id=video.object_id,
                part=Part.TEST,
                property=prop.name,
                expected=label,
                predicted=level,
                probabilities=probabilities,
            )
            for prop, label, probabilities, level in found
        ]
    return torch.cat(features), rows, classified
