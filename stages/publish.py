"""Show the reproduction in MLflow. A dead server is a warning: results do not depend on it."""

import logging

from pipeline.stage import stage
from pipeline.tracking import TrackingError, publish


def main() -> None:
    with stage("publish") as run:
        try:
            print(publish(run.params), flush=True)
        except TrackingError as error:
            logging.getLogger(__name__).warning("%s", error)


if __name__ == "__main__":
    main()
