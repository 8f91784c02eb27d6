"""Ask the model that is shipped about this run's videos, all of which are new to it."""

from pipeline.core.io import read_table, write_table
from pipeline.core.layout import GRADED_SHIPPED, VIDEOS
from pipeline.core.runtime import limit_threads
from pipeline.evaluation.records import GradedVision, Shown
from pipeline.running.stage import stage
from pipeline.videos.records import Video

if __name__ == "__main__":
    with stage("shipped") as run:
        from pipeline.use.folder import SHIPPED
        from pipeline.use.model import Octopi
        from pipeline.use.shipped import answers_about

        graded: list[GradedVision] = []
        if run.params.shipped:
            # As many on every machine, since sums depend on how they are shared out.
            limit_threads(2)
            # Half precision on one processor and not on another would make the report depend on the machine.
            octopi = Octopi.from_pretrained(SHIPPED, device=run.params.runtime.device, dtype="float32")
            graded = answers_about(octopi, run.params, read_table(VIDEOS, Video))
            run.metrics["answers"] = len({(g.shown, g.question_id) for g in graded if g.shown is not Shown.CLASSES})
        write_table(GRADED_SHIPPED, GradedVision, graded)
