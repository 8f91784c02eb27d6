"""A trained model of random weights, made once."""

from pathlib import Path

import pytest

from pipeline.core.records import Encoder, Lora, Opd, Variant
from pipeline.use.model import Octopi
from tests.use.shared import Made, configured, make


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    where = tmp_path_factory.mktemp("use")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(where)
        return make(where, Variant(Encoder.FINETUNED, Lora.WITH, Opd.ALL, 0))


@pytest.fixture(scope="session")
def octopi(made: Made) -> Octopi:
    """As one whose videos, which are files here, are a real sensor's."""
    return configured(Octopi.from_pretrained(made.folder, device="cpu"), made, trained_on="videos")


@pytest.fixture
def files(made: Made) -> list[Path]:
    """Videos of objects that were not trained on."""
    return [made.videos / f"{name}_0.avi" for name in ("ice_block", "millet", "bath_towel")]
