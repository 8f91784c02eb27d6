"""The chain in small, by its libraries: videos, an encoder, a language model and their stored answers."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pipeline.config import Params
from pipeline.core import records
from pipeline.core.io import fingerprint, save_tensors, write_json, write_jsonl, write_table
from pipeline.core.records import Embedding, Encoder, Lora, Opd, Part, Prediction, Question, TouchInput, Variant
from pipeline.core.runtime import seed_everything
from pipeline.encoder.data import EncoderData, classify
from pipeline.encoder.embed import Loaded, embed_videos, standardize, statistics
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.encoder.records import Classification
from pipeline.evaluation.grading import grade
from pipeline.evaluation.records import Graded
from pipeline.language.generate import answer
from pipeline.language.lora import add_lora
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.language.start import OBJECTS_FILE, objects_met
from pipeline.tasks.questions import build_questions, pool_of
from pipeline.training.embeddings import STATISTICS_FILE, EmbeddingStore
from pipeline.training.trainable import save_trainable
from pipeline.use.folder import Base
from pipeline.use.model import Octopi
from pipeline.use.package import package
from pipeline.use.results import Exchange
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import PROBES_FILE, FrameStore
from pipeline.videos.records import Assignment, Probe
from tests.checkpoints import write_llama
from tests.conftest import moving_square, write_video
from tests.encoders import write_pretrained, write_timm, write_tower
from tests.fake_run import fake_params

PARTS = {
    **dict.fromkeys(("baseball", "rug", "pillow", "potato"), Part.TRAIN),
    **dict.fromkeys(("cotton_ball", "denim"), Part.VALIDATION),
    **dict.fromkeys(("ice_block", "millet", "bath_towel", "toilet_brush_bristles", "hairbrush_bristles"), Part.TEST),
}
CPU = torch.device("cpu")
ASKED = {"OPD": 8, "PC": 12, "PSS": 12, "POM": 12, "PSR": 8}


class Made(NamedTuple):
    """A trained model in its folder, and what the evaluation stored of it."""

    folder: Path
    videos: Path
    questions: list[Question]
    predictions: list[Prediction]
    classified: list[Classification]
    params: Params
    variant: Variant


def make(where: Path, variant: Variant, *overrides: str) -> Made:
    """Run what the stages run, in `where` as the working directory, down to `package`."""
    params = fake_params(
        *("frames.pixels=32", "frames.per_video=3", "language.max_new_tokens=12", "language.generation_batch_size=8"),
        *("encoder.weights=clip", "language.weights=llama", "encoder.prompts=3", *overrides),
    )
    catalogue = load_catalogue(Path(params.data.catalogue))
    videos, data = where / "videos", where / "data"
    for seed, object_id in enumerate(PARTS):
        for number in range(2):
            frames = moving_square(14 + seed + 5 * number, 10 * seed + number)
            frames[:2] = [np.full_like(frames[0], 90)] * 2
            write_video(videos / f"{object_id}_{number}.avi", frames)
    found = extract_frames(videos, catalogue, params.frames, data / "frames", where / "checkpoints")
    write_table(data / "frames" / PROBES_FILE, Probe, found.probes)
    parts = [Assignment(video_id=v.video_id, object_id=v.object_id, part=PARTS[v.object_id]) for v in found.videos]
    write_table(data / "splits" / "0.parquet", Assignment, parts)

    write_timm(Path("clip")) if "timm" in params.encoder.backbone else write_tower(Path("clip"))
    write_pretrained()
    seed_everything(2)
    classifier = property_classifier(params.encoder, [len(p.levels) for p in catalogue.properties])
    with torch.no_grad():
        for name, value in classifier.named_parameters():
            if name.startswith("heads."):
                value.copy_(torch.randn(value.shape))
    save_trainable(classifier, data / "encoder" / "0" / "encoder.safetensors")
    store = FrameStore(data / "frames", params.encoder.reference)
    material = EncoderData(store, catalogue, parts, params.frames.per_video)
    classified = classify(classifier, material, [Part.VALIDATION, Part.TEST], 4, CPU)
    write_table(data / "encoder" / "0" / "classifications.parquet", Classification, classified)

    encoder = classifier.encoder if variant.encoder is Encoder.FINETUNED else base_encoder(params.encoder)
    raw, index = embed_videos(Loaded(encoder.eval(), store, CPU, 16), parts)
    known = statistics(raw, index, {a.video_id for a in parts if a.part is Part.TRAIN})
    folder = data / "embeddings" / f"{variant.encoder}-0"
    save_tensors(
        folder / records.TENSOR_FILE, {records.TENSOR: standardize(raw, known) if params.encoder.standardize else raw}
    )
    write_table(folder / records.INDEX_FILE, Embedding, index)
    known._replace(frames=fingerprint(params.frames)).save(folder / STATISTICS_FILE)
    embeddings = EmbeddingStore(folder)

    write_llama(Path("llama"))
    model = OctopiForCausalLM.from_base("llama", embeddings.dim)
    if params.align.train_embeddings == "all":
        model.train_words()
    if variant.lora is Lora.WITH:
        add_lora(model, params.lora)
    draw = torch.Generator().manual_seed(3)
    with torch.no_grad():  # Strong enough that answers hang on what is touched.
        for name, value in model.named_parameters():
            if name.startswith(("connector.", "words.")) or "lora_" in name:
                strength = {"llm": 0.3, "words": 0.1, "connector": 1}[name.split(".")[0]]
                value.copy_(torch.randn(value.shape, generator=draw) * strength)
    key = f"{variant.encoder}-{variant.opd}-0"
    trained, aligned = (data / "models" / lora / key for lora in (variant.lora, Lora.WITHOUT))
    model.save_pretrained(trained)
    write_json(aligned / OBJECTS_FILE, objects_met("", PARTS))
    questions = build_questions(pool_of(Part.TEST, parts, catalogue), ASKED, seed=0, distinct=False, facts=True)
    predictions = answer(model.eval(), embeddings, questions, variant.opd, params.language, params.frames.per_video)
    write_jsonl(data / "answers" / variant.key / "real.jsonl", predictions)
    write_jsonl(data / "questions" / "0" / "evaluation.jsonl", questions)
    graded = [
        Graded(**{**score.model_dump(), "correct": right}, **variant._asdict(), trained=fold, touch=TouchInput.REAL)
        for score in grade(questions, predictions, catalogue)
        # Another fold's model, whose answers are all right, is pooled under the same seed, and is not packaged.
        for fold, right in ((0, score.correct), (1, True))
    ]
    write_table(data / "graded.parquet", Graded, graded)
    report = where / "reports" / params.report_name
    write_json(report / "provenance.json", {"settings": "Looked at before."})
    out = where / "models" / variant.key
    package(params, variant, Base.of(Path("llama")), out)
    return Made(out, videos, questions, predictions, classified, params, variant)


def configured(model: Octopi, made: Made, **changes: object) -> Octopi:
    """The same weights under another configuration."""
    config = model.config.model_copy(update=changes)
    return Octopi(made.folder, config, model.catalogue, model.llm, model.encoder.device)


def replay(
    model: Octopi, questions: Sequence[Question], predictions: Sequence[Prediction], opd: Opd, files: Mapping[str, Path]
) -> int:
    """Ask the evaluation's questions turn by turn, from the files, and count them: answers must be the stored ones."""
    asked = {q.question_id: q for q in questions}
    said = set()
    for prediction in predictions:
        question, history = asked[prediction.question_id], []
        videos = iter(question.videos)
        turns = question.dialogue(opd).turns
        for turn, stored in zip(turns, prediction.outputs, strict=True):
            known = {"history": history, "more": len(turns) > 1}
            shown = tuple(files[next(videos)] for _ in range(turn.user.count("{tactile}")))
            answer = model.ask(turn.user, shown, **known)
            assert answer == stored, question.question_id
            assert "".join(model.stream(turn.user, shown, **known)) == stored
            history.append(Exchange(turn.user, shown, answer))
            said.add(answer)
    assert len(said) >= 5, "answers hang on what is asked and touched"
    return len(predictions)
