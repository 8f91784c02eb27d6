"""Measure what can be trusted in the data; errors stop the chain here."""

from pathlib import Path

from pipeline.core.io import read_table, write_csv, write_text
from pipeline.core.layout import AUDIT, FRAMES
from pipeline.running.stage import stage
from pipeline.videos.catalogue import load_catalogue
from pipeline.videos.records import Finding, Probe
from pipeline.videos.split import read_splits

if __name__ == "__main__":
    with stage("audit") as run:
        from pipeline.videos.audit.run import AUDIT_FILE, audit_chain, stop_on_errors, summary
        from pipeline.videos.frames.store import PROBES_FILE

        findings = audit_chain(
            Path(run.params.data.dir),
            read_table(FRAMES / PROBES_FILE, Probe),
            list(read_splits(run.params.split, run.params.ablation.seeds).values()),
            load_catalogue(Path(run.params.data.catalogue)),
        )
        write_csv(AUDIT / AUDIT_FILE, Finding, findings)
        stop_on_errors(findings, AUDIT / AUDIT_FILE)
        # What later stages depend on: always the same bytes, so that a new warning retrains nothing.
        write_text(AUDIT / "passed", "no errors\n")
        run.metrics.update(summary(findings))
