"""Pretrain the backbone `scenes` on pictures of invented objects, where the encoder has it."""

from pipeline.config import PRETRAINED
from pipeline.core.io import write_table
from pipeline.core.records import Measurement
from pipeline.core.stage import DATA, stage
from pipeline.tracking.live import live


def main() -> None:
    with stage("pretrain") as run:
        params = run.params
        out = DATA / "pretrained"
        if "scenes" not in params.encoder.backbone:
            write_table(out / "history.parquet", Measurement, [])
            return
        # Imported here, since most runs end above and need no torch.
        from pipeline.encoder.pretrain import pretrain
        from pipeline.training.trainable import save_trainable

        with live(run) as callbacks:
            encoder, history = pretrain(params.pretrain, params.frames, params.runtime, callbacks)
        save_trainable(encoder, PRETRAINED)
        write_table(out / "history.parquet", Measurement, history)
        run.finish_training(history)


if __name__ == "__main__":
    main()
