"""Let one variant answer the evaluation questions."""

import sys

from pipeline.io import read_jsonl, write_jsonl
from pipeline.language.input_ablation import feel
from pipeline.embeddings import EmbeddingStore
from pipeline.language.generate import Asking, answer
from pipeline.language.octopi import OctopiForCausalLM
from pipeline.records import Question, Touch
from pipeline.runtime import resolve_device
from pipeline.stage import DATA, stage


def main() -> None:
    key = sys.argv[1]
    with stage("answer", key) as run:
        params, variant = run.params, run.params.plan.variants[key]
        language = params.language
        store = EmbeddingStore(DATA / "embeddings" / variant.embeddings)
        model = OctopiForCausalLM.from_pretrained(
            variant.model_dir, base=language.weights, dtype=language.dtype, quantization=language.quantization
        )
        asking = Asking(
            system_prompt=language.system_prompt,
            per_video=0 if variant.touch is Touch.REMOVED else params.frames.per_video,
            max_new_tokens=language.max_new_tokens,
            batch_size=language.generation_batch_size,
        )
        questions = read_jsonl(DATA / "questions" / "evaluation.jsonl", Question)
        felt = feel(store, variant.touch, questions, variant.seed)
        predictions = answer(model.to(resolve_device(params.runtime.device)), felt, questions, variant.opd, asking)
        write_jsonl(DATA / "answers" / key / "predictions.jsonl", predictions)
        run.metrics["answers"] = len(predictions)
        run.metrics["tokens"] = sum(p.tokens for p in predictions)
        run.metrics["truncated"] = sum(p.truncated for p in predictions)


if __name__ == "__main__":
    main()
