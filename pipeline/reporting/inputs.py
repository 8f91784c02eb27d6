"""Everything that a report is made from, read once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.io import read_csv, read_jsonl, read_table
from pipeline.params import Params
from pipeline.videos.catalogue import Catalogue, load_catalogue
from pipeline.plan import Encoder, Lora
from pipeline.records import (
    Assignment,
    Classification,
    Finding,
    GateRow,
    Opd,
    Part,
    Prediction,
    Question,
    Score,
    Task,
    Touch,
    Video,
)
from pipeline.reporting.published import DATASET, Published, find
from pipeline.videos.split import assign
from pipeline.stability.record import STABILITY_FILE, StabilityRow
from pipeline.tasks.described import described_right

Axes = tuple[Encoder, Lora, Opd]
GATE_FILE = "gate.csv"


@dataclass(frozen=True)
class Inputs:
    """What the stages before the report have left on disk; a file that is not there is an absent key."""

    params: Params
    catalogue: Catalogue
    videos: Sequence[Video]
    assignments: Sequence[Assignment]
    missing: tuple[str, ...]
    """Objects that the split would test on but that have no video."""
    questions: Mapping[str, Task]
    """Evaluation questions about test videos: id to task."""
    scores: Mapping[str, Sequence[Score]]
    """By variant; only of `questions`."""
    described: Mapping[str, Mapping[str, bool | None]]
    """By variant that describes before it concludes, and question: whether all that is asked about is described
    right; None where that cannot be read."""
    classifications: Mapping[int, Sequence[Classification]]
    """By encoder seed: what the heads say about test videos."""
    findings: Sequence[Finding]
    """The data audit's."""
    hard_cases: Sequence[StabilityRow]
    """Of every part, judged."""
    gate: Mapping[Task, bool]
    """By task: whether the base language model can do it on perfect descriptions; empty where nobody asked it."""

    def told(self, task: Task) -> bool:
        """Whether the task's questions say what the objects are like, so that no knowledge of them is asked for."""
        return task is Task.POM and self.params.questions.facts

    @property
    def of_paper(self) -> bool:
        """Whether the catalogue is of the data set that the paper's figures are about."""
        return self.catalogue.language.dataset == DATASET

    def published(self, table: str, row: str, system: str, model: str = "") -> Published | None:
        """The paper's cell, or None where it has none or is about another data set."""
        return find(table, row, system, model) if self.of_paper else None

    @property
    def axes(self) -> list[Axes]:
        """The plan's variants without their seeds."""
        return list(dict.fromkeys((v.encoder, v.lora, v.opd) for v in self.params.plan.variants.values()))

    def variants(self, axes: Axes, touch: Touch = Touch.REAL) -> dict[int, str]:
        """Seed to key of the variants with these axes; empty where the plan has none."""
        return {
            v.seed: key
            for key, v in self.params.plan.variants.items()
            if (v.encoder, v.lora, v.opd) == axes and v.touch is touch
        }

    @property
    def test_objects(self) -> list[str]:
        """Objects with test videos, sorted."""
        return sorted({a.object_id for a in self.assignments if a.part == Part.TEST})


def read_inputs(params: Params, root: Path) -> Inputs:
    """Read what there is below `root`.

    Raises:
        UserError: where the videos, the split or the questions are missing, or a file is broken.
    """
    data = root / "data"
    catalogue = load_catalogue(root / params.data.catalogue)
    videos = read_table(data / "videos.parquet", Video)
    asked = {
        q.question_id: q for q in read_jsonl(data / "questions" / "evaluation.jsonl", Question) if q.part == Part.TEST
    }
    files = {key: data / "scores" / key / "scores.parquet" for key in params.plan.variants}
    audit, hard = data / "audit" / "audit.csv", data / STABILITY_FILE
    judged = {seed: data / "encoder" / str(seed) / "classifications.parquet" for seed in params.plan.encoder_seeds}
    return Inputs(
        params=params,
        catalogue=catalogue,
        videos=videos,
        assignments=read_table(data / "splits.parquet", Assignment),
        missing=assign(catalogue, videos, params.split).missing[Part.TEST],
        questions={name: q.task for name, q in asked.items()},
        scores={
            key: [s for s in read_table(file, Score) if s.question_id in asked]
            for key, file in files.items()
            if file.is_file()
        },
        described=_read_described(params, data / "answers", asked, catalogue),
        classifications={
            seed: [c for c in read_table(file, Classification) if c.part == Part.TEST]
            for seed, file in judged.items()
            if file.is_file()
        },
        findings=read_csv(audit, Finding) if audit.is_file() else (),
        hard_cases=read_csv(hard, StabilityRow) if hard.is_file() else (),
        gate=_read_gate(root / params.language.weights),
    )


def _read_described(
    params: Params, folder: Path, asked: Mapping[str, Question], catalogue: Catalogue
) -> dict[str, dict[str, bool | None]]:
    """Of the variants that were given the real touch; OPD questions have nothing but the description."""
    found = {}
    for key, variant in params.plan.variants.items():
        file = folder / key / "predictions.jsonl"
        if variant.touch is Touch.REAL and variant.opd is not Opd.NONE and file.is_file():
            found[key] = {
                said.question_id: described_right(asked[said.question_id], said, catalogue)
                for said in read_jsonl(file, Prediction)
                if said.question_id in asked and said.task is not Task.OPD
            }
    return found


def _read_gate(weights: Path) -> dict[Task, bool]:
    """What gate.csv beside the language model's folder says: a task passes where all its rows with a goal do.

    Rows "from" something else than descriptions in words ask more than the gate does and are left out here.

    The stage does not name the file to DVC, which would then make the stand-in anew with every report; it changes with
    the weights only, and those everything before the report depends on.
    """
    file = weights.parent / GATE_FILE
    passed: dict[Task, bool] = {}
    for row in read_csv(file, GateRow) if file.is_file() else ():
        if row.passed is not None and " from " not in row.task:
            task = Task(row.task.split()[0])
            passed[task] = passed.get(task, True) and row.passed
    return passed


def why_empty(inputs: Inputs, axes: Axes, task: Task) -> str:
    """Why a variant has no score in a task."""
    keys = inputs.variants(axes)
    if task is Task.OPD and axes[2] is Opd.NONE:
        return "OPD questions are not put to a system that never describes"
    if not keys:
        return f"variant not in the plan `{inputs.params.ablation.plan}`"
    absent = [key for key in keys.values() if key not in inputs.scores]
    if absent:
        return f"not graded yet: {', '.join(absent)}"
    if not inputs.test_objects:
        return no_test_videos(inputs)
    if inputs.params.questions.evaluation.by_task()[task] == 0:
        return f"questions.evaluation.{task.lower()} is 0"
    if task is Task.PSR and not inputs.catalogue.language.scenarios:
        return "properties.yaml lists no scenario"
    return f"the test objects with videos ({', '.join(inputs.test_objects)}) allow no {task} question"


def no_test_videos(inputs: Inputs) -> str:
    """The sentence for everything that wants test videos where there are none."""
    return f"no video of any test object: {', '.join(inputs.missing) or 'the split names none'}"
