"""The address of the table of all variants, which `make dashboard` says."""

import sys

from pipeline.config.params import load_params
from pipeline.tracking.publish import TABLE
from pipeline.tracking.store import Store


def main(port: str) -> None:
    """Print it."""
    here = load_params().tracking.model_copy(update={"uri": ""})  # `make dashboard` shows the folder's own database.
    print(f"http://127.0.0.1:{port}/{TABLE.format(Store(here).experiment)}")


if __name__ == "__main__":
    main(sys.argv[1])
