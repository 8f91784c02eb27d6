"""Compute the embeddings of every kept frame, by the base encoder and each fine-tuned one."""

from pathlib import Path

from pipeline.embeddings import INDEX_FILE, STATISTICS_FILE, TENSOR, TENSOR_FILE
from pipeline.encoder.embed import EncoderSource, embed_videos, standardize, statistics, union
from pipeline.io import fingerprint, read_table, save_tensors, write_table
from pipeline.records import Assignment, Embedding, Encoder, Part
from pipeline.stage import DATA, stage
from pipeline.weights import check_encoder


def main() -> None:
    with stage("embed") as run:
        params = run.params
        check_encoder(Path(params.encoder.weights), params.frames.size, params.encoder.backbone)
        splits = {seed: read_table(DATA / "splits" / f"{seed}.parquet", Assignment) for seed in params.ablation.seeds}
        for which in params.ablation.encoders:
            for seed, assignments in splits.items():
                out = DATA / "embeddings" / f"{which}-{seed}"
                # The base encoder has no seed: its embeddings are computed once and standardised for each seed.
                if which is not Encoder.BASE or seed == params.ablation.seeds[0]:
                    source = EncoderSource(
                        params.encoder,
                        params.runtime.device,
                        frames=DATA / "frames",
                        catalogue=Path(params.data.catalogue),
                        state=None if which is Encoder.BASE else DATA / "encoder" / str(seed) / "encoder.safetensors",
                    )
                    wanted = union(splits.values()) if which is Encoder.BASE else assignments
                    raw, index = embed_videos(source(), wanted, source)
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
