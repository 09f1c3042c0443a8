"""The networks that mill trains, by name."""

from drivers.errors import ConfigError
from vision.completion_training import CompletionTask
from vision.keypoint_training import KeypointTask
from vision.landmark_training import LandmarkTask
from vision.paper_recipe import PaperTask
from vision.training import Task

RECIPES = ("default", "paper")


def task_named(name: str, recipe: str = "default") -> Task:
    """``tip``, ``landmarks`` or ``completion``, as ``recipe`` learns it.

    Raises:
        ConfigError: there is no such recipe for this task.
    """
    tasks: dict[tuple[str, str], Task] = {
        ("tip", "default"): KeypointTask("tip", ("tip",), steps=2000),
        ("landmarks", "default"): LandmarkTask(),
        ("completion", "default"): CompletionTask(),
        ("tip", "paper"): PaperTask("tip", ("tip",)),
        ("landmarks", "paper"): PaperTask("landmarks", ("bregma", "lambda")),
    }
    if (name, recipe) not in tasks:
        known = ", ".join(have for task, have in tasks if task == name)
        raise ConfigError(f"--recipe {recipe}: {name} has none; allowed: {known}")
    return tasks[name, recipe]
