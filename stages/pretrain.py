"""Pretrain the backbone `scenes` on pictures of invented objects, where the encoder has it."""

import shutil
from pathlib import Path

from pipeline.config import Params, PretrainConfig
from pipeline.core.io import atomic, read_json, write_table
from pipeline.core.layout import HISTORY_FILE, PRETRAINED
from pipeline.core.records import Measurement
from pipeline.running.stage import stage
from pipeline.tracking.live import live


def made_before(params: Params) -> Path | None:
    """The backbone of the model that training starts from, where nothing asks for another one."""
    start, asked = Path(params.language.start), params.frames
    # As pipeline/use/folder.py names them.
    found, config = start / "encoder" / "scenes.safetensors", start / "config.json"
    if not (params.language.start and params.pretrain == PretrainConfig() and found.is_file() and config.is_file()):
        return None
    frames = read_json(config)["frames"]
    return found if (frames["pixels"], frames["fit"]) == (asked.pixels, asked.fit) else None


if __name__ == "__main__":
    with stage("pretrain") as run:
        params = run.params
        history: list[Measurement] = []
        if "scenes" in params.encoder.backbone:
            if there := made_before(params):
                print(f"pretrain: takes the backbone of {params.language.start}", flush=True)
                with atomic(PRETRAINED) as partial:
                    shutil.copyfile(there, partial)
            else:
                # Imported here, since most runs need no torch.
                from pipeline.encoder.pretrain import pretrain
                from pipeline.training.trainable import save_trainable

                with live(run) as callbacks:
                    encoder, history = pretrain(params.pretrain, params.frames, params.runtime, callbacks)
                save_trainable(encoder, PRETRAINED)
                run.finish_training(history)
        write_table(PRETRAINED.with_name(HISTORY_FILE), Measurement, history)
