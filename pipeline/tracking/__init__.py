"""MLflow: the only package that imports it, and only inside functions, since the import costs seconds.

`live_run` logs a training while it runs; `pipeline.tracking.publishing.publish` makes or completes the runs of a whole
reproduction from what the stages left on disk. It is not imported here, so that a change of publishing is no change
of the code that a training depends on.
"""

from pipeline.tracking.live import live_run

__all__ = ["live_run"]
