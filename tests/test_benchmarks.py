"""The benchmark of starting up, on a toy, and its command."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.benchmarks import BenchRow
from pipeline.benchmarks.__main__ import SECTIONS, main
from pipeline.benchmarks.startup import BASELINE, measure, top_imports
from pipeline.errors import UserError


def write_stage(root: Path, text: str) -> Path:
    script = root / "stages" / "toy.py"
    script.parent.mkdir(parents=True, exist_ok=True)
    script.write_text(text)
    return script


def test_only_imports_are_run(tmp_path: Path) -> None:
    script = write_stage(tmp_path, '"""Doc."""\nimport json\nfrom os import path\n\nopen("ran", "w")\n')
    assert top_imports(script) == "import json\nfrom os import path"
    rows = measure(tmp_path, repeats=2, everything="import json")
    assert [row.case for row in rows] == [BASELINE, "starting Python", "stages/toy.py"]
    assert rows[0].ratio == 1
    assert all(row.low <= row.cost <= row.high and row.unit == "s" and row.baseline == BASELINE for row in rows)
    assert not (tmp_path / "ran").exists()


def test_problems_are_one_line(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no script"):
        measure(tmp_path)
    write_stage(tmp_path, "import nothing_of_the_kind")
    with pytest.raises(UserError, match="No module named 'nothing_of_the_kind'"):
        measure(tmp_path, repeats=1, everything="pass")


def test_command_writes_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = BenchRow(case="a", cost=1, unit="s", baseline="a", ratio=1, low=1, high=1)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(SECTIONS, "startup", lambda root: [row])
    main(["startup"])
    written = json.loads((tmp_path / "reports" / "bench" / "startup.json").read_text())
    assert list(written[0]) == ["case", "cost", "unit", "baseline", "ratio", "error", "low", "high"]


@pytest.mark.parametrize("arguments", [[], ["nonsense"], ["startup", "more"]])
def test_unknown_section_names_the_allowed(arguments: list[str]) -> None:
    with pytest.raises(SystemExit, match="allowed sections: startup"):
        main(arguments)
