"""Compute the embeddings of every kept frame, by the base encoder and each fine-tuned one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pipeline.core.io import fingerprint, read_table, save_tensors, write_table
from pipeline.core.layout import FRAMES, TRAINED_FILE, embeddings_dir, encoder_dir, split_file
from pipeline.core.records import INDEX_FILE, TENSOR, TENSOR_FILE, Embedding, Encoder, Part
from pipeline.running.parallel import device_here
from pipeline.running.stage import Stage, stage
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Assignment


def embed(run: Stage, videos: Sequence[Assignment], state: Path | None) -> tuple[torch.Tensor, list[Embedding]]:
    params = run.params
    catalogue = Path(params.data.catalogue)
    source = EncoderSource(params.encoder, params.runtime.device, FRAMES, catalogue, state, run.started)
    return embed_videos(replace(source, device=device_here(source.device))(), videos, source)


def write(run: Stage, out: Path, split: Sequence[Assignment], raw: torch.Tensor, index: Sequence[Embedding]) -> None:
    params, heads = run.params, None
    if params.encoder.embedding == "logits":
        raw, heads = logits_of(raw, index, split, load_catalogue(Path(params.data.catalogue)), params.seed)
    known = statistics(raw, index, {a.video_id for a in split if a.part == Part.TRAIN})
    tensor = standardize(raw, known) if params.encoder.standardize else raw
    known._replace(frames=fingerprint(params.frames), heads=heads).save(out / STATISTICS_FILE)
    save_tensors(out / TENSOR_FILE, {TENSOR: tensor})
    write_table(out / INDEX_FILE, Embedding, index)
    run.metrics[f"{out.name}.rows"] = len(index)
    run.metrics[f"{out.name}.norm"] = float(tensor.norm(dim=1).mean())


if __name__ == "__main__":
    with stage("embed", of_variants=True) as run:
        import torch

        from pipeline.encoder.embed import EncoderSource, embed_videos, logits_of, standardize, statistics, union
        from pipeline.training.embeddings import STATISTICS_FILE

        params = run.params
        splits = {seed: read_table(split_file(seed), Assignment) for seed in params.ablation.seeds}
        for which in params.ablation.encoders:
            if which is Encoder.BASE:
                # It has no seed: its embeddings are computed once and standardised for each.
                found = embed(run, union(splits.values()), None)
                for seed, split in splits.items():
                    write(run, embeddings_dir(which, seed), split, *found)
                continue
            for seed, split in splits.items():
                trained = encoder_dir(seed) / TRAINED_FILE
                write(run, embeddings_dir(which, seed), split, *embed(run, split, trained))
