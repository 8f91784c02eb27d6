"""Let one variant answer the evaluation questions; the full system also under every input ablation."""

from dataclasses import replace

from pipeline.core.io import read_jsonl, write_jsonl
from pipeline.core.layout import answers_dir, embeddings_dir, questions_file, trained_dir
from pipeline.core.records import Encoder, Lora, Opd, Question, TouchInput, Variant
from pipeline.core.runtime import name_dtype
from pipeline.running.parallel import device_here
from pipeline.running.stage import matrix_key, stage

if __name__ == "__main__":
    variant = Variant(*matrix_key(encoder=Encoder, lora=Lora, opd=Opd, seed=None))
    with stage("answer", variant.key, of_variants=True) as run:
        from pipeline.language.generate import ModelSource, answer
        from pipeline.language.input_ablation import ablate_input
        from pipeline.training.embeddings import EmbeddingStore

        params, language = run.params, run.params.language
        store = EmbeddingStore(embeddings_dir(variant.encoder, variant.seed))
        folder = trained_dir(variant)
        dtype = name_dtype(language.dtype, params.runtime.device)
        device = params.runtime.device
        source = ModelSource(folder, language.weights, dtype, language.quantization, device, run.started)
        model = replace(source, device=device_here(device))()
        questions = read_jsonl(questions_file(variant.seed), Question)
        per_video = params.frames.per_video
        for touch in params.ablation.touches(variant):
            given, shown = ablate_input(store, touch, questions, variant.seed)
            predictions = answer(model, given, shown, variant.opd, language, per_video, source)
            write_jsonl(answers_dir(variant) / f"{touch}.jsonl", predictions)
            run.metrics[f"{touch}.answers"] = len(predictions)
            run.metrics[f"{touch}.tokens"] = sum(p.tokens for p in predictions)
            run.metrics[f"{touch}.truncated"] = sum(p.truncated for p in predictions)
            if variant.full and touch is TouchInput.REAL:
                examples = read_jsonl(questions_file(variant.seed, "examples"), Question)
                told = answer(model, store, examples, variant.opd, language, per_video, source)
                write_jsonl(answers_dir(variant) / "examples.jsonl", told)
