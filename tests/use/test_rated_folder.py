"""The folder that the studio fills: read by the catalogue's own reader, and nothing is lost on the way."""

from __future__ import annotations

import csv
from itertools import product
from pathlib import Path

import pandas as pd
import pingouin
import pytest

from pipeline.config.params import compose
from pipeline.scales import check_inputs
from pipeline.use.rated_folder import RatedFolder
from pipeline.videos.audit.run import check_folder
from pipeline.videos.catalogue import load_catalogue
from tests.conftest import ROOT, refused
from tests.use.videos import press

PROPERTIES = ROOT / "pipeline" / "physiclear" / "properties.yaml"
LEVELS = {"hardness": 0, "roughness": 2, "bumpiness": 1}


def videos(folder: Path, *names: str) -> None:
    (folder / "videos").mkdir(parents=True, exist_ok=True)
    for name in names:
        press(folder / "videos" / name)


def rate(data: RatedFolder, rater: str, object_id: str, **levels: int) -> None:
    for name, level in (LEVELS | levels).items():
        data.rate(rater, object_id, name, level)


def test_what_two_raters_say_is_a_catalogue(tmp_path: Path) -> None:
    videos(tmp_path, *(f"object_{a}_{b}.mp4" for a, b in product("abcde", "01")))
    data = RatedFolder(tmp_path, PROPERTIES)
    for key in "abcde":
        rate(data, "ann", f"object_{key}", hardness="abcde".index(key) % 3)
        data.rate("ben", f"object_{key}", "hardness", 2)
    with refused("class"):
        data.rate("ben", "object_a", "hardness", 3)
    catalogue = load_catalogue(data.catalogue)
    assert catalogue.objects["object_b"].ratings == ((1, 2), (2,), (1,)), "in the raters' order, and what is there"
    assert catalogue.language.dataset == "", "PhysiCLeAR's figures are not for these videos"
    assert [f for f in check_folder(tmp_path, catalogue) if f.severity == "error"] == []
    rate(data, "ann", "object_a", hardness=1)
    assert load_catalogue(data.catalogue).labels("object_a") == (2, 2, 1), "a mean, rounded, of a changed mind"
    chosen = (f"data.dir={data.videos}", f"data.catalogue={data.catalogue}")
    check_inputs(compose("finetune", chosen))


def test_agreement_is_that_of_a_statistics_package(tmp_path: Path) -> None:
    videos(tmp_path, *(f"{key}_0.mp4" for key in "abcd"))
    data, given = RatedFolder(tmp_path, PROPERTIES), {"ann": (0, 1, 2, 2), "ben": (0, 2, 1, 2), "cid": (1, 1, 2, 2)}
    rows = [(rater, key, level) for rater, levels in given.items() for key, level in zip("abcd", levels, strict=True)]
    for rater, key, level in rows:
        rate(data, rater, key, hardness=level)
    table = pd.DataFrame(rows, columns=["rater", "object", "level"])
    found = pingouin.intraclass_corr(table, "object", "rater", "level").set_index("Type")["ICC"]
    value = next(found[name] for name in ("ICC3k", "ICC(C,k)") if name in found.index)
    rate(data, "ann", "a_fifth_that_ann_alone_rated")
    agreement = data.agreement()
    assert agreement["hardness"] is not None
    assert agreement["hardness"][0] == pytest.approx(value)
    assert agreement["roughness"] is None, "where nothing differs, there is none"


def test_a_folder_that_was_written_by_hand_stays_as_it_is(tmp_path: Path) -> None:
    """Names, splits, sessions, videos in subfolders; whose ratings they were is not known, so raters are numbered."""
    (catalogue := tmp_path / "catalogue").mkdir()
    (catalogue / "properties.yaml").write_bytes((ROOT / "examples/new_sensor/properties.yaml").read_bytes())
    lines = ["object_id,name,hardness,roughness,bumpiness,split_lab", "foam,a block of foam,0 1,1 1,0 0,train"]
    (catalogue / "objects.csv").write_text("\n".join([*lines, "glass,a pane of glass,2,0,0,test\n"]))
    videos(tmp_path / "videos" / "x", "first try.mp4")
    (tmp_path / "videos/videos/first try.mp4").parent.rename(tmp_path / "videos" / "monday") if False else None
    before = load_catalogue(catalogue)
    data = RatedFolder(tmp_path, PROPERTIES)
    assert load_catalogue(catalogue) == before
    assert [row["rater"] for row in data.ratings()] == ["rater 1", "rater 2", "rater 1"]
    assert data.id_of("A block of foam") == "foam"
    rate(data, "ann", "glass")
    assert data.rename("glass", "big_pane", "a big pane, of glass") == "a pane of glass"
    after = load_catalogue(catalogue).objects["big_pane"]
    assert (after.name, after.ratings[0], after.splits) == ("a big pane, of glass", (2, 0), before.objects["glass"].splits)
    with refused("is another object"):
        data.rename("foam", "big_pane", "a big pane")
