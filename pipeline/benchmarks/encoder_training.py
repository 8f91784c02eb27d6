"""Training the paper's recipe: how many prompts it wants, and what reading frames costs it.

**Prompts** are trained for a few epochs on the development split and judged on its validation videos, which also choose
the epoch: errors are a little too kind, alike for all. Nothing is looked at that is for test.

**Speed** compares the pipeline's cached frames with the published way, in which every frame is a JPEG of its own at the
video's size that is opened, resized and cropped each time that it is drawn (github.com/clear-nus/octopi). Videos, draws
of frames, mirroring, normalisation, forward, backward and AdamW's step are the same code in both. Files of both ways
are in the system's cache.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import torch
from PIL import Image
from torch.utils.data import DataLoader

from pipeline.encoder.baseline.validation import Verdict
from pipeline.benchmarks.encoder_cost import (
    ALONE,
    SAMPLE,
    SEED,
    EncoderRow,
    make_row,
    megabytes,
    parameters,
    spread,
    take_turns,
    with_error,
)
from pipeline.benchmarks.operations import counted
from pipeline.encoder.clips import ClipDataset, LabelledVideo, collate_clips
from pipeline.videos.decoding import decode
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import TABLE_FILE, FrameStore
from pipeline.videos.frames.subtraction import Pictures
from pipeline.encoder.clip import load_visual_tower
from pipeline.encoder.recipes import property_classifier
from pipeline.encoder.model import FrameEncoder, PropertyClassifier
from pipeline.records import Assignment, Part, Video
from pipeline.runtime import seed_everything
from pipeline.config import EncoderConfig, FramesConfig
from pipeline.encoder.cross_validation import Arena
from pipeline.encoder.finetune import EncoderData, classify, train_classifier

EPOCHS = 8
PROMPTS = {
    "prompts, 1 at all layers": {"prompts": 1, "prompt_layers": 0},
    "prompts, 8 at all layers": {"prompts": 8, "prompt_layers": 0},
    "prompts, 32 at all layers": {"prompts": 32, "prompt_layers": 0},
    "prompts, 8 at the first layer": {"prompts": 8, "prompt_layers": 1},
}
USUAL = "prompts, 8 at all layers"
"""The paper's, as far as it says."""
CLIPS, BATCH = 48, 16
"""Clips that are trained on in each repeat, and in a step."""
CACHED, READ = "training step, cached frames", "training step, JPEG frames read each step"


def prompts(arena: Arena, assignments: Sequence[Assignment]) -> list[EncoderRow]:
    """Train with each of `PROMPTS`: errors on validation videos, and the encoder's milliseconds a video."""
    data = EncoderData(FrameStore(arena.frames), arena.catalogue, assignments, arena.per_video)
    models: dict[str, PropertyClassifier] = {}
    verdicts: dict[str, list[Verdict]] = {}
    for case, changed in PROMPTS.items():
        config = arena.encoder.model_copy(update={**changed, "epochs": EPOCHS})
        seed_everything(SEED)
        model = property_classifier(config, data.classes)
        train_classifier(
            model, data, config, arena.runtime, seed=SEED, inputs=["bench encoder", arena.frames / TABLE_FILE]
        )
        models[case], verdicts[case] = model.eval(), validate(model, data, config)
    sample = [LabelledVideo(v.video_id, ()) for v in spread(arena.videos, SAMPLE)]
    clips = ClipDataset(data.store, sample, per_video=data.per_video)
    shown = [clips[i] for i in range(len(clips))]
    costs = take_turns({case: Describe(model.encoder) for case, model in models.items()}, shown)
    rows = []
    for case, model in models.items():
        columns = {
            "frames": data.per_video,
            "megabytes": megabytes(model),
            "parameters": parameters(model),
            # Not in inference mode, in which the counter fails at parameters that are put into a layer, as prompts are.
            "flops": counted(partial(model.encoder.describe, shown[0]["frames"], shown[0]["moments"])),
        }
        row = make_row(case, ALONE, costs, USUAL, **columns)
        rows.append(with_error(row, verdicts[case], verdicts[USUAL], data.classes))
    return rows


def validate(model: PropertyClassifier, data: EncoderData, config: EncoderConfig) -> list[Verdict]:
    """What a classifier says of each validation video, in the order of the videos."""
    found = classify(model, data, [Part.VALIDATION], config.batch_size, torch.device("cpu"))
    count = len(data.classes)
    return [
        Verdict(
            found[i].object_id,
            tuple(c.expected for c in found[i : i + count]),
            (tuple(c.predicted for c in found[i : i + count]),),
        )
        for i in range(0, len(found), count)
    ]


class Describe:
    """An encoder on one clip: what is timed where the encoder alone is."""

    def __init__(self, encoder: FrameEncoder) -> None:
        self.encoder = encoder.eval()

    @torch.inference_mode()
    def __call__(self, clip: dict[str, torch.Tensor]) -> object:
        """Describe the frames of an item of `ClipDataset`."""
        return self.encoder.describe(clip["frames"], clip["moments"])


class JpegStore(FrameStore):
    """A store whose frames are read from JPEG files, as the published code reads them.

    Args:
        folder: What `pipeline.videos.frames.extract` wrote; it says which frames there are and at which size they are wanted.
        pictures: What `write_jpegs` wrote.
    """

    def __init__(self, folder: Path, pictures: Path) -> None:
        super().__init__(folder)
        self.folder = pictures

    def pictures(self, video_id: str, positions: Sequence[int] | None = None) -> Pictures:
        """Frames resized bicubically to the wanted height and cut to their central square: as the parent's."""
        rows = self.rows(video_id)
        chosen = rows if positions is None else [rows[p] for p in positions]
        return np.stack([self._read(video_id, self.index[row].frame_index) for row in chosen])

    def _read(self, video_id: str, index: int) -> Pictures:
        side = self.size
        with Image.open(jpeg_file(self.folder, video_id, index)) as file:
            picture = file.convert("RGB")
        width, height = (round(side * whole / min(picture.size)) for whole in picture.size)
        left, top = (width - side) // 2, (height - side) // 2
        resized = picture.resize((width, height), Image.Resampling.BICUBIC)
        return np.asarray(resized.crop((left, top, left + side, top + side)))


def jpeg_file(folder: Path, video_id: str, index: int) -> Path:
    """Where a frame is, by its number in the video."""
    return folder / video_id / f"{index:010d}.jpg"


def write_jpegs(store: FrameStore, videos: Sequence[Video], recordings: Path, out: Path) -> None:
    """Write every kept frame of the videos as a JPEG at the video's own size, by OpenCV as the published code does."""
    for video in videos:
        (out / video.video_id).mkdir(parents=True)
        wanted = {store.index[row].frame_index for row in store.rows(video.video_id)}
        for index, frame in enumerate(decode(recordings / video.path)):
            if index in wanted:
                cv2.imwrite(str(jpeg_file(out, video.video_id, index)), frame)


def training_speed(arena: Arena) -> list[EncoderRow]:
    """Both ways of training on the same clips, and their parts: milliseconds a clip; the ratio is to cached frames."""
    videos = spread(arena.videos, CLIPS)
    seed_everything(SEED)
    model = property_classifier(arena.encoder, arena.classes).train()
    optimiser = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], lr=arena.encoder.learning_rate)

    def learn(batches: Iterable[dict[str, torch.Tensor]]) -> None:
        for batch in batches:
            optimiser.zero_grad()
            model(**batch)["loss"].backward()
            optimiser.step()

    with TemporaryDirectory() as made:
        cached, read = stores(arena, videos, load_visual_tower(Path(arena.encoder.weights)).image.size, Path(made))
        loaders = {"cached frames": loader(cached, arena, videos), "JPEG frames": loader(read, arena, videos)}
        kept = [*loaders["cached frames"]]
        costs = take_turns(
            {
                CACHED: lambda _: learn(loaders["cached frames"]),
                READ: lambda _: learn(loaders["JPEG frames"]),
                "training, nothing read": lambda _: learn(kept),
                "reading alone, cached frames": lambda _: [*loaders["cached frames"]],
                "reading alone, JPEG frames": lambda _: [*loaders["JPEG frames"]],
            },
            [0],
        )
    clips = {case: [ms / len(videos) for ms in repeats] for case, repeats in costs.items()}
    return [make_row(case, "ms a clip", clips, CACHED, frames=arena.per_video) for case in clips]


def stores(arena: Arena, videos: Sequence[Video], side: int, folder: Path) -> tuple[FrameStore, JpegStore]:
    """Both kinds of store for some of the videos, with the same frames in them."""
    linked = folder / "videos"
    linked.mkdir()
    for video in videos:
        path = arena.recordings / video.path
        (linked / f"{video.video_id}{path.suffix}").symlink_to(path.resolve())
    config = FramesConfig(selection="salient", size=side)
    extract_frames(linked, arena.catalogue, config, folder / "frames", folder / "partial")
    cached = FrameStore(folder / "frames")
    write_jpegs(cached, videos, arena.recordings, folder / "pictures")
    return cached, JpegStore(folder / "frames", folder / "pictures")


def loader(store: FrameStore, arena: Arena, videos: Sequence[Video]) -> DataLoader[dict[str, torch.Tensor]]:
    """Batches of training clips, drawn alike from either store."""
    labelled = [LabelledVideo(v.video_id, arena.catalogue.labels(v.object_id)) for v in videos]
    flips = arena.encoder.flip_probability
    clips = ClipDataset(store, labelled, per_video=arena.per_video, seed=SEED, flip_probability=flips)
    return DataLoader(clips, batch_size=BATCH, collate_fn=collate_clips)
