"""What the stages before the report leave on disk, made up: real formats, small, a second of work."""

import random
from pathlib import Path

import numpy as np
import yaml
from safetensors.numpy import save_file

from pipeline.config import Params
from pipeline.core.io import write_csv, write_jsonl, write_table
from pipeline.core.records import INDEX_FILE, TENSOR, TENSOR_FILE, Embedding, Measurement, Part, Prediction, Question
from pipeline.encoder.records import Classification
from pipeline.evaluation.grading import grade
from pipeline.evaluation.records import Graded
from pipeline.scales import compose
from pipeline.tasks.examples import build_examples
from pipeline.tasks.questions import build_questions, counts_by_task, pool_of
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.videos.records import Assignment, Finding, Severity, Video
from pipeline.videos.split import assign
from pipeline.weights import is_random
from tests.checkpoints import model_folder
from tests.conftest import ROOT, classified


def fake_params(*overrides: str) -> Params:
    """The smoke scale with overrides; the catalogue is this repository's."""
    here = f"data.catalogue='{ROOT / 'pipeline' / 'physiclear'}'"
    return compose("smoke", [here, "kernels=machine", *overrides], conf=ROOT / "conf")


SKILL = 0.6
"""The share of right answers and classes."""


def write_run(root: Path, params: Params) -> Params:
    """Write params.yaml and data/ of a finished run below `root`; returns the parameters."""
    rng = random.Random(1)
    catalogue = load_catalogue(Path(params.data.catalogue))
    root.mkdir(parents=True, exist_ok=True)
    (root / "params.yaml").write_text(yaml.safe_dump(params.model_dump(mode="json"), sort_keys=False))
    (root / "conf").symlink_to(ROOT / "conf")
    for folder in (params.encoder.weights, params.language.weights):
        if is_random(folder):
            (root / folder).parent.mkdir(parents=True, exist_ok=True)
            (root / folder).symlink_to(model_folder(Path(folder).name))
    data, parts = root / "data", {o.object_id: o.splits["paper"] for o in catalogue.objects.values()}
    videos = [_video(o, i, rng) for o in sorted(params.scenes.objects) for i in range(2)]
    assignments = [Assignment(video_id=v.video_id, object_id=v.object_id, part=parts[v.object_id]) for v in videos]
    write_table(data / "videos.parquet", Video, videos)
    splits = dict.fromkeys(params.ablation.seeds, assignments)
    if params.split.name == "kfold":
        splits = {seed: assign(catalogue, videos, params.split, seed) for seed in splits}
    agreed = {"check": "agreement, ICC(3,k)", "measured": "0.893 (0.843 to 0.929)", "severity": Severity.INFO}
    audit = [Finding(item=name, **agreed) for name in catalogue.property_names]
    write_csv(data / "audit" / "audit.csv", Finding, audit)
    counts, asked = counts_by_task(params.questions, "evaluation"), {}
    for seed, split in splits.items():
        write_table(data / "splits" / f"{seed}.parquet", Assignment, split)
        pool, fold = pool_of(Part.TEST, split, catalogue), params.split.fold_of(seed)
        asked[seed] = build_questions(pool, counts, seed=0, distinct=True, fold=fold)
        write_jsonl(data / "questions" / str(seed) / "evaluation.jsonl", asked[seed])
        write_jsonl(data / "questions" / str(seed) / "examples.jsonl", build_examples(split, catalogue, seed=0))
        for encoder in params.ablation.encoders:
            folder = data / "embeddings" / f"{encoder}-{seed}"
            frames = [Embedding(video_id=a.video_id, frame_index=0, flip="none", row=i) for i, a in enumerate(split)]
            write_table(folder / INDEX_FILE, Embedding, frames)
            features = np.random.default_rng(seed).normal(size=(len(split), 4)).astype(np.float32)
            save_file({TENSOR: features}, folder / TENSOR_FILE)
        said = [c for a in split for c in _classify(a, catalogue, rng)]
        write_table(data / "encoder" / str(seed) / "classifications.parquet", Classification, said)
        write_table(data / "encoder" / str(seed) / "history.parquet", Measurement, _history("loss", "validation_loss"))
    graded = []
    for variant in params.ablation.variants():
        questions, replicate = asked[variant.seed], params.split.replicate_of(variant.seed)
        model = f"{variant.encoder}-{variant.opd}-{variant.seed}"
        write_table(data / "models" / variant.lora / model / "history.parquet", Measurement, _history("loss"))
        if variant.full:
            examples = build_examples(splits[variant.seed], catalogue, seed=0)
            told = [p for q in examples if (p := _say(q, variant.opd, rng))]
            write_jsonl(data / "answers" / variant.key / "examples.jsonl", told)
        for touch in params.ablation.touches(variant):
            answers = [p for q in questions if (p := _say(q, variant.opd, rng))]
            write_jsonl(data / "answers" / variant.key / f"{touch}.jsonl", answers)
            whose = {**variant._asdict(), "seed": replicate, "trained": variant.seed, "touch": touch}
            graded += [Graded(**s.model_dump(), **whose) for s in grade(questions, answers, catalogue)]
    write_table(data / "graded.parquet", Graded, graded)
    return params


def _video(object_id: str, number: int, rng: random.Random) -> Video:
    name = f"{object_id}_{number}"
    shape = {"frames": rng.randint(20, 30), "fps": 25.0, "width": 160, "height": 120}
    return Video(video_id=name, object_id=object_id, path=f"{name}.avi", sha256=f"{rng.getrandbits(256):064x}", **shape)


def _classify(a: Assignment, catalogue: Catalogue, rng: random.Random) -> list[Classification]:
    if a.part not in (Part.VALIDATION, Part.TEST):
        return []
    said = []
    for p, label in zip(catalogue.properties, catalogue.labels(a.object_id), strict=True):
        predicted = label if rng.random() < SKILL else rng.randrange(len(p.levels))
        probabilities = tuple(1 / len(p.levels) for _ in p.levels) if len(p.levels) != 3 else (0.2, 0.3, 0.5)
        said.append(classified(a.video_id, p.name, label, predicted, probabilities, a.part))
    return said


def _say(q: Question, opd: str, rng: random.Random) -> Prediction | None:
    """The right answer, or one that cannot be read."""
    dialogue = next((d for d in q.dialogues if d.opd == opd), None)
    if dialogue is None:
        return None
    right = rng.random() < SKILL
    outputs = tuple(turn.assistant if right else "I cannot tell." for turn in dialogue.turns)
    return Prediction(question_id=q.question_id, task=q.task, outputs=outputs, truncated=not right, tokens=9)


def _history(*names: str) -> list[Measurement]:
    return [Measurement(step=s, name=name, value=4 / (1 + s / 9)) for s in range(1, 9) for name in names]
