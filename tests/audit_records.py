"""Made-up measurements and catalogues for the tests of the audit."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from pipeline.config import ScenesConfig
from pipeline.core.records import Part
from pipeline.core.runtime import derive_seed
from pipeline.scenes.light import make_sensor
from pipeline.scenes.recipe import recipe_of
from pipeline.scenes.render import make_scene, render
from pipeline.videos.audit.leakage import check_leakage
from pipeline.videos.catalogue import Catalogue
from pipeline.videos.records import Assignment, Finding, Probe, Severity
from tests.conftest import CATALOGUE as PHYSICLEAR
from tests.frame_rules import scanned

ERROR, WARNING, INFO = Severity.ERROR, Severity.WARNING, Severity.INFO
OBJECTS = ("baseball", "cotton_ball", "pillow", "potato", "rug", "millet", "lemon", "orange")
GOOD_SPLIT = {o: (Part.TRAIN, Part.VALIDATION, Part.TEST)[i % 3] for i, o in enumerate(OBJECTS)}
SCENE = ScenesConfig(frames=24, width=128, height=96)
OTHER = Catalogue(
    language=PHYSICLEAR.language.model_copy(update={"dataset": ""}), objects={o: PHYSICLEAR.objects[o] for o in OBJECTS}
)
"""Eight objects of a data set that the paper says nothing about."""


def probe(video_id: str = "rug_0", **changes: object) -> Probe:
    """What a flawless video measures; its contact and its untouched picture are its own."""
    rng = np.random.default_rng(derive_seed(video_id))
    contact = rng.normal(size=24 * 18)
    file = {"session": "", "header_frames": 126, "frames": 126, "fps": 25.0, "width": 320, "height": 240}
    more = {"hdr": False, "rotation": 0, "irregular": 1.0, "kept": 37, "saturated": 0.0, "unsteady": 0}
    light = {"brightness": 90.0, "brightness_step": 0.4, "contact": 1.4, "quiet": 0.25, "contact_end": 0.3}
    named = {"video_id": video_id, "object_id": video_id.rpartition("_")[0], "path": f"{video_id}.mov"}
    own = {"sha256": f"sha of {video_id}", "starts_touching": False, "untouched": (0, 2, 4, 6)}
    own |= {"thumbnail": tuple(rng.normal(90, 1, 144)), "signature": tuple(contact / np.linalg.norm(contact))}
    return Probe.model_validate({**file, **more, **light, **named, **own, **changes})


def probes(videos: int = 3, objects: Sequence[str] = OBJECTS) -> list[Probe]:
    return [probe(f"{o}_{i}") for o in objects for i in range(videos)]


def assigned(found: Sequence[Probe], parts: dict[str, Part]) -> list[Assignment]:
    return [
        Assignment(
            video_id=p.video_id, object_id=p.object_id, part=parts.get(p.video_id, parts.get(p.object_id, Part.UNUSED))
        )
        for p in found
    ]


def odd(findings: Sequence[Finding] | Iterator[Finding]) -> list[Finding]:
    return [f for f in findings if f.severity is not INFO]


def of(findings: Sequence[Finding] | Iterator[Finding], check: str) -> list[Finding]:
    return [f for f in findings if f.check == check]


def leaks(found: Sequence[Probe], parts: dict[str, Part], catalogue: Catalogue, **sha256: str) -> list[Finding]:
    found = [p.model_copy(update={"sha256": sha256.get(p.video_id, p.sha256)}) for p in found]
    return list(check_leakage(found, [assigned(found, parts)], catalogue))


def relabelled(catalogue: Catalogue, **changes: object) -> Catalogue:
    """Objects of `catalogue` that all have the same changes."""
    objects = {o: entry.model_copy(update=changes) for o, entry in catalogue.objects.items()}
    return Catalogue(language=catalogue.language, objects=objects)


def recorded(object_id: str, seed: int, sensor: int = 0) -> list[np.ndarray]:
    look = make_sensor(SCENE.width, SCENE.height, sensor)
    scene = make_scene(recipe_of(object_id, PHYSICLEAR, 0), SCENE, int(SCENE.frames), seed)
    return list(render(scene, SCENE, look, seed))


def look_at(path: Path, video_id: str) -> Probe:
    return scanned(path, video_id=video_id).probe
