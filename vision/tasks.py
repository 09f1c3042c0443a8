"""The networks that mill trains, by name."""

from vision.completion_training import CompletionTask
from vision.keypoint_training import KeypointTask
from vision.landmark_training import LandmarkTask
from vision.paper_completion import PaperCompletionTask
from vision.paper_recipe import PaperTask
from vision.training import Task

RECIPES = ("default", "paper")


def task_named(name: str, recipe: str = "default") -> Task:
    """``tip``, ``landmarks`` or ``completion``, as one of ``RECIPES`` learns it."""
    tasks: dict[tuple[str, str], Task] = {
        ("tip", "default"): KeypointTask("tip", ("tip",), steps=2000),
        ("landmarks", "default"): LandmarkTask(),
        ("completion", "default"): CompletionTask(),
        ("tip", "paper"): PaperTask("tip", ("tip",)),
        ("landmarks", "paper"): PaperTask("landmarks", ("bregma", "lambda")),
        ("completion", "paper"): PaperCompletionTask(),
    }
    return tasks[name, recipe]
