"""Cross-validate the encoder, frozen or tuned, or a constant over all objects with videos."""

from pathlib import Path

from pipeline.core.io import read_table, write_table
from pipeline.core.records import OutOfFold, Video
from pipeline.core.stage import DATA, matrix_key, stage
from pipeline.encoder.cross_validation import MODELS, CrossValidationData, cross_validate_model
from pipeline.videos.catalogue import load_catalogue
from pipeline.weights import check_encoder


def main() -> None:
    (name,) = matrix_key(model=MODELS)
    with stage("cross_validate", name) as run:
        params = run.params
        check_encoder(Path(params.encoder.weights), params.frames.pixels, params.encoder.backbone)
        catalogue = load_catalogue(Path(params.data.catalogue))
        data = CrossValidationData(
            videos=read_table(DATA / "videos.parquet", Video),
            catalogue=catalogue,
            frames=DATA / "frames",
            per_video=params.frames.per_video,
            encoder=params.encoder,
            runtime=params.runtime,
        )
        predictions = cross_validate_model(name, data, params.cross_validation)
        write_table(DATA / "cross_validation" / name / "out_of_fold.parquet", OutOfFold, predictions)
        right = [p.expected == p.predicted for p in predictions]
        run.metrics["combined.accuracy"] = sum(right) / len(right)


if __name__ == "__main__":
    main()
