"""The variants of each task that are reproduced, with the figures of the paper (Xu et al., CoRL 2022, appendix B)."""

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from gelflow.errors import UsageError
from gelflow.task import INSERTION, PUBLISHED_INSERTION, InsertionTask


@dataclass(frozen=True)
class Published:
    """A figure of the paper."""

    success: float
    spread: float | None = None  # over the seeds
    length: float | None = None  # as `EvaluationResult.length`


@dataclass(frozen=True)
class Variant:
    """A training and its evaluation."""

    name: str
    recipe: str = "default"  # see `gelflow.policies.recipes`
    options: Mapping[str, Any] = field(default_factory=dict)  # of the environments, JSON data
    evaluation: Mapping[str, Any] = field(default_factory=dict)  # options that differ in the evaluation
    trained_as: str | None = None  # the variant whose policies are evaluated; None: its own
    paper: Published | None = None


@dataclass(frozen=True)
class Reproduction:
    """The variants of a task."""

    task: str
    variants: tuple[Variant, ...]
    curve: str = "success"  # of the learning curves: "success" or "reward"
    episodes: int = 1000  # of each evaluation

    def variant(self, name: str) -> Variant:
        """The variant with this name."""
        return next(variant for variant in self.variants if variant.name == name)


_YAW = INSERTION.misalignment[2]
_PUBLISHED = {"descent": PUBLISHED_INSERTION.descent, "frame_depths": [*PUBLISHED_INSERTION.frame_depths]}
_ONLY_XY = {"misalignment": [*INSERTION.misalignment[:2], 0.0], "workspace": [*INSERTION.workspace[:2], 0.0]}
_ONLY_YAW = {"misalignment": [0.0, 0.0, _YAW], "workspace": [0.0, 0.0, INSERTION.workspace[2]]}

_REPRODUCTIONS = (
    Reproduction(
        "grasp",
        (
            Variant("11 blocks", paper=Published(0.985, 0.018, 2.1)),
            Variant("7 blocks", evaluation={"blocks": 7}, trained_as="11 blocks", paper=Published(0.933)),
            Variant("13 blocks", evaluation={"blocks": 13}, trained_as="11 blocks", paper=Published(0.998)),
            Variant("moving load", evaluation={"moving_load": True}, trained_as="11 blocks"),
            Variant("chosen force", "chosen-force"),
            Variant("chosen force, 7 blocks", evaluation={"blocks": 7}, trained_as="chosen force"),
            Variant("chosen force, 13 blocks", evaluation={"blocks": 13}, trained_as="chosen force"),
            Variant("chosen force, moving load", evaluation={"moving_load": True}, trained_as="chosen force"),
        ),
    ),
    Reproduction(
        "cap",
        (
            Variant("as published, touch", "published", paper=Published(0.873)),
            Variant("as published, no touch", "published-no-touch", paper=Published(0.597)),
            Variant("target actions, touch", "paper-observation"),
            Variant("target actions, no touch", "paper-observation-no-touch"),
            Variant("ours, touch"),
            Variant("ours, no touch", "no-touch"),
        ),
    ),
    Reproduction(
        "pushing",
        (
            Variant("privileged", "privileged"),
            Variant("touch and memory"),
            Variant("touch", "paper"),
            Variant("no touch", "no-touch"),
            Variant("touch, PPO", "ppo"),
        ),
        curve="reward",
    ),
    Reproduction(
        "insertion",
        (
            Variant("rotation", options={"task": {**_PUBLISHED, **_ONLY_YAW}}),
            Variant("translation", options={"task": {**_PUBLISHED, **_ONLY_XY}}),
            Variant("rotation and translation", options={"task": _PUBLISHED}),
            Variant("full randomization", options={"randomization": "full", "task": _PUBLISHED}),
            Variant("full randomization, deeper descents", options={"randomization": "full"}),
        ),
    ),
)
REPRODUCTIONS = {entry.task: entry for entry in _REPRODUCTIONS}


def reproduction_for(task: str) -> Reproduction:
    """The reproduction of a task. Raises UsageError for an unknown task."""
    if task not in REPRODUCTIONS:
        raise UsageError(f"no reproduction of {task!r}; there are {', '.join(REPRODUCTIONS)}")
    return REPRODUCTIONS[task]


def insertion_of(variant: Variant) -> InsertionTask:
    """The task description of a variant of the insertion."""
    given = variant.options.get("task", {})
    changes: dict[str, Any] = {name: tuple(v) if isinstance(v, list) else v for name, v in given.items()}
    return dataclasses.replace(INSERTION, **changes)
