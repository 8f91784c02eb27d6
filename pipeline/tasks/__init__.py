"""The tasks, by name. To add one: write its module beside the others and name it in `MODULES`."""

from importlib import import_module

from pipeline.tasks.base import TaskDefinition

MODULES = ("opd", "pc", "pss", "pom", "psr", "ripeness")
"""One module a task, in the order of tables; each defines `TASK`."""

TASKS: dict[str, TaskDefinition] = {t.name: t for t in (import_module(f"{__name__}.{m}").TASK for m in MODULES)}
