"""The networks that mill trains, by name."""

from vision.completion_training import CompletionTask
from vision.keypoint_training import KeypointTask
from vision.training import Task

LANDMARKS = ("bregma", "lambda")


def task_named(name: str) -> Task:
    """``tip``, ``landmarks`` or ``completion``."""
    tasks: dict[str, Task] = {
        "tip": KeypointTask("tip", ("tip",), steps=2000),
        "landmarks": KeypointTask("landmarks", LANDMARKS, steps=3000),
        "completion": CompletionTask(),
    }
    return tasks[name]
