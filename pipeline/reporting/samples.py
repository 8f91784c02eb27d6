"""Sample answers of the full system for the report: which ones a rule decides, never a person.

Pictures go with them only where the videos are scenes: frames of real videos are nobody's to publish here.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from pipeline.io import atomic, read_jsonl, write_json
from pipeline.sampling import sample_evaluation
from pipeline.plan import FULL
from pipeline.language.chat import TACTILE
from pipeline.records import WHOLE, Opd, Prediction, Question, Record, Score, Task
from pipeline.reporting.inputs import Inputs

FOLDER = "samples"
FILE = "samples.json"
RULE = (
    "Of each task the first right and the first wrong answer, by the question's id, of the full system under its first "
    "seed."
)
NO_PICTURES = "Frames of real videos are not published, so the questions stand here without them."
LARGEST = 72
"""Side of a frame in a strip, in pixels: what comes larger is made smaller."""
GAP = 2
"""White pixels between two frames."""


class SampleVideo(Record):
    """A video that a question is about."""

    name: str
    """As the question's text calls it here."""
    video_id: str
    object_id: str
    strip: str
    """File beside this one with the frames that the model was given; empty where there is none."""


class Sample(Record):
    """One question with the model's answer and the right one; a text a turn."""

    task: Task
    question_id: str
    right: bool
    asked: tuple[str, ...]
    answered: tuple[str, ...]
    reference: tuple[str, ...]
    expected: str
    predicted: str
    """What was read from the answer; empty where nothing could be."""
    truncated: bool
    tokens: int
    videos: tuple[SampleVideo, ...]


class SampleSheet(Record):
    """The content of samples.json."""

    variant: str
    """Key of the variant that answered; empty where none did."""
    rule: str
    note: str
    """Why there are no samples, or no pictures."""
    samples: tuple[Sample, ...]


def write_samples(inputs: Inputs, root: Path, folder: Path) -> None:
    """Write samples.json, and a strip of frames for each of its videos where they are scenes.

    Args:
        root: With data/; without questions, answers or frames there are no samples or no pictures, and a note says so.
        folder: Of the samples; strips of an earlier run are removed from it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("*.png"):
        old.unlink()
    key = inputs.variants(FULL).get(inputs.params.ablation.seeds[0], "")
    file = root / "data" / "answers" / key / "predictions.jsonl"
    if not key or not file.is_file() or key not in inputs.scores:
        sheet = SampleSheet(variant="", rule=RULE, note="The full system has not answered yet.", samples=())
    else:
        questions = read_jsonl(root / "data" / "questions" / "evaluation.jsonl", Question)
        samples = choose(questions, read_jsonl(file, Prediction), inputs.scores[key])
        sheet = SampleSheet(variant=key, rule=RULE, note="", samples=tuple(samples))
        if inputs.params.data.source != "scenes":
            sheet = sheet.model_copy(update={"note": NO_PICTURES})
        elif not (root / "data" / "frames").is_dir():
            sheet = sheet.model_copy(update={"note": "No frames are there any more to draw."})
        else:
            names = draw_strips(
                inputs, root / "data" / "frames", folder, {v.video_id for s in samples for v in s.videos}
            )
            sheet = sheet.model_copy(update={"samples": tuple(_with_strips(s, names) for s in samples)})
    write_json(folder / FILE, sheet.model_dump(mode="json"))


def choose(questions: Iterable[Question], predictions: Iterable[Prediction], scores: Iterable[Score]) -> list[Sample]:
    """What `RULE` says, in the order of the tasks, the right one first; a task may have only one of them, or none."""
    asked = {q.question_id: q for q in questions}
    said = {p.question_id: p for p in predictions}
    whole = sorted((s for s in scores if s.measure in WHOLE and s.question_id in said), key=lambda s: s.question_id)
    chosen = []
    for task in Task:
        for right in (True, False):
            score = next((s for s in whole if s.task is task and s.correct is right), None)
            if score is not None:
                chosen.append(_sample(asked[score.question_id], said[score.question_id], score))
    return chosen


def draw_strips(inputs: Inputs, source: Path, folder: Path, videos: Iterable[str]) -> dict[str, str]:
    """A picture of each video: the frames that the model was given, side by side. Returns file names by video."""
    import cv2
    import numpy as np

    from pipeline.videos.frames.store import FrameStore

    store = FrameStore(source, inputs.params.encoder.reference)
    side = min(LARGEST, store.size)
    names = {}
    for video in sorted(videos):
        shown = store.pictures(video, sample_evaluation(len(store.rows(video)), inputs.params.frames.per_video))
        strip = np.full((side, len(shown) * (side + GAP) - GAP, 3), 255, dtype=np.uint8)
        for place, frame in enumerate(shown):
            left = place * (side + GAP)
            strip[:, left : left + side] = cv2.resize(frame, (side, side), interpolation=cv2.INTER_AREA)
        names[video] = f"{video}.png"
        with atomic(folder / names[video]) as temporary:
            temporary.write_bytes(
                cv2.imencode(".png", strip[:, :, ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
            )
    return names


def _sample(question: Question, said: Prediction, score: Score) -> Sample:
    dialogue = question.dialogue(Opd.ALL)
    assert dialogue is not None, "the full system describes all, and every task can be asked so"
    names = [f"video {chr(ord('A') + place)}" for place in range(len(question.videos))]
    return Sample(
        task=question.task,
        question_id=question.question_id,
        right=score.correct,
        asked=_named([turn.user for turn in dialogue.turns], names),
        answered=said.outputs,
        reference=tuple(turn.assistant for turn in dialogue.turns),
        expected=score.expected,
        predicted=score.predicted,
        truncated=said.truncated,
        tokens=said.tokens,
        videos=tuple(
            SampleVideo(name=name, video_id=video, object_id=owner, strip="")
            for name, video, owner in zip(names, question.videos, question.objects, strict=True)
        ),
    )


def _named(texts: Sequence[str], names: Sequence[str]) -> tuple[str, ...]:
    """The texts with a name in brackets where the touch of a video goes, in the order of the question's videos."""
    waiting = iter(names)
    pieces = [text.split(TACTILE) for text in texts]
    return tuple("".join(p if i == 0 else f"[{next(waiting)}]{p}" for i, p in enumerate(parts)) for parts in pieces)


def _with_strips(sample: Sample, names: Mapping[str, str]) -> Sample:
    videos = tuple(v.model_copy(update={"strip": names[v.video_id]}) for v in sample.videos)
    return sample.model_copy(update={"videos": videos})
