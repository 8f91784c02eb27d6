"""Where a base model comes from: a file of an installed package, known by its hash."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from pipeline.core.errors import UserError
from pipeline.core.io import sha256
from pipeline.weights import installed


class Given(NamedTuple):
    """What a base model is made of."""

    source: Path
    """The file or folder with the weights as they were published; the catalogue where they are drawn at random."""
    seed: int
    """Of what is drawn."""


class Origin(NamedTuple):
    """A file of a package."""

    package: str
    version: str
    file: str
    """Its place among the package's files."""
    sha256: str

    def find(self) -> Path:
        """The file; raises UserError where package or file is missing, or where it is another file than was tested."""
        mend = f"install {self.package}=={self.version} anew (`make install`)"
        path = Path(str(installed(self.package).locate_file(self.file)))
        if not path.is_file():
            raise UserError(f"{path} does not exist; {mend}")
        found = sha256(path)
        if found != self.sha256:
            raise UserError(f"{path} has the sha256 {found[:12]}..., not {self.sha256[:12]}...; {mend}")
        return path

    def licence(self) -> Path | None:
        """The text of the licence that the package ships."""
        found = (f for f in installed(self.package).files or () if f.name == "LICENSE")
        return next((Path(str(f.locate())) for f in found), None)
