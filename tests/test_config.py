"""Scales: each shipped one is valid, and a wrong value is named with its key and what is allowed."""

import shutil
from contextlib import nullcontext
from pathlib import Path

import pytest
from pydantic import ValidationError

from pipeline.config import TrackingConfig
from pipeline.config.params import load_params
from pipeline.core.io import write_json
from pipeline.encoder.recipes import RECIPES
from pipeline.language.start import objects_met
from pipeline.running.errors import UserError, without_secrets
from pipeline.scales import check_inputs, compose, prune, scale_names, write_params
from pipeline.scales.memory import read_shapes
from pipeline.videos.split import assign_objects
from tests.conftest import CATALOGUE, ROOT, refused

CONF = ROOT / "conf"


@pytest.mark.parametrize("scale", scale_names(CONF))
def test_shipped_scale_is_valid_and_survives_writing(scale: str, tmp_path: Path) -> None:
    params = compose(scale, conf=CONF)
    assert write_params(params, tmp_path / "params.yaml")
    assert load_params(tmp_path / "params.yaml") == params
    assert not write_params(params, tmp_path / "params.yaml"), "an unchanged file is not written again"


def test_committed_params_are_written_as_they_are(tmp_path: Path) -> None:
    """Else `octopi scale smoke` would run stages anew whose sections have gained a key."""
    write_params(compose("smoke", conf=CONF), tmp_path / "params.yaml")
    assert (tmp_path / "params.yaml").read_text() == (ROOT / "params.yaml").read_text()


def test_a_broken_params_file_is_written_anew(tmp_path: Path) -> None:
    """Whatever stands there, by the command that the line of its refusal names; tests/chain has the lines."""
    (path := tmp_path / "params.yaml").write_bytes(b"\xff\xfes")
    assert write_params(compose("smoke", conf=CONF), path)
    assert load_params(path) == compose("smoke", conf=CONF)


ADDRESSES = {
    "http://ada:S3cret@host:5000/x": "http://***@host:5000/x",
    "https://S3cret@host": "https://***@host",
    "https://ada:S3cret/c@host/x": "https://***@host/x",
    "postgresql+psycopg2://ada:S3cret/S3cret@host/db": "postgresql+psycopg2://***@host/db",
    "postgresql:///db?user=ada&password=S3cret": "postgresql:///db?user=ada&password=***",
    **{a: a for a in ("http://host:5000/a@b", "postgresql://ada@host/db", "sqlite:////a:b@c/d.db", "sqlite:///x")},
}
"""An address, and what is shown of it."""


@pytest.mark.parametrize("address", list(ADDRESSES))
def test_no_password_of_an_address_is_printed_or_a_parameter(address: str) -> None:
    shown = ADDRESSES[address]
    assert without_secrets(f"at '{address}', {address}") == f"at '{shown}', {shown}"
    assert str(UserError(f"{address} is away")) == f"{shown} is away"
    mend = pytest.raises(ValidationError, match="MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD")
    with nullcontext() if address == shown else mend:
        TrackingConfig(uri=address)


def test_no_error_repeats_a_password(tmp_path: Path) -> None:
    address = next(iter(ADDRESSES))
    plain = compose("smoke", conf=CONF)
    params = plain.model_copy(update={"tracking": plain.tracking.model_copy(update={"uri": address})})
    write_params(params, tmp_path / "params.yaml")
    for read in (
        lambda: load_params(tmp_path / "params.yaml"),
        lambda: compose("smoke", [f"tracking.uri={address}"], conf=CONF),
        # As YAML and Hydra cannot read it, and say what they could not.
        lambda: compose("smoke", [f"tracking.uri='{address}"], conf=CONF),
        lambda: compose("smoke", [f"tracking.uri=[{address}]"], conf=CONF),
    ):
        with pytest.raises(UserError) as caught:
            read()
        assert "S3cret" not in str(caught.value)


@pytest.mark.parametrize(
    "name",
    ["my data", "a[1]", "{x}", "a,b", "a=b", "a&b#c", "it's", '"said"', "Prüfling", "back\\slash", "end\\", "$x"],
)
def test_any_folder_may_hold_the_videos(name: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    params = compose("small", ["data.source=videos", f"data.dir={folder}"], conf=CONF)
    assert params.data.dir == str(folder)
    write_params(params, tmp_path / "params.yaml")
    assert load_params(tmp_path / "params.yaml").data.dir == str(folder)


TRAINED = "baseball,pillow,rug,potato,millet"


# Further ones take the whole way in tests/chain/test_bad_inputs.py.
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("smoke nothing=1", "nothing.*allowed here"),
        ("smoke frames.per_video=0", "frames.per_video.*greater than or equal to 1"),
        ("smoke split.fold=1", "split.fold is not a parameter.*folds"),
        ("smoke split.name=kfold split.folds=3 ablation.seeds=[0,1,3]", r"ablation.seeds \[0, 1, 3\].*3 folds"),
        ("smoke ablation.opd=[none]", "ablation.opd.*lacks the full system's value all"),
        ("smoke encoder.epochs=true", "encoder.epochs is True: .*valid integer"),
        ("smoke encoder.backbone=[timm] encoder.recipe=paper", "encoder.recipe=paper is for CLIP alone"),
        ("smoke frames.pixels=48", "frames.pixels"),
        ("smoke cross_validation.folds=3", "cross_validation is not a parameter"),
        ("smoke split.name=development", "split.name=development is no split of the catalogue; allowed: paper"),
        ("small data.source=videos data.dir=nowhere", "data.dir: nowhere does not exist"),
        ("smoke language.weights=nowhere", "hf download lmsys"),
        ("smoke language.start=models/nothing", "language.start: models/nothing holds no trained model"),
        ("smoke scenes.objects=[unicorn] split.name=kfold", r"scenes.objects: unicorn .*; \[\] takes all"),
        (f"smoke scenes.objects=[{TRAINED},bath_towel]", "ablation.touch: swapped .* only bath_towel"),
        (f"smoke scenes.objects=[{TRAINED},bath_towel] ablation.touch=[removed]", ""),
        (f"smoke scenes.objects=[{TRAINED},bath_towel,ice_block]", ""),
        (f"smoke scenes.objects=[{TRAINED}]", ""),
        ("smoke scenes.objects=[baseball,pillow,millet,bath_towel,ice_block]", "2 training objects"),
        ("smoke scenes.objects=[bath_towel,ice_block]", "no video of a training object"),
    ],
)
def test_what_cannot_run_is_one_line_with_key_and_mend(
    arguments: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What has no words can."""
    monkeypatch.chdir(ROOT)
    name, *overrides = arguments.split()
    with refused(words) if words else nullcontext():
        params = compose(name, overrides)
        read_shapes(params)
        check_inputs(params)


@pytest.mark.parametrize("listed", [True, False])
def test_a_model_that_met_a_test_object(listed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By its config.json, or for older folders by its catalogue. Another fold's model met this fold's test objects."""
    monkeypatch.chdir(ROOT)
    (tmp_path / "language").mkdir()
    folds = ["split.name=kfold", "split.folds=3", "scenes.objects=[]", f"language.start={tmp_path}"]
    first, second = (compose("smoke", [*folds, f"ablation.seeds=[{seed}]"]) for seed in (0, 1))
    objects = CATALOGUE
    parts = assign_objects(objects, objects.objects, first.split, 0)
    write_json(tmp_path / "config.json", {"objects": objects_met("", parts)} if listed else {})
    write_json(tmp_path / "catalogue.json", objects.model_dump(mode="json"))
    with nullcontext() if listed else refused("knows [a-z_]+, which is a test object"):
        check_inputs(first)
    with refused("knows [a-z_]+, which is a test object; name a model that does not"):
        check_inputs(second)


def test_prune_keeps_what_params_name_and_removes_the_rest(tmp_path: Path) -> None:
    params = compose("smoke", conf=CONF)
    kept = {"models/with/base-all-0", "answers/finetuned-with-all-0"}
    for name in (*kept, "models/without/base-all-1", "answers/old", "encoder/3"):
        (tmp_path / "data" / name).mkdir(parents=True)
    stray = tmp_path / "data" / "answers" / ".DS_Store"
    stray.touch()
    prune(params, tmp_path)
    assert stray.is_file(), "it is no variant's"
    left = {str(p.relative_to(tmp_path / "data")) for p in tmp_path.rglob("*") if p.is_dir() and not list(p.iterdir())}
    assert left == kept | {"models/without", "encoder"}
    shutil.rmtree(tmp_path)
    prune(params, tmp_path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("defaults: [small, _self_]\nscale: mine\nlora: {rank: 4}\n", ""),
        ("defaults: [small, _self_]\n", "it calls itself small, and would replace its reports; write scale: mine"),
        ("scale: mine\nscale: other\n", "scale mine: "),
    ],
)
def test_a_scale_of_ones_own_is_a_file_which_is_checked(text: str, words: str, tmp_path: Path) -> None:
    conf = Path(shutil.copytree(CONF, tmp_path / "conf"))
    (conf / "mine.yaml").write_text(text)
    assert {*scale_names(conf)} == {*scale_names(CONF), "mine"}
    with refused(words) if words else nullcontext():
        params = compose("mine", conf=conf)
        assert (params.scale, params.lora.rank, params.report_name) == ("mine", 4, "mine-scenes")


def test_a_recipe_brings_its_settings_and_gives_way_to_yours() -> None:
    smoke = compose("smoke", conf=CONF)
    for recipe in RECIPES:
        composed = compose("smoke", [f"encoder.recipe={recipe}"], conf=CONF)
        assert composed.encoder.recipe == recipe
        own = {"bos": False, "chat": "published"} if recipe == "release" else {}
        assert composed.language == smoke.language.model_copy(update=own)
        settings = ("all", 0.0) if recipe == "release" else ("new", 1.0)
        assert (composed.align.train_embeddings, composed.lora.max_grad_norm) == settings
        assert composed.encoder.backbone == ("clip",)
    yours = ["encoder.recipe=release", "encoder.backbone=[clip]", "encoder.epochs=3"]
    own = compose("small", yours, conf=CONF).encoder
    assert (own.epochs, own.batch_size) == (3, 4)
