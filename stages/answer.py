"""Let one variant answer the evaluation questions; the full system also under every input ablation."""

from dataclasses import replace
from pathlib import Path

from pipeline.embeddings import EmbeddingStore
from pipeline.evaluation.grading import described
from pipeline.io import read_jsonl, write_csv, write_jsonl
from pipeline.language.generate import ModelSource, answer
from pipeline.language.input_ablation import ablate_input
from pipeline.parallel import device_here
from pipeline.records import GATE, Described, Encoder, Lora, Opd, Question, Touch, Variant
from pipeline.runtime import name_dtype
from pipeline.stage import DATA, matrix_key, stage
from pipeline.tasks import TASKS
from pipeline.tasks.told import in_words
from pipeline.videos.catalogue import load_catalogue


def main() -> None:
    variant = Variant(*matrix_key(encoder=Encoder, lora=Lora, opd=Opd, seed=None))
    with stage("answer", variant.key) as run:
        params, language = run.params, run.params.language
        store = EmbeddingStore(DATA / "embeddings" / f"{variant.encoder}-{variant.seed}")
        folder = DATA / "models" / variant.lora / f"{variant.encoder}-{variant.opd}-{variant.seed}"
        dtype = name_dtype(language.dtype, params.runtime.device)
        device = params.runtime.device
        source = ModelSource(folder, language.weights, dtype, language.quantization, device, run.started)
        model = replace(source, device=device_here(device))()
        asked = DATA / "questions" / str(variant.seed)
        questions = read_jsonl(asked / "evaluation.jsonl", Question)
        for touch in (Touch.REAL, *(params.ablation.touch if variant.full else ())):
            per_video = 0 if touch is Touch.REMOVED else params.frames.per_video
            given = ablate_input(store, touch, questions, variant.seed)
            predictions = answer(model, given, questions, variant.opd, language, per_video, source)
            write_jsonl(DATA / "answers" / variant.key / f"{touch}.jsonl", predictions)
            run.metrics[f"{touch}.answers"] = len(predictions)
            run.metrics[f"{touch}.tokens"] = sum(p.tokens for p in predictions)
            run.metrics[f"{touch}.truncated"] = sum(p.truncated for p in predictions)
            if variant.full and touch is Touch.REAL:
                examples = read_jsonl(asked / "examples.jsonl", Question)
                shown = answer(model, store, examples, variant.opd, language, per_video, source)
                write_jsonl(DATA / "answers" / variant.key / "examples.jsonl", shown)
        if variant.full and params.teach.samples:
            # What it concludes where it need not feel: its own questions, with the true classes in words.
            catalogue = load_catalogue(Path(params.data.catalogue))
            several = [q for q in questions if len(q.videos) > 1]
            asked_of = [[q for q in several if q.task == task][: params.teach.gate_questions] for task in TASKS]
            told = [in_words(q, q.gold.labels, catalogue) for own in asked_of for q in own]
            said = answer(model, store, told, variant.opd, language, 0, source)
            scores = described(f"with LoRA, seed {variant.seed}", told, said, catalogue)
            write_csv(DATA / "answers" / variant.key / GATE, Described, scores)


if __name__ == "__main__":
    main()
