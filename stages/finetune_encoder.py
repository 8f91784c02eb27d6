"""Fine-tune the encoder on property classification."""

from pathlib import Path

from pipeline.core.io import read_table, write_table
from pipeline.core.layout import CLASSIFIED_FILE, FRAMES, HISTORY_FILE, TRAINED_FILE, encoder_dir, split_file
from pipeline.core.records import Measurement, Part
from pipeline.core.runtime import resolve_device
from pipeline.encoder.records import Classification
from pipeline.running.stage import matrix_key, stage
from pipeline.tracking.live import live
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Assignment
from pipeline.weights.backbones import backbone_files, check_encoder

if __name__ == "__main__":
    (seed,) = matrix_key(seed=None)
    with stage("finetune_encoder", str(seed), of_variants=True) as run:
        from pipeline.encoder.data import EncoderData, classify
        from pipeline.encoder.finetune import Training, finetune, write_encoder_card
        from pipeline.training.trainable import save_trainable
        from pipeline.videos.frames.store import REFERENCES_FILE, TABLE_FILE, FrameStore

        params = run.params
        check_encoder(Path(params.encoder.weights), params.frames.pixels, params.encoder.backbone)
        data = EncoderData(
            store=FrameStore(FRAMES, params.encoder.reference),
            catalogue=load_catalogue(Path(params.data.catalogue)),
            assignments=read_table(split_file(seed), Assignment),
            per_video=params.frames.per_video,
        )
        inputs = [FRAMES / TABLE_FILE, FRAMES / REFERENCES_FILE, split_file(seed)]
        inputs += backbone_files(params.encoder)
        with live(run) as callbacks:
            training = Training(data, params.encoder, params.runtime, params.seed + seed, inputs, run.name, callbacks)
            model, history = finetune(training)
        device = resolve_device(params.runtime.device)
        classified = classify(model, data, [Part.VALIDATION, Part.TEST], params.encoder.batch_size, device)
        out = encoder_dir(seed)
        save_trainable(model, out / TRAINED_FILE)
        write_table(out / HISTORY_FILE, Measurement, history)
        write_table(out / CLASSIFIED_FILE, Classification, classified)
        write_encoder_card(out, data, params.encoder, params.seed + seed, params.data.source)
        run.finish_training(history)
        for part in (Part.VALIDATION, Part.TEST):
            chosen = [c for c in classified if c.part == part]
            for name in dict.fromkeys(c.property for c in chosen):
                right = [c.expected == c.predicted for c in chosen if c.property == name]
                run.metrics[f"{part}.{name}.accuracy"] = sum(right) / len(right)
