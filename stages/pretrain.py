"""Pretrain the backbone `scenes` on pictures of invented objects, where the encoder has it."""

from pipeline.core.io import write_table
from pipeline.core.layout import HISTORY_FILE, PRETRAINED
from pipeline.core.records import Measurement
from pipeline.running.stage import stage
from pipeline.tracking.live import live

if __name__ == "__main__":
    with stage("pretrain") as run:
        params = run.params
        history: list[Measurement] = []
        if "scenes" in params.encoder.backbone:
            # Imported here, since most runs need no torch.
            from pipeline.encoder.pretrain import pretrain
            from pipeline.training.trainable import save_trainable

            with live(run) as callbacks:
                encoder, history = pretrain(params.pretrain, params.frames, params.runtime, callbacks)
            save_trainable(encoder, PRETRAINED)
            run.finish_training(history)
        write_table(PRETRAINED.with_name(HISTORY_FILE), Measurement, history)
