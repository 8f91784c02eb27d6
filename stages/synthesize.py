"""Make the synthetic videos, where they are the source of the data; otherwise leave an empty folder."""

from pathlib import Path

from pipeline.core.io import write_csv
from pipeline.core.layout import SCENES_DIR
from pipeline.running.stage import stage
from pipeline.videos.catalogue import load_catalogue

if __name__ == "__main__":
    with stage("synthesize") as run:
        from pipeline.scenes.recipe import load_recipes
        from pipeline.scenes.video import SceneRow, share_as_labelled, synthesize

        folder, config = Path(run.params.data.catalogue), run.params.scenes
        catalogue = load_catalogue(folder)
        SCENES_DIR.mkdir(parents=True, exist_ok=True)
        rows = []
        if run.params.data.source == "scenes":
            rows = synthesize(load_recipes(folder, catalogue, config.seed), config, SCENES_DIR)
        write_csv(SCENES_DIR.with_name("scenes.csv"), SceneRow, rows)
        run.metrics["videos"] = len(rows)
        run.metrics["as_labelled"] = share_as_labelled(rows, catalogue) if rows else 0.0
