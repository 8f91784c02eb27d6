"""The benchmark of encoders, on toys: what it measures is what the pipeline does, and it says what it measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from pipeline.io import write_json, write_table
from pipeline.encoder.baseline.validation import Verdict
from pipeline.benchmarks import DATA_VARIABLE, encoder, encoder_cost, encoder_training
from pipeline.benchmarks.encoder import BASELINE, PICTURE, PRETRAINED, Setting, SmallerStore, formatted, settings
from pipeline.benchmarks.encoder_cost import MODELS, EncoderRow, judged, megabytes, take_turns, with_error
from pipeline.encoder.candidates import CONTESTANTS
from pipeline.errors import UserError
from pipeline.videos.frames.extract import extract_frames
from pipeline.videos.frames.store import FrameStore
from pipeline.encoder.frame_classifier import FrameVotes
from pipeline.encoder.recipes import base_encoder
from pipeline.encoder.scene_encoder import SceneEncoder
from pipeline.encoder.model import FrameEncoder
from pipeline.trainable import save_trainable
from pipeline.videos.catalogue import Catalogue
from pipeline.records import Judged, Part
from pipeline.reporting.encoder_report import COSTS, _costs
from pipeline.scenes.film import write_film
from pipeline.scenes.light import make_sensor, shade
from pipeline.config import CrossValidationConfig, EncoderConfig, FramesConfig, RuntimeConfig
from pipeline.encoder import frame_heads as votes
from pipeline.encoder.cross_validation import Arena
from pipeline.encoder.cross_validation import judge as judge_contestant
from pipeline.videos.files import VideoFile, list_videos
from tests.checkpoints import write_clip
from tests.conftest import ROOT

OBJECTS = {Part.TRAIN: 10, Part.VALIDATION: 2}
"""The development split needs ten to train and test on."""
TINY_CLIP = "ViT-S-32-alt"


@pytest.fixture(scope="module")
def films(catalogue: Catalogue, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two videos each of balls of twelve sizes."""
    folder = tmp_path_factory.mktemp("films")
    sensor = make_sensor(96, 72, 0)
    y, x = np.mgrid[:72, :96]
    known = sorted(catalogue.objects.values(), key=lambda o: o.object_id)
    parts = [(part, [o.object_id for o in known if o.splits["paper"] == part]) for part in OBJECTS]
    for place, object_id in enumerate(name for part, names in parts for name in names[: OBJECTS[part]]):
        for number in range(2):
            squares = (x - 48 - 4 * number) ** 2 + (y - 36) ** 2
            ball = np.exp(-squares / (60 + 25 * place)).astype(np.float32)
            skins = [np.float32(depth) * ball for depth in (0, 0, 0.2, 0.4, 0.6, 0.7, 0.6, 0.4, 0.3, 0)]
            pictures = [shade(skin, sensor, 0.3, seed * 977) for seed, skin in enumerate(skins)]
            write_film(folder / f"{object_id}_{number}.avi", pictures, 10.0)
    return folder


@pytest.fixture(scope="module")
def arena(films: Path, catalogue: Catalogue, tmp_path_factory: pytest.TempPathFactory) -> Arena:
    folder = tmp_path_factory.mktemp("arena")
    config = FramesConfig(size=encoder_cost.SIDE)
    torch.manual_seed(0)
    save_trainable(SceneEncoder(), folder / "encoder.safetensors")
    return Arena(
        videos=extract_frames(films, catalogue, config, folder / "frames", folder / "partial").videos,
        catalogue=catalogue,
        frames=folder / "frames",
        recordings=films,
        per_video=5,
        encoder=EncoderConfig(weights=str(write_clip(folder / "clip"))),
        runtime=RuntimeConfig(device="cpu", threads=1),
        pretrained=folder / "encoder.safetensors",
    )


@pytest.fixture
def root(arena: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A project without pretrained weights, as small a benchmark as can be."""
    values = yaml.safe_load((ROOT / "params.yaml").read_text())
    values["encoder"]["weights"] = arena.encoder.weights
    (tmp_path / "params.yaml").write_text(yaml.safe_dump(values))
    (tmp_path / "pipeline").symlink_to(ROOT / "pipeline")
    monkeypatch.chdir(tmp_path)  # Trainings leave their checkpoints there.
    monkeypatch.setenv(DATA_VARIABLE, str(arena.recordings))
    for module, name, value in (
        (encoder_cost, "REPEATS", 2),
        (encoder_cost, "SAMPLE", 2),
        (encoder_cost, "TRUE_SHAPES", (TINY_CLIP,)),
        (encoder, "SAMPLE", 2),
        (encoder, "SIDES", (32,)),
        (encoder, "COUNTS", (1,)),
        (encoder, "FOLDS", 2),
        (encoder, "REPEATS", 1),
        (encoder_training, "SAMPLE", 2),
        (encoder_training, "EPOCHS", 1),
        (encoder_training, "CLIPS", 4),
        (encoder_training, "BATCH", 2),
        (encoder, "FORMATS", ("float32", "int8")),
        (encoder_training, "PROMPTS", dict([*encoder_training.PROMPTS.items()][1:2])),
        (votes, "STRENGTHS", votes.STRENGTHS[:2]),
        (votes, "FOLDS", 2),
        (votes, "ROUNDS", 5),
    ):
        monkeypatch.setattr(module, name, value)
    return tmp_path


def other(labels: tuple[int, ...]) -> tuple[int, ...]:
    """Classes of which none is right."""
    return tuple(int(c == 0) for c in labels)


def write_judged(root: Path, arena: Arena, name: str, wrong: int) -> None:
    """A cross-validation in two repeats that has the first `wrong` videos wrong in the second of them."""
    records = [
        Judged(
            video_id=v.video_id,
            object_id=v.object_id,
            repeat=repeat,
            expected=labels,
            predicted=other(labels) if repeat and place < wrong else labels,
        )
        for repeat in range(2)
        for place, v in enumerate(arena.videos)
        for labels in [arena.catalogue.labels(v.object_id)]
    ]
    write_table(root / "data" / "cross_validation" / name / "judged.parquet", Judged, records)


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_the_whole_on_balls(root: Path, arena: Arena) -> None:
    (root / PRETRAINED).parent.mkdir(parents=True)
    (root / PRETRAINED).symlink_to(arena.pretrained)
    write_judged(root, arena, "strong", 3)
    write_judged(root, arena, "trees", 6)
    threads = torch.get_num_threads()
    rows = encoder.measure(root)
    assert torch.get_num_threads() == threads
    cases = {row.case: row for row in rows}
    assert len(cases) == len(rows)
    assert (root / PICTURE).stat().st_size > 10_000
    assert not list((root / "checkpoints").rglob("*.safetensors"))
    assert {row.unit for row in rows} == {
        *("ms a video", "ms a video, encoder alone", "ms a frame, encoder alone", "ms a clip"),
        *("MB of parameters", "s to load"),
    }
    for row in rows:
        assert row.cost > 0
        assert row.ratio == 1 or row.case != row.baseline
        assert row.baseline in cases
        assert row.unit == cases[row.baseline].unit
        assert row.low <= (row.cost if row.error is None else row.error) <= row.high

    write_json(root / COSTS, [row.model_dump() for row in rows])
    assert list(_costs(root)) == list(MODELS), "the report finds them"
    strong, trees, paper = (cases[f"model, {name}"] for name in ("strong", "trees", "paper"))
    assert strong.error == pytest.approx(3 / 48, abs=1e-4)
    assert trees.error == pytest.approx(6 / 48, abs=1e-4)
    assert trees.difference == pytest.approx(-3 / 48, abs=1e-4)
    assert paper.error is None, "it was not cross-validated"
    assert [cases[f"model, {name}"].frames for name in ("strong-one-frame", "strong", "strong-ten-frames")] == [
        1,
        5,
        10,
    ]

    one, five, ten = (
        cases[f"model, {name}"].flops or 0 for name in ("strong-one-frame", "strong", "strong-ten-frames")
    )
    assert 0 < one < five < ten, "frames cost operations"
    assert cases["model, trees"].flops is None

    for setting in settings():
        row = cases[setting.case]
        assert (row.flops is None) == (setting.form == "int8"), "what torch cannot count is empty"
        assert (row.frames, row.unit, row.baseline) == (setting.frames, "ms a video, encoder alone", BASELINE)
        assert row.difference_low is not None
    for case in encoder_training.PROMPTS:
        assert cases[case].error is not None
    assert cases["weight, CLIP's visual tower"].ratio < 1, "without the text tower"
    single, half = (cases[f"{TINY_CLIP}, {form}"].megabytes for form in ("float32", "bfloat16"))
    assert half == pytest.approx((single or 0) / 2, rel=1e-3)


def test_problems_are_one_line(root: Path, arena: Arena, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match=r"data/pretrained/scenes/encoder.safetensors: .*recipe=strong.*repro pretrain"):
        encoder.measure(root)
    (root / PRETRAINED).parent.mkdir(parents=True)
    (root / PRETRAINED).symlink_to(arena.pretrained)
    monkeypatch.setattr(encoder, "SIDE", 24)
    with pytest.raises(UserError, match=r"stand-in CLIP, which `octopi scale small.* takes 32"):
        encoder.measure(root)
    monkeypatch.undo()
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path / "nothing"))
    with pytest.raises(UserError, match="ten|10 objects"):
        encoder.measure(root)


def pictures(arena: Arena, setting: Setting) -> torch.Tensor:
    store = setting.data(arena).store
    return torch.from_numpy(np.concatenate([store.pictures(v.video_id) for v in arena.videos[:4]]))


@torch.inference_mode()
def embed(model: FrameEncoder, frames: torch.Tensor) -> torch.Tensor:
    return model.eval()(frames, torch.zeros(len(frames), dtype=torch.int64)).float()


def test_number_formats_change_little_but_size(arena: Arena) -> None:
    torch.manual_seed(0)
    for name, model, forms in (
        ("strong", SceneEncoder(), {"bfloat16": 0.52}),
        ("probe", base_encoder(arena.encoder), {"bfloat16": 0.52, "int8": 0.9}),
    ):
        frames = pictures(arena, Setting("", name))  # type: ignore[arg-type]
        before = embed(model, frames)
        assert torch.equal(embed(formatted(model, "float32"), frames), before)
        for form, share in forms.items():
            changed = formatted(model, form)  # type: ignore[arg-type]
            after = embed(changed, frames)
            assert not torch.equal(after, before), f"{name} is not in {form}"
            assert (after - before).norm() < 0.05 * before.norm(), f"{name} in {form}"
            assert megabytes(changed) < share * megabytes(model)
        assert torch.equal(embed(model, frames), before), "the original stays"


def test_smaller_pictures_are_means_of_blocks(arena: Arena) -> None:
    video, folder = arena.videos[0].video_id, arena.frames
    whole = FrameStore(folder, "subtract").pictures(video, [2, 0])
    np.testing.assert_array_equal(SmallerStore(folder, "subtract", encoder_cost.SIDE).pictures(video, [2, 0]), whole)
    half = SmallerStore(folder, "subtract", 60).pictures(video, [2, 0])
    blocks = whole.reshape(2, 60, 2, 60, 2, 3).mean(axis=(2, 4))
    assert np.abs(half - blocks).max() <= 0.5
    torch.manual_seed(0)
    model = SceneEncoder()
    near, far = embed(model, torch.from_numpy(half)), embed(model, torch.from_numpy(whole))
    assert torch.cosine_similarity(near, far).min() > 0.9, "smooth pictures stay alike"


def test_timed_models_decide_as_the_pipeline_does(arena: Arena, catalogue: Catalogue) -> None:
    """Frames read from the file, against those that were extracted."""
    file = list_videos(arena.recordings, catalogue).files[3]
    for name in ("strong", "probe", "release"):
        contestant = CONTESTANTS[name]
        model = encoder_cost.classifier(contestant, arena).eval()
        assert isinstance(model, FrameVotes) == (contestant.kind == "votes")
        clip = one_clip(arena, file, "strong" if name == "strong" else "probe")
        with torch.inference_mode():
            expected = model(clip["frames"][None], clip["moments"][None])["logits"]
        seen: list[torch.Tensor] = []
        model.decide = lambda logits, seen=seen: seen.append(logits)  # type: ignore[method-assign, misc]
        encoder_cost._network(model, contestant, 5)(file)
        assert torch.equal(seen[0], expected)


def one_clip(arena: Arena, file: VideoFile, contestant: str) -> dict[str, torch.Tensor]:
    from pipeline.encoder.clips import ClipDataset

    data = Setting("", contestant).data(arena)  # type: ignore[arg-type]
    place = [v.video_id for v in arena.videos].index(file.video_id)
    return ClipDataset(data.store, data.videos(Part.UNUSED), per_video=5)[place]


@pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")
def test_the_default_is_judged_as_the_contestant_is(root: Path, arena: Arena, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoder, "settings", lambda: [Setting()])
    trials: list[encoder.Trial] = []
    judge = encoder.judge
    monkeypatch.setattr(encoder, "run_parallel", lambda work, jobs, *_: map(work, trials.extend(jobs) or jobs))
    (row,) = encoder.trade(arena)
    contestant = judge_contestant(CONTESTANTS["strong"], arena, CrossValidationConfig(folds=2, repeats=1))
    assert [v.predicted[0] for v in judge(trials[0])] == [j.predicted for j in contestant]
    assert row.error == pytest.approx(np.mean([j.predicted != j.expected for j in contestant]), abs=1e-4)
    assert row.difference == 0


def test_both_ways_of_training_see_the_same_pictures(root: Path, arena: Arena) -> None:
    videos = arena.videos[5:9]
    cached, read = encoder_training.stores(arena, videos, 32, root)
    assert len([*(root / "pictures").rglob("*.jpg")]) == len(cached.index)
    batches = [[*encoder_training.loader(store, arena, videos)] for store in (cached, read)]
    assert len(batches[0]) == len(batches[1]) == 2
    for one, other in zip(*batches, strict=True):
        assert torch.equal(one["moments"], other["moments"])
        assert torch.equal(one["labels"], other["labels"])
        difference = (one["frames"].float() - other["frames"].float()).abs()
        assert difference.mean() < 3, "of 255: two codecs and two ways to resize"
        mirrored = (one["frames"].float() - other["frames"].flip(3).float()).abs()
        assert mirrored.mean() > 2 * difference.mean(), "and mirrored alike"


def test_errors_and_differences_are_those_of_the_verdicts() -> None:
    row = EncoderRow(case="a", cost=1, unit="ms", baseline="b", ratio=1, low=1, high=1)
    expected = [(0, 1), (1, 1), (0, 0), (2, 1)]
    first = [Verdict(f"object {i // 2}", e, (e, other(e))) for i, e in enumerate(expected)]
    second = [replace(v, predicted=(v.expected, v.expected)) for v in first[:3]] + first[3:]
    found = with_error(row, second, first, [3, 2])
    assert (found.error, found.difference) == (1 / 8, 3 / 8)
    assert 0 <= found.low <= 1 / 8 <= found.high
    others: Sequence[Verdict] = first[::-1]
    assert with_error(row, second, others, [3, 2]).difference is None, "about other videos"
    assert with_error(row, None, first, [3, 2]) is row
    assert with_error(row, second[:2], first, [3, 2]) is row, "one object has no interval"


def test_every_case_has_its_turn_at_each_item(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(encoder_cost, "REPEATS", 2)
    seen: list[str] = []
    costs = take_turns({name: lambda item, name=name: seen.append(f"{name}{item}") for name in "ab"}, [1, 2])
    assert seen == ["a1", "b1", *(["a1", "b1", "a2", "b2"] * 2)]
    assert {name: len(repeats) for name, repeats in costs.items()} == {"a": 2, "b": 2}


def test_nothing_judged_is_no_error(tmp_path: Path) -> None:
    assert judged(tmp_path, "strong") is None
