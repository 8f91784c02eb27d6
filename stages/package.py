"""Put each full system, or with `packaged=all` each variant, into one folder that it can be used from."""

import shutil
from itertools import product
from pathlib import Path

from pipeline.core.layout import MODELS
from pipeline.core.records import Encoder, Lora, Opd
from pipeline.running.stage import stage

if __name__ == "__main__":
    with stage("package") as run:
        from pipeline.use.folder import Base
        from pipeline.use.package import package

        params = run.params
        MODELS.mkdir(exist_ok=True)
        base = Base.of(Path(params.language.weights))
        wanted = [v for v in params.ablation.variants() if v.full or params.packaged == "all"]
        # DVC leaves the folder as it is, since models that no run made lie there, too.
        own = {"-".join(kind) for kind in product(Encoder, Lora, Opd)}
        for folder in MODELS.iterdir():
            kind, _, seed = folder.name.rpartition("-")
            if kind in own and seed.isdigit() and folder.name not in {v.key for v in wanted}:
                shutil.rmtree(folder)
        for variant in wanted:
            package(params, variant, base, MODELS / variant.key)
        run.metrics["models"] = len(wanted)
