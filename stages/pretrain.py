"""Pretrain the strong recipe's encoder on pictures of invented objects."""

import sys
from pathlib import Path

from pipeline.io import write_table
from pipeline.trainable import save_trainable
from pipeline.records import Measurement
from pipeline.stage import DATA, stage
from pipeline.tracking import live_run
from pipeline.encoder.pretrain import pretrain


def main() -> None:
    key = sys.argv[1]
    with stage("pretrain", key) as run:
        params = run.params
        with live_run(params, run.name, Path()) as live:
            encoder, history = pretrain(params.pretrain, params.frames, params.runtime, live.log)
        out = DATA / "pretrained" / key
        save_trainable(encoder, out / "encoder.safetensors")
        write_table(out / "history.parquet", Measurement, history)
        run.finish_training(history)


if __name__ == "__main__":
    main()
