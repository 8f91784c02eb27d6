"""Grade the answers of all variants, each task by its own grader."""

from pathlib import Path

from pipeline.core.io import read_jsonl, write_table
from pipeline.core.layout import EXTERNAL, GRADED, GRADED_VISION, answers_dir, questions_file
from pipeline.core.records import Prediction, Question
from pipeline.evaluation.records import Graded, GradedVision
from pipeline.running.stage import stage
from pipeline.videos.catalogue import load_catalogue

if __name__ == "__main__":
    with stage("grade") as run:
        from pipeline.evaluation.grading import grade, grade_vision_models
        from pipeline.videos.frames.store import frames_key

        catalogue = load_catalogue(Path(run.params.data.catalogue)).called(run.params.questions.names)
        graded = []
        for variant in run.params.ablation.variants():
            questions = read_jsonl(questions_file(variant.seed), Question)
            replicate = run.params.split.replicate_of(variant.seed)
            for touch in run.params.ablation.touches(variant):
                predictions = read_jsonl(answers_dir(variant) / f"{touch}.jsonl", Prediction)
                whose = {**variant._asdict(), "seed": replicate, "trained": variant.seed, "touch": touch}
                graded += [Graded(**score.model_dump(), **whose) for score in grade(questions, predictions, catalogue)]
        write_table(GRADED, Graded, graded)
        files = {s: questions_file(s) for s in run.params.ablation.seeds}
        outside = EXTERNAL / run.params.report_name
        replicate_of, per_video = run.params.split.replicate_of, run.params.frames.per_video
        seen = grade_vision_models(outside, files, replicate_of, catalogue, lambda f: (frames_key(f), per_video))
        write_table(GRADED_VISION, GradedVision, seen)
        run.metrics["answers"] = len({(g.variant, g.touch, g.question_id) for g in graded})
