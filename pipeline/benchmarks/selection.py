"""Which frames, and how many: what the baseline predictor makes of them, against what they cost.

Every setting is judged on the same videos by the same folds: how often all properties of an object that was never
touched are right (grouped cross-validation). Cost is the pass that selects, and the features of the chosen frames, on
one core. Frames are drawn as the pipeline draws them for evaluation.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

import numpy as np

from pipeline.encoder.baseline.features import frame_features, pool_features
from pipeline.encoder.baseline.recordings import mean_reference
from pipeline.encoder.baseline.validation import Verdict, compare, cross_validate, forest, summarise
from pipeline.benchmarks import BenchRow, bench_videos
from pipeline.benchmarks.pareto import draw_rows
from pipeline.videos.decoding import decode
from pipeline.errors import UserError
from pipeline.sampling import sample_evaluation
from pipeline.videos.frames.scan import Scan, scan
from pipeline.parallel import run_parallel
from pipeline.config import FramesConfig, Selection
from pipeline.videos.files import VideoFile, list_videos

COUNTS = (1, 3, 5, 10)
RULES: tuple[Selection, ...] = ("salient", "release", "uniform", "contact")
TOLERANCES = (0.3, 0.5, 0.8)
FRACTION = 0.3
SIZE = 64
REPEATS = 10
"""With three, how folds and trees fell still moves a setting by a point or two; no interval over objects shows that."""
BASELINE = "uniform, 5 frames"
PICTURE = Path("reports") / "bench" / "selection.png"


class TradeRow(BenchRow):
    """A setting with its frames and its paired difference to the baseline."""

    frames: float
    """Mean frames a video."""
    difference: float
    """Combined accuracy less the baseline's, on the same videos."""
    difference_low: float
    difference_high: float


@dataclass(frozen=True)
class Setting:
    """How frames are chosen: a rule, and how many of what it keeps (all of it for `adaptive`)."""

    rule: Selection
    count: int | None = None
    tolerance: float = 0.0

    @property
    def case(self) -> str:
        """As the report names it."""
        return (
            f"{self.rule}, {self.count} frame{'s' * (self.count > 1)}"
            if self.count
            else f"{self.rule}, tolerance {self.tolerance:g}"
        )

    def config(self) -> FramesConfig:
        """As params.yaml would say it."""
        return FramesConfig(selection=self.rule, fraction=FRACTION, tolerance=self.tolerance, size=SIZE)


@dataclass(frozen=True)
class Sample:
    """One video under every setting."""

    object_id: str
    features: tuple[np.ndarray, ...]
    frames: tuple[int, ...]
    seconds: tuple[float, ...]
    """Of the selecting pass."""
    feature_seconds: float
    """Of one frame's features."""


def settings() -> list[Setting]:
    """All that is compared."""
    fixed = [Setting(rule, count) for rule in RULES for count in COUNTS]
    return [*fixed, *(Setting("adaptive", tolerance=t) for t in TOLERANCES)]


def measure(root: Path) -> Sequence[TradeRow]:
    """Compare all settings over the videos of `bench_videos`; draws the Pareto front beside the figures.

    Raises:
        UserError: where there are too few objects for folds.
    """
    folder, catalogue = bench_videos(root)
    files = list_videos(folder, catalogue).files
    if len({f.object_id for f in files}) < 10:
        raise UserError(f"{folder}: bench selection needs videos of ten objects or more")
    samples = [s for s in run_parallel(_look, files, "selection", "video") if s is not None]
    objects = [s.object_id for s in samples]
    labels = np.array([catalogue.labels(o) for o in objects])
    classes = [len(p.levels) for p in catalogue.properties]
    verdicts: dict[str, Sequence[Verdict]] = {}
    for place, setting in enumerate(settings()):
        features = np.stack([s.features[place] for s in samples])
        verdicts[setting.case] = cross_validate(
            forest(features, labels, objects, classes), labels, objects, classes, repeats=REPEATS
        )
    rows = []
    costs = [_cost(samples, place) for place in range(len(settings()))]
    baseline = costs[[s.case for s in settings()].index(BASELINE)]
    for place, setting in enumerate(settings()):
        combined = summarise(verdicts[setting.case], classes).combined
        gap = compare(verdicts[BASELINE], verdicts[setting.case])
        assert combined.interval is not None, "there are ten objects"
        assert gap.interval is not None, "there are ten objects"
        rows.append(
            TradeRow(
                case=setting.case,
                cost=round(costs[place], 2),
                unit="ms a video",
                baseline=BASELINE,
                ratio=round(costs[place] / baseline, 3),
                error=round(1 - combined.value, 4),
                low=round(1 - combined.interval.high, 4),
                high=round(1 - combined.interval.low, 4),
                frames=round(fmean(s.frames[place] for s in samples), 2),
                difference=round(gap.value, 4),
                difference_low=round(gap.interval.low, 4),
                difference_high=round(gap.interval.high, 4),
            )
        )
    title = f"Which frames, and how many: {len(samples)} videos of {len(set(objects))} objects"
    draw_rows(rows, root / PICTURE, title, "error (not all properties right), object-clustered 95 % interval")
    return rows


def _cost(samples: Sequence[Sample], place: int) -> float:
    """Milliseconds a video: the selecting pass, and the features of its frames."""
    feature = median(s.feature_seconds for s in samples)
    return 1000 * (median(s.seconds[place] for s in samples) + feature * fmean(s.frames[place] for s in samples))


def _look(file: VideoFile) -> Sample | None:
    """One video under every setting; None for one that cannot be read or that the published rule leaves out."""
    frames = list(decode(file.path))
    rules: dict[tuple[Selection, float], tuple[Scan, float]] = {}
    chosen: list[list[int]] = []
    seconds: list[float] = []
    for setting in settings():
        key = (setting.rule, setting.tolerance)
        if key not in rules:
            started = time.perf_counter()
            result = scan(file, setting.config())
            if not isinstance(result, Scan) or not result.kept:
                return None
            rules[key] = result, time.perf_counter() - started
        result, spent = rules[key]
        kept = [k.index for k in result.kept]
        positions = range(len(kept)) if setting.count is None else sample_evaluation(len(kept), setting.count)
        chosen.append(sorted({kept[p] for p in positions}))
        seconds.append(spent)
    first = next(iter(rules.values()))[0]
    reference = mean_reference(frames, first.probe.starts_touching)
    started = time.perf_counter()
    wanted = sorted({i for indices in chosen for i in indices})
    rows = {i: frame_features(frames[i], reference) for i in wanted}
    each = (time.perf_counter() - started) / len(wanted)
    return Sample(
        object_id=file.object_id,
        features=tuple(pool_features([rows[i] for i in indices]) for indices in chosen),
        frames=tuple(len(indices) for indices in chosen),
        seconds=tuple(seconds),
        feature_seconds=each,
    )
