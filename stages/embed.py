"""Compute the embeddings of every kept frame, by the base encoder and each fine-tuned one."""

from pathlib import Path

from pipeline.config import EncoderConfig
from pipeline.embeddings import INDEX_FILE, STATISTICS_FILE, TENSOR, TENSOR_FILE
from pipeline.encoder.embed import embed_videos, standardize, statistics, union
from pipeline.encoder.model import FrameEncoder
from pipeline.encoder.recipes import base_encoder, property_classifier
from pipeline.io import fingerprint, read_table, save_tensors, write_table
from pipeline.records import Assignment, Embedding, Encoder, Part
from pipeline.runtime import resolve_device
from pipeline.stage import DATA, stage
from pipeline.training.trainable import load_trainable
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.frames.store import FrameStore
from pipeline.weights import check_encoder


def load_encoder(config: EncoderConfig, catalogue: Path, which: Encoder, seed: int) -> FrameEncoder:
    if which is Encoder.BASE:
        return base_encoder(config)
    classifier = property_classifier(config, [len(p.levels) for p in load_catalogue(catalogue).properties])
    load_trainable(classifier, DATA / "encoder" / str(seed) / "encoder.safetensors")
    return classifier.encoder


def main() -> None:
    with stage("embed") as run:
        params = run.params
        check_encoder(Path(params.encoder.weights), params.frames.size, params.encoder.backbone)
        splits = {seed: read_table(DATA / "splits" / f"{seed}.parquet", Assignment) for seed in params.ablation.seeds}
        store = FrameStore(DATA / "frames", params.encoder.reference)
        for which in params.ablation.encoders:
            for seed, assignments in splits.items():
                out = DATA / "embeddings" / f"{which}-{seed}"
                # The base encoder has no seed: its embeddings are computed once and standardised for each seed.
                if which is not Encoder.BASE or seed == params.ablation.seeds[0]:
                    encoder = load_encoder(params.encoder, Path(params.data.catalogue), which, seed)
                    device = resolve_device(params.runtime.device)
                    size = params.encoder.embed_batch_size
                    wanted = union(splits.values()) if which is Encoder.BASE else assignments
                    raw, index = embed_videos(encoder, store, wanted, batch_size=size, device=device)
                training = {a.video_id for a in assignments if a.part == Part.TRAIN}
                known = statistics(raw, index, training)
                tensor = standardize(raw, known) if params.encoder.standardize else raw
                known._replace(frames=fingerprint(params.frames)).save(out / STATISTICS_FILE)
                save_tensors(out / TENSOR_FILE, {TENSOR: tensor})
                write_table(out / INDEX_FILE, Embedding, index)
                run.metrics[f"{which}-{seed}.rows"] = len(index)
                run.metrics[f"{which}-{seed}.norm"] = float(tensor.norm(dim=1).mean())


if __name__ == "__main__":
    main()
