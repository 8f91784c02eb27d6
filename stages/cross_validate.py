"""Cross-validate the encoder, frozen or tuned, or a constant over all objects with videos."""

import re
import sys
from pathlib import Path

from pipeline.config import COMPARED
from pipeline.core.io import read_table, write_table
from pipeline.core.records import Assignment, OutOfFold, Part, Video
from pipeline.core.stage import DATA, matrix_key, stage
from pipeline.videos.catalogue import load_catalogue
from pipeline.weights import backbone_files, check_encoder

if __name__ == "__main__":
    (name,) = matrix_key(model=[word for word in sys.argv[1:] if re.fullmatch(COMPARED, word)])
    with stage("cross_validate", name) as run:
        from pipeline.encoder.cross_validation import cross_validate_model
        from pipeline.encoder.data import EncoderData
        from pipeline.encoder.finetune import Training
        from pipeline.videos.frames.store import REFERENCES_FILE, TABLE_FILE, FrameStore

        params = run.params
        check_encoder(Path(params.encoder.weights), params.frames.pixels, params.encoder.backbone)
        videos = read_table(DATA / "videos.parquet", Video)
        data = EncoderData(
            store=FrameStore(DATA / "frames", params.encoder.reference),
            catalogue=load_catalogue(Path(params.data.catalogue)),
            assignments=[Assignment(video_id=v.video_id, object_id=v.object_id, part=Part.UNUSED) for v in videos],
            per_video=params.frames.per_video,
        )
        inputs = [DATA / "frames" / file for file in (TABLE_FILE, REFERENCES_FILE)] + backbone_files(params.encoder)
        training = Training(data, params.encoder, params.runtime, params.cross_validation.seed, inputs)
        predictions = cross_validate_model(name, training, params.cross_validation)
        write_table(DATA / "cross_validation" / name / "out_of_fold.parquet", OutOfFold, predictions)
        right = [p.expected == p.predicted for p in predictions]
        if right:  # Of a model that asks for more objects than there are, nothing is predicted.
            run.metrics["combined.accuracy"] = sum(right) / len(right)
