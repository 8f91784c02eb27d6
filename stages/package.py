"""Put each full system, or with `packaged=all` each variant, into one folder that it can be used from."""

from pathlib import Path

from pipeline.core.layout import MODELS
from pipeline.running.stage import stage

if __name__ == "__main__":
    with stage("package") as run:
        from pipeline.use.folder import Base
        from pipeline.use.package import package

        params = run.params
        base = Base.of(Path(params.language.weights))
        wanted = [v for v in params.ablation.variants() if v.full or params.packaged == "all"]
        for variant in wanted:
            package(params, variant, base, MODELS / variant.key)
        run.metrics["models"] = len(wanted)
