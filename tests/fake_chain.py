"""What the stages before the report and the publishing leave on disk, made up: real formats, small, seconds away."""

from __future__ import annotations

import random
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml
from safetensors.numpy import save_file

from pipeline.io import write_csv, write_json, write_jsonl, write_table
from pipeline.params import Params
from pipeline.evaluation.grading import grade
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.plan import Variant
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.records import (
    Assignment,
    Classification,
    Embedding,
    Finding,
    Frame,
    Judged,
    Measurement,
    Part,
    Prediction,
    Question,
    Score,
    Severity,
    Video,
)
from pipeline.scales import compose
from pipeline.stability.record import Judgement, StabilityRow
from pipeline.tracking.reproduction import planned_stages
from tests.closure import ROOT

DIM = 8
VIDEOS_AN_OBJECT = 3
HARD_CASES = [
    StabilityRow(part=p, case=c, dtype=d, finite=True, error=e, bound=b, verdict=Judgement.PASSED)
    for p, c, d, e, b in (
        ("projection", "all zero", "float64", None, None),
        ("projection", "all zero", "bfloat16", 0.0031, 0.01),
        ("projection", "huge", "bfloat16", 1.2e-7, 1e-5),
        ("frames", "black", "uint8", 0.0, 0.0),
    )
]


def fake_params(*overrides: str) -> Params:
    """The smoke scale with overrides; its catalogue is this repository's."""
    catalogue = ROOT / "pipeline" / "physiclear"
    return compose("smoke", [f"data.catalogue='{catalogue}'", *overrides], conf=ROOT / "conf")


def write_chain(root: Path, params: Params, *, objects: Sequence[str] = (), skill: float = 0.6) -> None:
    """Write params.yaml and data/ of a finished chain below `root`.

    Args:
        objects: those that have videos; all of `scenes.objects` by default.
        skill: the share of right answers and classifications.
    """
    rng = random.Random(1)
    catalogue = load_catalogue(Path(params.data.catalogue))
    root.mkdir(parents=True, exist_ok=True)
    (root / "params.yaml").write_text(yaml.safe_dump(params.model_dump(mode="json"), sort_keys=False))
    (root / "dvc.yaml").write_text("stages: {}\n")
    videos = [_video(o, i, rng) for o in sorted(objects or params.scenes.objects) for i in range(VIDEOS_AN_OBJECT)]
    parts = {o.object_id: o.splits["paper"] for o in catalogue.objects.values()}
    assignments = [Assignment(video_id=v.video_id, object_id=v.object_id, part=parts[v.object_id]) for v in videos]
    data = root / "data"
    write_table(data / "videos.parquet", Video, videos)
    write_table(data / "splits.parquet", Assignment, assignments)
    write_csv(data / "audit" / "audit.csv", Finding, _audit(videos))
    write_csv(data / "stability.csv", StabilityRow, HARD_CASES)
    pool = pool_of(Part.TEST, assignments, catalogue)
    questions = build_questions(pool, params.questions.evaluation.by_task(), seed=0, distinct=True)
    write_jsonl(data / "questions" / "evaluation.jsonl", questions)
    for seed in params.plan.encoder_seeds:
        folder = data / "encoder" / str(seed)
        judged = [c for a in assignments for c in _classify(a, catalogue, skill, rng)]
        write_table(folder / "classifications.parquet", Classification, judged)
        write_table(folder / "history.parquet", Measurement, _encoder_history(catalogue, rng))
    for key in params.plan.embeddings:
        _embed(data / "embeddings" / key, assignments)
    for stage, jobs in (("align", params.plan.align), ("lora", params.plan.lora)):
        for key in jobs:
            write_table(data / stage / key / "history.parquet", Measurement, _loss(rng, 60))
            (data / stage / key / "connector.safetensors").write_bytes(b"weights")
    for key, variant in params.plan.variants.items():
        said = [p for q in questions if (p := _say(q, variant, skill, rng))]
        write_jsonl(data / "answers" / key / "predictions.jsonl", said)
        write_table(data / "scores" / key / "scores.parquet", Score, grade(questions, said, catalogue))
    _film(data / "frames", videos)
    for name in params.plan.cross_validation:
        records = [_judge(a, catalogue, skill, rng) for a in assignments]
        write_table(data / "cross_validation" / name / "judged.parquet", Judged, records)


def write_lock(root: Path, params: Params, changed: str = "", only: Sequence[str] = ()) -> None:
    """dvc.lock, data/metrics and runs/ of a finished chain, or of the stages `only`; `changed` has another hash."""
    stages = {}
    for stage in planned_stages(params.plan):
        if only and stage.title not in only:
            continue
        mark = "f" * 32 if stage.title == changed else "0" * 32
        stages[stage.title] = {
            "cmd": f"python stages/{stage.name}.py {stage.key}".strip(),
            "deps": [
                {"path": "data/videos.parquet", "hash": "md5", "md5": mark, "size": 1},
                {"path": "pipeline/config.py", "hash": "md5", "md5": "1" * 32, "size": 1},
            ],
            "params": {"params.yaml": {"seed": 0, "frames": {"size": 64}}},
            "outs": [{"path": f"data/{stage.title}", "hash": "md5", "md5": f"{'2' * 32}.dir", "size": 1}],
        }
        write_json(root / "data" / "metrics" / f"{stage.title}.json", {"loss": 0.5, "steps": 60.0})
        cost = {"started": "2024-05-01T10:00:00+00:00", "startup_seconds": 1.0, "seconds": 9.0, "peak_memory_mb": 100.0}
        write_json(root / "runs" / f"{stage.title}.json", cost)
    stages["align@of-another-scale"] = {"cmd": "python stages/align.py of-another-scale"}
    (root / "dvc.lock").write_text(yaml.safe_dump({"schema": "2.0", "stages": stages}))


def _video(object_id: str, number: int, rng: random.Random) -> Video:
    return Video(
        video_id=f"{object_id}_{number}",
        object_id=object_id,
        path=f"{object_id}_{number}.avi",
        sha256=f"{rng.getrandbits(256):064x}",
        frames=rng.randint(20, 30),
        fps=25.0,
        width=160,
        height=120,
    )


def _audit(videos: Sequence[Video]) -> list[Finding]:
    """A warning that all videos share, one of its own, and what is as it should be."""
    warning, info = Severity.WARNING, Severity.INFO
    shared = [
        Finding(
            check="contact", item=v.path, measured="not found: strength 0.10", expected="over 0.50", severity=warning
        )
        for v in videos
    ]
    alone = Finding(check="stated label", item="rug: hardness", measured="soft | low", severity=warning)
    return [*shared, alone, Finding(check="same content", item="all", measured="0 files", severity=info)]


def _classify(a: Assignment, catalogue: Catalogue, skill: float, rng: random.Random) -> list[Classification]:
    records = []
    for p, label in zip(catalogue.properties, catalogue.labels(a.object_id), strict=True):
        guess = label if rng.random() < skill else rng.randrange(len(p.levels))
        records.append(
            Classification(
                video_id=a.video_id,
                object_id=a.object_id,
                part=a.part,
                property=p.name,
                expected=label,
                predicted=guess,
                probabilities=(0.2, 0.3, 0.5),
            )
        )
    return records if a.part in (Part.VALIDATION, Part.TEST) else []


def _judge(a: Assignment, catalogue: Catalogue, skill: float, rng: random.Random) -> Judged:
    labels = catalogue.labels(a.object_id)
    guess = labels if rng.random() < skill else tuple(rng.randrange(len(p.levels)) for p in catalogue.properties)
    return Judged(video_id=a.video_id, object_id=a.object_id, repeat=0, expected=labels, predicted=guess)


def _say(q: Question, variant: Variant, skill: float, rng: random.Random) -> Prediction | None:
    """The gold answer, or one that cannot be read."""
    dialogue = q.dialogue(variant.opd)
    if dialogue is None:
        return None
    right = rng.random() < skill
    outputs = tuple(turn.assistant if right else "I cannot tell." for turn in dialogue.turns)
    return Prediction(question_id=q.question_id, task=q.task, outputs=outputs, truncated=not right, tokens=9)


def _film(folder: Path, videos: Sequence[Video], kept: int = 4, side: int = 24) -> None:
    """Frames of one colour each."""
    rng = np.random.default_rng(0)
    index = [
        Frame(video_id=v.video_id, frame_index=i, score=0, row=kept * place + i)
        for place, v in enumerate(videos)
        for i in range(kept)
    ]
    colours = rng.integers(0, 256, (len(index), 1, 1, 3), dtype=np.uint8)
    folder.mkdir(parents=True)
    np.save(folder / "frames.npy", np.broadcast_to(colours, (len(index), side, side, 3)))
    np.save(folder / "references.npy", np.full((len(videos), side, side, 3), 90, np.uint8))
    write_table(folder / "frames.parquet", Frame, index)


def _embed(folder: Path, assignments: Sequence[Assignment]) -> None:
    rng = np.random.default_rng(0)
    centres = {o: rng.normal(size=DIM) for o in sorted({a.object_id for a in assignments})}
    index, rows = [], []
    for a in assignments:
        for frame in range(4):
            for flip in ("none", "horizontal"):
                index.append(Embedding(video_id=a.video_id, frame_index=frame, flip=flip, row=len(rows)))
                rows.append(centres[a.object_id] + rng.normal(scale=0.3, size=DIM))
    folder.mkdir(parents=True)
    save_file({"embeddings": np.array(rows, dtype=np.float32)}, folder / "embeddings.safetensors")
    write_table(folder / "index.parquet", Embedding, index)


def _encoder_history(catalogue: Catalogue, rng: random.Random) -> list[Measurement]:
    history = []
    for step in (2, 4, 6, 8):
        history.append(Measurement(step=step, name="loss", value=3 / step + rng.random()))
        names = (*catalogue.property_names, "combined")
        history += [Measurement(step=step, name=f"validation_{n}", value=rng.random()) for n in names]
    return history


def _loss(rng: random.Random, steps: int) -> list[Measurement]:
    return [Measurement(step=s, name="loss", value=4 / (1 + s / 9) + 0.2 * rng.random()) for s in range(1, steps + 1)]
