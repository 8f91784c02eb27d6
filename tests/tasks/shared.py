"""What the tests of the tasks share: PhysiCLeAR's objects, and what grades an answer."""

import random
from itertools import islice

from pipeline.core.records import Part, Prediction, Question
from pipeline.tasks import TASKS
from pipeline.tasks.base import Pool
from pipeline.tasks.records import Score
from pipeline.videos.catalogue import Catalogue
from tests.conftest import CATALOGUE as PHYSICLEAR

CATALOGUE = PHYSICLEAR.asking("published")
POOL = Pool(Part.TEST, CATALOGUE, {o: [f"{o}_0"] for o in CATALOGUE.objects})


def predicted(question: Question, *outputs: str, truncated: bool = False) -> Prediction:
    return Prediction(
        question_id=question.question_id, task=question.task, outputs=outputs, truncated=truncated, tokens=1
    )


def grade(question: Question, *outputs: str, truncated: bool = False, catalogue: Catalogue = CATALOGUE) -> list[Score]:
    return TASKS[question.task].grade(question, predicted(question, *outputs, truncated=truncated), catalogue)


def drafted(task: str, pool: Pool, each: int) -> list[Question]:
    """So many questions of every stratum that the pool has any of."""
    definition, rng, questions = TASKS[task], random.Random(0), list[Question]()
    for stratum in range(definition.strata(pool.catalogue)):
        drafts = (definition.draft(pool, stratum, rng) for _ in range(2000))
        for draft in islice(filter(None, drafts), each):
            questions.append(draft.numbered(f"{task}-{len(questions)}", task, pool.part))
    return questions
