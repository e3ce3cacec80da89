"""A recipe: everything that a data set is made from, in one TOML file."""

from __future__ import annotations

import dataclasses
import difflib
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from weighttraj.collect.limits import Problem, problems_of, seed_problems
from weighttraj.collect.ppo import PPOConfig
from weighttraj.collect.settings import Collect, Seeds, Store
from weighttraj.collect.toml_lines import line_of
from weighttraj.errors import RecipeError


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Everything that a data set is made from."""

    id: str
    """Id of the data set, ``<env>-<algorithm>-v<N>``."""
    version: str = "1"
    """Version of the data."""
    licence: str = "CC-BY-4.0"
    """Licence of the data."""
    ppo: PPOConfig = field(default_factory=PPOConfig)
    """Environment, network and PPO."""
    seeds: Seeds = field(default_factory=Seeds)
    """Seeds, by split."""
    collect: Collect = field(default_factory=Collect)
    """Who trains."""
    store: Store = field(default_factory=Store)
    """What is stored."""

    @property
    def n_snapshots(self) -> int:
        """Number of snapshots of each run, the first and the last included."""
        steps = self.ppo.n_iterations * self.ppo.gradient_steps_per_iteration
        return 1 + -(-steps // self.store.every)

    def splits(self) -> dict[int, str]:
        """Return the split of each seed.

        Raises:
            RecipeError: there are no such seeds, or a seed is in two splits.
        """
        _refuse(list(seed_problems(self.seeds)), f"recipe {self.id!r}")
        return {seed: split for split, seeds in self.seeds.by_split().items() for seed in seeds}

    def check(self, where: object = None) -> None:
        """Check that there can be such runs, before any is begun.

        Args:
            where: what an error names as the place; None: the recipe's id.

        Raises:
            RecipeError: there cannot; all that is wrong is said at once.
        """
        where = where or f"recipe {self.id!r}"
        _convert(dataclasses.asdict(self), lambda _: where)
        _refuse(self.problems(), where)

    def problems(self) -> list[Problem]:
        """Return everything that is wrong with the values, if their types are right."""
        return problems_of(self.id, self.ppo, self.seeds, self.collect, self.store)


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe.

    Raises:
        FileNotFoundError: there is no such file.
        RecipeError: it is no TOML, has unknown keys, values of the wrong type or impossible ones;
            the lines are named.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise RecipeError(
            "the recipe is no TOML", got=error, where=path, do="correct the file"
        ) from error
    _check_keys(document, Recipe, path, text)
    ppo = document.get("ppo")
    if isinstance(ppo, dict) and ppo.get("clip_range_vf") is False:
        ppo["clip_range_vf"] = None  # TOML has no null
    recipe = _convert(document, lambda key: _place(path, text, key))
    _refuse(recipe.problems(), path, text)
    return recipe


def _convert(document: dict[str, Any], where: Callable[[str], object]) -> Recipe:
    """Return a recipe whose values have the right types; where: the place of a key, for errors."""
    try:
        return msgspec.convert(document, Recipe)
    except (ValueError, OverflowError) as error:
        key = re.search(r"\$\.([\w.]+)", str(error))
        raise RecipeError(
            "the recipe has a value of the wrong type",
            got=error,
            where=where(key[1] if key else ""),
            do="correct this value",
        ) from error


def _refuse(problems: list[Problem], where: object, text: str = "") -> None:
    """Raise RecipeError if there are problems, with their lines in the recipe's text."""

    def told(problem: Problem) -> str:
        line = line_of(text, problem.key)
        return f"{problem.key} = {problem.got}" + (f" (line {line})" if line else "")

    if problems:
        raise RecipeError(
            "the recipe has impossible values",
            expected="; ".join(f"{problem.key} {problem.expected}" for problem in problems),
            got="; ".join(map(told, problems)),
            where=where,
            do="correct these keys",
        )


def _place(path: Path, text: str, key: str) -> str:
    line = line_of(text, key)
    return f"{path}, line {line}" if line else str(path)


def _check_keys(table: dict[str, Any], kind: type, path: Path, text: str, prefix: str = "") -> None:
    fields = {f.name: f for f in dataclasses.fields(kind)}
    for key, value in table.items():
        if key not in fields:
            near = difflib.get_close_matches(key, fields, n=1)
            raise RecipeError(
                "the recipe has a key that nothing reads",
                expected=sorted(fields),
                got=repr(key),
                where=_place(path, text, f"{prefix}{key}"),
                do=f"did you mean {near[0]!r}?" if near else "remove it",
            )
        part: Any = fields[key].default_factory
        if isinstance(value, dict) and part in (PPOConfig, Seeds, Collect, Store):
            _check_keys(value, part, path, text, f"{prefix}{key}.")
