"""Ask trained models about this run's videos, whose objects are new to them."""

from collections import Counter
from itertools import product
from pathlib import Path

from pipeline.core.io import code_of, fingerprint, read_table, write_table
from pipeline.core.layout import CHECKPOINTS, EVALUATED, SHIPPED, VIDEOS, split_file
from pipeline.core.runtime import limit_threads
from pipeline.evaluation.records import GradedVision, Shown
from pipeline.running.errors import UserError
from pipeline.running.stage import stage
from pipeline.videos.records import Assignment, Video

if __name__ == "__main__":
    with stage("evaluate") as run:
        from pipeline.use.evaluate import answers_about, answers_after_ratings, check_rated
        from pipeline.use.folder import read_folder
        from pipeline.use.model import Octopi

        params, graded = run.params, list[GradedVision]()
        names = [f if f == SHIPPED.name else read_folder(Path(f))[0].variant for f in params.evaluate.models]
        if several := [name for name, count in Counter(names).items() if count > 1]:
            raise UserError(f"evaluate.models has two models that are called {several[0]}; name one of them")
        if params.evaluate.models:
            # As many on every machine, since sums depend on how they are shared out.
            limit_threads(2)
        # With folds each object is a test object of one of them.
        splits = {seed: read_table(split_file(seed), Assignment) for seed in params.ablation.seeds}
        check_rated(params.evaluate.rated, splits)
        assigned = sorted((a for split in splits.values() for a in split), key=lambda a: a.part == "test")
        parts, videos = {a.object_id: a.part for a in assigned}, read_table(VIDEOS, Video)
        for folder in params.evaluate.models:
            place = SHIPPED if folder == SHIPPED.name else folder
            # Half precision on one processor and not on another would make the report depend on the machine.
            octopi = Octopi.from_pretrained(place, device=params.runtime.device, dtype=params.language.dtype)
            graded += answers_about(octopi, params, videos, parts)
            for count, (seed, split) in product(params.evaluate.rated, splits.items()):
                # A killed stage goes on behind what is answered; the key is all that this depends on, code included.
                told = (octopi.config.digest, params.questions, params.data, params.split, params.language.dtype)
                files = (VIDEOS, split_file(seed), Path(params.data.catalogue), *code_of("evaluate"))
                key = fingerprint(*map(str, (*told, params.kernels, count, seed)), *files)
                if not (done := CHECKPOINTS / "evaluate" / key / EVALUATED.name).is_file():
                    said = answers_after_ratings(octopi, params, videos, split, seed, count)
                    write_table(done, GradedVision, said)
                graded += read_table(done, GradedVision)
        run.metrics["answers"] = len(
            {(g.model, g.shown, g.question_id) for g in graded if g.shown is not Shown.CLASSES}
        )
        write_table(EVALUATED, GradedVision, graded)
