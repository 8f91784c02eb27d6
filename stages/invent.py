"""Write a catalogue of invented objects, where `data.catalogue` names it; otherwise leave an empty folder."""

from pathlib import Path

from pipeline.core.layout import INVENTED
from pipeline.running.stage import stage

if __name__ == "__main__":
    with stage("invent") as run:
        from pipeline.scenes.invented import write_catalogue

        INVENTED.mkdir(parents=True, exist_ok=True)
        if Path(run.params.data.catalogue) == INVENTED:
            write_catalogue(run.params.invent, INVENTED)
            run.metrics["objects"] = run.params.invent.objects
