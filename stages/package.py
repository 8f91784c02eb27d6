"""Put each variant that answers into one folder that it can be used from."""

from pathlib import Path

from pipeline.stage import DATA, stage
from pipeline.use.package import describe_base, package

MODELS = Path("models")


def main() -> None:
    with stage("package") as run:
        params = run.params
        base = describe_base(Path(params.language.weights))
        for variant in params.ablation.variants():
            package(DATA, params, variant, base, MODELS / variant.key)
        run.metrics["models"] = len(params.ablation.variants())


if __name__ == "__main__":
    main()
