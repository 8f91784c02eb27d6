"""Make the synthetic videos."""

from pathlib import Path

from pipeline.physiclear.catalogue import load_catalogue
from pipeline.scenes.video import synthesize
from pipeline.sections import SCENES_DIR
from pipeline.stage import stage


def main() -> None:
    with stage("synthesize", "scenes") as run:
        catalogue = load_catalogue(Path(run.params.data.catalogue))
        run.metrics["videos"] = len(synthesize(catalogue, run.params.scenes, SCENES_DIR))


if __name__ == "__main__":
    main()
