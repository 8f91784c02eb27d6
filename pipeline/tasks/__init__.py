"""The tasks, by name. To add one: write its module beside the others and list it here and in `records.Task`."""

from pipeline.records import Task
from pipeline.tasks.base import TaskDefinition
from pipeline.tasks.opd import ObjectPropertyDescription
from pipeline.tasks.pc import PropertyComparison
from pipeline.tasks.pom import PropertyObjectMatching
from pipeline.tasks.psr import PropertyScenarioReasoning
from pipeline.tasks.pss import PropertySuperlativeSelection

TASKS: dict[Task, TaskDefinition] = {
    t.task: t
    for t in (
        ObjectPropertyDescription(),
        PropertyComparison(),
        PropertySuperlativeSelection(),
        PropertyObjectMatching(),
        PropertyScenarioReasoning(),
    )
}
