"""Evaluation of trained models on a run's videos, whose objects they were not trained on.

They answer as they are, and after `octopi adapt` by a few objects: the learning curve of another sensor.
"""

from __future__ import annotations

import logging
import random
from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch.utils.mkldnn import to_mkldnn

from pipeline.config import Params
from pipeline.core.layout import SHIPPED
from pipeline.core.records import Part, Question
from pipeline.core.runtime import derive_seed
from pipeline.encoder.records import Classification
from pipeline.evaluation.grading import conclude, grade
from pipeline.evaluation.records import ADAPTED, GradedVision, Shown
from pipeline.language.generate import answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.running.errors import UserError
from pipeline.running.progress import track
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions, counts_by_task, pool_of
from pipeline.training.embeddings import EmbeddingStore
from pipeline.use.adapt import adapt
from pipeline.use.model import Octopi
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.records import Assignment, Video

logger = logging.getLogger(__name__)

BATCH = 64
"""Answers of the shipped model in a batch; their keys and values take a gigabyte. Each step reads all weights once,
however many answers share it."""


def answers_about(
    octopi: Octopi, params: Params, videos: Sequence[Video], parts: Mapping[str, Part]
) -> list[GradedVision]:
    """Ask questions about the videos as `evaluate` has them, and grade the answers and what follows by rule from heads.

    A model of other properties or classes is asked nothing, since it has no words for these, and neither is one whose
    heads alone answer.

    Args:
        parts: The part of the split that each object is in.

    Raises:
        UserError: for an object that the model was trained on, or a video that it cannot use.
    """
    config = params.evaluate
    if (catalogue := _asking(octopi, params)) is None:
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
        asked[params.ablation.seeds[0] + repeat] = [
            q.model_copy(update={"question_id": f"{q.question_id}-{repeat}"}) if repeat else q for q in drawn
        ]
    return _graded(octopi, octopi.name, params, catalogue, videos, asked)


def check_rated(counts: Sequence[int], splits: Mapping[int, Sequence[Assignment]]) -> None:
    """Raise UserError where a seed's split trains on fewer objects than are to be rated, before hours are spent."""
    for seed, assigned in splits.items():
        known = len({a.object_id for a in assigned if a.part is Part.TRAIN})
        if counts and max(counts) > known:
            raise UserError(
                f"evaluate.rated: {max(counts)} objects, but seed {seed} trains on {known}; name at most as many"
            )


def answers_after_ratings(
    octopi: Octopi, params: Params, videos: Sequence[Video], assigned: Sequence[Assignment], seed: int, count: int
) -> list[GradedVision]:
    """Adapt a model by `count` training objects of one split, and ask it the chain's questions about its test objects.

    Larger counts have the objects of smaller ones, and more.

    Args:
        assigned: The split of this seed.
        count: 0 adapts by the videos of all training objects, without their ratings.

    Raises:
        UserError: as `adapt` has it.
    """
    if (catalogue := _asking(octopi, params)) is None:
        return []
    folder, rated = Path(params.data.dir), load_catalogue(Path(params.data.catalogue))
    names = sorted({a.object_id for a in assigned if a.part is Part.TRAIN})
    random.Random(derive_seed(seed, "rated")).shuffle(names)
    own = [v for v in videos if v.object_id in names[: count or None]]
    tested = {a.video_id for a in assigned if a.part is Part.TEST}
    split = params.split
    questions = build_questions(
        pool_of(Part.TEST, assigned, catalogue),
        counts_by_task(params.questions, "evaluation"),
        seed=params.questions.seed,
        distinct=True,
        facts=octopi.config.facts,
        restate=params.questions.restate,
        fold=split.fold_of(seed),
    )
    with TemporaryDirectory() as place:
        to = Path(place) / "adapted"
        whose = [v.object_id for v in own]
        adapt(octopi, [folder / v.path for v in own], to, catalogue=rated if count else None, objects=whose, seed=seed)
        adapted = Octopi.from_pretrained(to, device=params.runtime.device, dtype=params.language.dtype)
        about, asked = [v for v in videos if v.video_id in tested], {split.replicate_of(seed): questions}
        return _graded(adapted, after_ratings(octopi.name, count), params, catalogue, about, asked)


def after_ratings(model: str, count: int) -> str:
    """What a report calls a model that was adapted by so many rated objects."""
    return f"{model}{ADAPTED}{count}"


def _asking(octopi: Octopi, params: Params) -> Catalogue | None:
    """The run's objects as the model is asked about them; None, with a warning, where it knows other classes."""
    catalogue = load_catalogue(Path(params.data.catalogue)).asking(params.questions.scenarios)
    known, wanted = (
        "; ".join(f"{name}: {', '.join(levels)}" for name, levels in c.classes.items())
        for c in (octopi.catalogue, catalogue)
    )
    if known != wanted:
        logger.warning("%s is not asked: it knows %s, but %s has %s", octopi.name, known, params.data.catalogue, wanted)
        return None
    if not octopi.config.speaks:
        logger.warning("%s is not asked: its heads alone answer", octopi.name)
        return None
    return catalogue.called("number" if octopi.numbered else "catalogue")


def _graded(
    octopi: Octopi,
    name: str,
    params: Params,
    catalogue: Catalogue,
    videos: Sequence[Video],
    asked: Mapping[int, Sequence[Question]],
) -> list[GradedVision]:
    """Answers about videos, graded; by the seed under which a report counts them."""
    touches, rows, classified = touched(octopi, catalogue, Path(params.data.dir), videos)
    language, per_video = octopi.config.language, octopi.config.frames.per_video
    if params.kernels == "portable":
        use_onednn(octopi.llm)
    if name.partition(ADAPTED)[0] == SHIPPED.name:
        language = language.model_copy(update={"generation_batch_size": BATCH})
    found = []
    for seed, questions in asked.items():
        store = EmbeddingStore().with_rows(rows, touches)
        said = answer(octopi.llm, store, questions, octopi.config.opd, language, per_video)
        scored = {Shown.TOUCH: grade(questions, said, catalogue)}
        if octopi.config.heads:
            scored[Shown.CLASSES] = conclude(questions, classified, catalogue)
        for shown, scores in scored.items():
            found += [GradedVision(**score.model_dump(), model=name, shown=shown, seed=seed) for score in scores]
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
