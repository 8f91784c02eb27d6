"""Make the synthetic videos."""

from pathlib import Path

from pipeline.io import write_csv
from pipeline.videos.catalogue import load_catalogue
from pipeline.scenes.recipe import load_recipes
from pipeline.scenes.video import SceneRow, share_as_labelled, synthesize
from pipeline.config import SCENES_DIR
from pipeline.stage import stage


def main() -> None:
    with stage("synthesize", "scenes") as run:
        folder, config = Path(run.params.data.catalogue), run.params.scenes
        catalogue = load_catalogue(folder)
        rows = synthesize(load_recipes(folder, catalogue, config.seed), config, SCENES_DIR)
        write_csv(SCENES_DIR.with_name("scenes.csv"), SceneRow, rows)
        run.metrics["videos"] = len(rows)
        run.metrics["as_labelled"] = share_as_labelled(rows, catalogue)


if __name__ == "__main__":
    main()
