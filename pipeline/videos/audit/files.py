"""Checks of single videos and of what they have in common: length, rate, light, and whether anything is touched."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from statistics import fmean, median

from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Finding, Probe, Severity, finding
from pipeline.videos.split import ENOUGH, MORE

SHORT = 0.5
"""A video with less than this share of the median length at its frame rate is named."""
FOUND = 2.0
"""Contact is found where its strength is this many times the quiet level of the data set. Measured on real videos:
those of a cotton ball reach 1.5 to 2.0 times the level, the median of all 4.2."""
STILL = 0.5
"""Contact is still present at the end with this share of the video's strongest."""
DARK_OR_BRIGHT = 6.0
"""A video is named whose brightness is this many times the usual deviation away from its frame rate's median."""
STEP = 4.0
"""Change of the mean brightness between probed frames, in 8-bit steps: about ten times what contact does."""
SATURATED = 0.05
IRREGULAR = 1.5
"""Longest over shortest distance between frames, from which a frame rate counts as variable."""
SAME_RATE = 1.04
"""Frame rates are one where neighbours differ by this factor at most, as time stamps jitter. 24 and 25, the nearest
that cameras have, differ by 1.042."""
DEVIATION = 1.4826
"""Median absolute deviation to standard deviation, for a normal distribution."""


def check_files(probes: Sequence[Probe], catalogue: Catalogue) -> Iterator[Finding]:
    """All checks of this module, over videos that decode."""
    if not probes:
        return
    yield from _overview(probes, catalogue)
    for rate, group in by_rate(probes).items():
        usual, middle = median(p.frames for p in group), median(p.brightness for p in group)
        # At least one step: where all videos are equally bright, rounding is no outlier.
        spread = max(1.0, DEVIATION * median(abs(p.brightness - middle) for p in group))
        others = f"as others at {rate:.4g} frames/s"
        for p in group:
            if p.frames < SHORT * usual:
                yield finding("length", p.path, f"{p.frames} frames", f"about {usual:g}, {others}", Severity.WARNING)
            if abs(p.brightness - middle) > DARK_OR_BRIGHT * spread:
                measured, expected = f"{p.brightness:.1f} of 255", f"{middle:.1f} +- {spread:.1f}, {others}"
                yield finding("brightness", p.path, measured, expected, Severity.WARNING)
    yield from _each(probes)


def quiet_level(probes: Sequence[Probe]) -> float:
    """Strength that noise alone gives: the median over videos of each one's quiet frames."""
    return median(p.quiet for p in probes)


def touches(probe: Probe, level: float) -> bool:
    """Whether a video shows contact, by the quiet level of its data set."""
    return probe.contact > FOUND * level


def unsteady(first: int, frames: int) -> str:
    """What is to be said of a video whose light changes in its first frames, of so many."""
    if first == frames:
        return "never steady: contact may be light"
    return f"not steady in the first {first} frames, which are left out"


def _overview(probes: Sequence[Probe], catalogue: Catalogue) -> Iterator[Finding]:
    videos = Counter(p.object_id for p in probes)
    enough = MORE if len(videos) < ENOUGH else ""
    yield finding("videos", "all", f"{len(probes)} videos of {len(videos)} objects", enough)
    spread = sorted(Counter(videos.values()).items())
    yield finding("videos per object", "all", ", ".join(f"{n} objects with {count}" for count, n in spread))
    absent = sorted(catalogue.objects.keys() - videos)
    if absent:
        yield finding("videos", ", ".join(absent), "no video", "one or more an object", Severity.WARNING)
    frames = [p.frames for p in probes]
    yield finding("length", "all", f"{min(frames)} to {max(frames)} frames, mean {fmean(frames):.1f}")
    for check, groups in (
        ("frame rate", {f"{rate:.4g} frames/s": len(group) for rate, group in by_rate(probes).items()}),
        ("resolution", Counter(f"{p.width}x{p.height}" for p in probes)),
    ):
        usual = max(groups, key=lambda name: (groups[name], name))
        for name, count in sorted(groups.items()):
            yield finding(check, name, f"{count} videos", *(() if name == usual else (usual, Severity.WARNING)))


def by_rate(probes: Sequence[Probe]) -> dict[float, list[Probe]]:
    """The videos of each frame rate (`SAME_RATE`), by the median of what their headers say, the lowest first."""
    groups: list[list[Probe]] = []
    for probe in sorted(probes, key=lambda p: p.fps):
        if groups and probe.fps <= SAME_RATE * groups[-1][-1].fps:
            groups[-1].append(probe)
        else:
            groups.append([probe])
    return {median(p.fps for p in group): group for group in groups}


def _each(probes: Sequence[Probe]) -> Iterator[Finding]:
    """What is odd about a video by itself, or by the quiet level of its data set."""
    level, bright = quiet_level(probes), f"at most {100 * SATURATED:g} %"
    # Some containers promise no number (0): nothing to hold them to.
    differing = {p.path for p in probes if p.header_frames not in (0, p.frames)}
    for p in probes:
        touched, released = touches(p, level), STILL * p.contact
        pressed = touched and p.contact_end > max(FOUND * level, released)
        from_end = "touched from the first frame: the reference comes from the end"
        for check, odd, measured, expected in (
            ("frames that decode", p.path in differing, str(p.frames), f"{p.header_frames}, by the header"),
            ("rotation", p.rotation, f"{p.rotation} degrees in the metadata, applied", "0"),
            ("colours", p.hdr, "HDR, which looks flat beside other videos", "SDR; record or export it as such"),
            ("frame rate", p.irregular > IRREGULAR, f"varies by a factor of {p.irregular:.1f}", "even"),
            ("brightness", p.brightness_step > STEP, f"a step of {p.brightness_step:.1f} of 255", f"at most {STEP:g}"),
            ("saturation", p.saturated > SATURATED, f"{100 * p.saturated:.0f} % of values at 0 or 255", bright),
            ("frames kept", p.kept == 0, "0", "5 or more, by frames.selection"),
            ("light at the start", p.unsteady, unsteady(p.unsteady, p.frames), "steady"),
            ("contact at the start", p.starts_touching, from_end, "untouched"),
            ("contact", not touched, f"not found: strength {p.contact:.2f}", f"over {FOUND * level:.2f}"),
            ("contact at the end", pressed, f"still {p.contact_end:.2f} of {p.contact:.2f}", f"under {released:.2f}"),
        ):
            if odd:
                yield finding(check, p.path, measured, expected, Severity.WARNING)
    counted = f"{len(differing)} of {len(probes)} videos differ from their header"
    yield finding("frames that decode", "all", counted, "0")
    yield finding("contact", "all", f"quiet level {level:.2f}, median contact {median(p.contact for p in probes):.2f}")
