"""Ask the model that is shipped about this run's videos, all of which are new to it."""

from pathlib import Path

import torch

from pipeline.core.embeddings import EmbeddingStore
from pipeline.core.errors import UserError
from pipeline.core.io import read_table, write_table
from pipeline.core.records import Classification, GradedVision, Part, Shown, Video
from pipeline.core.runtime import limit_threads, track
from pipeline.core.stage import DATA, stage
from pipeline.evaluation.grading import conclude, grade
from pipeline.language.generate import answer
from pipeline.tasks.base import Pool
from pipeline.tasks.questions import build_questions, counts_by_task
from pipeline.use.folder import SHIPPED
from pipeline.use.model import Octopi
from pipeline.videos.catalogue import load_catalogue

BATCH = 64
"""Answers at once: a gigabyte of keys and values."""


def main() -> None:
    with stage("shipped") as run:
        params, graded = run.params, list[GradedVision]()
        if params.shipped:
            # As many on every machine, since sums depend on how they are shared out.
            limit_threads(2)
            # Half precision on one processor and not on another would make the report depend on the machine.
            octopi = Octopi.from_pretrained(SHIPPED, device=params.runtime.device, dtype="float32")
            catalogue = load_catalogue(Path(params.data.catalogue)).asking(params.questions.scenarios)
            catalogue = catalogue.called("number" if octopi.numbered else "catalogue")
            videos = read_table(DATA / "videos.parquet", Video)
            of_object: dict[str, list[str]] = {}
            for video in videos:
                of_object.setdefault(video.object_id, []).append(video.video_id)
            if met := sorted(octopi.catalogue.objects.keys() & of_object.keys()):
                raise UserError(f"{SHIPPED.name} knows {met[0]}, so it is not asked; set shipped to 0 in params.yaml")
            classified: list[Classification] = []
            rows, embedded = dict[str, range](), [torch.zeros(0, octopi.llm.octopi_config.tactile_dim)]
            for video in track(videos, "touches", "video"):
                file = Path(params.data.dir) / video.path
                embedded.append(octopi.encoder.encode(file).features)
                rows[video.video_id] = range(sum(map(len, embedded[:-1])), sum(map(len, embedded)))
                known = {"video_id": video.video_id, "object_id": video.object_id, "part": Part.TEST}
                found = zip(catalogue.labels(video.object_id), *octopi.encoder.classify(file), strict=True)
                for name, (label, probabilities, level) in zip(catalogue.property_names, found, strict=True):
                    taken = {"expected": label, "predicted": level, "probabilities": probabilities}
                    classified.append(Classification(**known, property=name, **taken))
            # Half of them describe: those answers are short, and the others follow from what they say.
            asked = {task: count for task, count in counts_by_task(params.questions, "evaluation").items() if count}
            parts = {task: max(1, len(asked) - 1) if task == "OPD" else 1 for task in asked}
            questions = build_questions(
                Pool(Part.TEST, catalogue, of_object),
                {task: params.shipped * part // sum(parts.values()) for task, part in parts.items()},
                seed=params.questions.seed,
                distinct=True,
                facts=octopi.config.facts,
            )
            ways, config = {Shown.TOUCH: torch.cat(embedded)}, octopi.config
            # A processor reads all weights for each token of a batch, however many answers are in it.
            language = config.language.model_copy(update={"generation_batch_size": BATCH})
            if params.data.source == "videos":
                # Another sensor shifts and scales embeddings; its videos tell by how much, without a label.
                std, mean = torch.std_mean(ways[Shown.TOUCH], dim=0)
                ways[Shown.STANDARDISED] = (ways[Shown.TOUCH] - mean) / std.clamp_min(1e-6)
            scored = {}
            for shown, features in ways.items():
                store = EmbeddingStore().with_rows(rows, features)
                said = answer(octopi.llm, store, questions, config.opd, language, config.frames.per_video)
                scored[shown] = grade(questions, said, catalogue)
            scored[Shown.CLASSES] = conclude(questions, classified, catalogue)
            graded = [
                GradedVision(**score.model_dump(), model=SHIPPED.name, shown=shown, seed=params.ablation.seeds[0])
                for shown, scores in scored.items()
                for score in scores
            ]
            run.metrics["answers"] = len(ways) * len(questions)
        write_table(DATA / "shipped.parquet", GradedVision, graded)


if __name__ == "__main__":
    main()
