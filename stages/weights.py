"""Make the base models that params.yaml names below data/weights/; what the user downloads lies elsewhere."""

from pathlib import Path

from pipeline.running.stage import stage
from pipeline.weights import MADE_DIR, made
from pipeline.weights.make import make

if __name__ == "__main__":
    with stage("weights") as run:
        params = run.params
        MADE_DIR.mkdir(parents=True, exist_ok=True)
        folders = {Path(f) for f in (params.encoder.weights, params.language.weights)}
        names = sorted(name for folder in folders if (name := made(folder)))
        for name in names:
            make(name, MADE_DIR / name, seed=params.seed, catalogue=Path(params.data.catalogue))
        run.metrics["made"] = len(names)
