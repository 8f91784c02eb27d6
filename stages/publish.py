"""Publish the reproduction: on the page over all reports, and in MLflow; a dead server is only a warning."""

import logging
from pathlib import Path

from pipeline.running.stage import stage
from pipeline.tracking.publish import publish
from pipeline.tracking.store import TrackingError

if __name__ == "__main__":
    with stage("publish") as run:
        from pipeline.report.page import write_page

        write_page(Path())
        try:
            print(publish(run.params), flush=True)
        except TrackingError as error:
            logging.getLogger(__name__).warning("%s", error)
