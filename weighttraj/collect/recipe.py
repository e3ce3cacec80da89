"""A recipe: everything that a data set is made from, in one TOML file."""

from __future__ import annotations

import dataclasses
import difflib
import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec

from weighttraj.collect.ppo import PPOConfig
from weighttraj.errors import RecipeError
from weighttraj.format.schema import Profile

SPLITS = ("train", "validation", "test")


@dataclass(frozen=True, kw_only=True)
class Seeds:
    """Seeds of each split: a list, or ranges such as ``"0:30"`` (the end excluded)."""

    train: list[int] | str = field(default_factory=list)
    """Runs that models are trained on."""
    validation: list[int] | str = field(default_factory=list)
    """Runs that choices are made on."""
    test: list[int] | str = field(default_factory=list)
    """Runs that only results are computed on."""

    def by_split(self) -> dict[str, list[int]]:
        """The seeds of each split, ranges written out."""
        return {name: parse_seeds(getattr(self, name)) for name in SPLITS}


@dataclass(frozen=True, kw_only=True)
class Collect:
    """Who trains."""

    collector: Literal["sb3", "population"] = "sb3"
    """``sb3``: Stable-Baselines3, any environment, a run at a time. ``population``: the same
    training of many seeds at once, several times as fast, for Gymnasium's MuJoCo environments."""
    population: int = 16
    """Runs that a population trains at once; more or fewer give the same bytes."""

    @property
    def block(self) -> int:
        """Runs that one process makes at once."""
        return self.population if self.collector == "population" else 1


@dataclass(frozen=True, kw_only=True)
class Store:
    """What is stored, and how often."""

    every: int = 64
    """Gradient steps from one snapshot to the next."""
    critic: bool = False
    """Store the critic's parameters."""
    optimizer_moments: bool = False
    """Store Adam's moments of the policy's parameters."""
    probe_observations: int = 64
    """Network inputs kept of each rollout."""
    block: int = 64
    """Snapshots in a chunk and in a commit."""
    profile: Profile = "default"
    """How a finished run is packed: ``default``, or ``archive``, the smallest."""


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

    def splits(self) -> dict[int, str]:
        """The split of each seed.

        Raises:
            RecipeError: a seed is in two splits.
        """
        found: dict[int, str] = {}
        for split, seeds in self.seeds.by_split().items():
            for seed in seeds:
                if seed in found:
                    raise RecipeError(
                        "a seed is named twice",
                        expected="each seed once, in one split",
                        got=f"seed {seed} in {found[seed]} and in {split}",
                        where=f"[seeds] of recipe {self.id!r}",
                        do="remove one; a run that is trained on cannot be tested on",
                    )
                found[seed] = split
        return found

    def check(self) -> None:
        """Check that there can be such runs, before any is begun.

        Raises:
            RecipeError: there cannot; all that is wrong is said at once.
        """
        ppo, store = self.ppo, self.store
        units = (*ppo.net_arch, *(ppo.critic_arch or (1,)))
        steps = ppo.total_timesteps // max(1, ppo.n_steps) * ppo.n_epochs
        steps *= -(-ppo.n_steps // max(1, ppo.batch_size))
        holds = {
            "ppo.net_arch": (bool(ppo.net_arch) and min(units) >= 1, "layers of at least 1 unit"),
            "ppo.n_steps": (ppo.n_steps >= 2, "at least 2"),
            "ppo.total_timesteps": (
                ppo.total_timesteps >= max(1, ppo.n_steps),
                f"at least one rollout, n_steps = {ppo.n_steps}",
            ),
            "ppo.batch_size": (2 <= ppo.batch_size <= ppo.n_steps, "from 2 to n_steps"),
            "ppo.n_epochs": (ppo.n_epochs >= 1, "at least 1"),
            "ppo.learning_rate": (ppo.learning_rate > 0, "above 0"),
            "ppo.gamma": (0 <= ppo.gamma <= 1, "from 0 to 1"),
            "ppo.gae_lambda": (0 <= ppo.gae_lambda <= 1, "from 0 to 1"),
            "collect.population": (self.collect.population >= 1, "at least 1"),
            "store.every": (
                store.every >= 1 and (store.every <= steps or not steps),
                f"from 1 to the {steps} gradient steps of a run",
            ),
            "store.block": (store.block >= 1, "at least 1"),
            "store.probe_observations": (
                0 <= store.probe_observations <= ppo.n_steps,
                "from 0 to n_steps",
            ),
        }
        wrong = {name: expected for name, (fine, expected) in holds.items() if not fine}
        if wrong:
            raise RecipeError(
                "there can be no such runs",
                expected=", ".join(f"{name} {expected}" for name, expected in wrong.items()),
                got=", ".join(f"{name} = {self._value(name)}" for name in wrong),
                where=f"recipe {self.id!r}",
            )
        self.splits()

    def _value(self, name: str) -> Any:
        table, _, key = name.partition(".")
        return getattr(getattr(self, table), key)


def read_recipe(path: str | Path) -> Recipe:
    """Read a recipe.

    Raises:
        FileNotFoundError: there is no such file.
        RecipeError: it is no TOML, has unknown keys, values of the wrong type or impossible ones.
    """
    path = Path(path)
    try:
        document = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise RecipeError("the recipe is no TOML", got=error, where=path) from error
    _check_keys(document, Recipe, str(path))
    ppo = document.get("ppo")
    if isinstance(ppo, dict) and ppo.get("clip_range_vf") is False:
        ppo["clip_range_vf"] = None  # TOML has no null
    try:
        recipe = msgspec.convert(document, Recipe)
    except msgspec.ValidationError as error:
        raise RecipeError(
            "the recipe has a value of the wrong type", got=error, where=path
        ) from error
    recipe.check()
    return recipe


def parse_seeds(seeds: list[int] | str) -> list[int]:
    """Return seeds from a list, a range, or several ranges with commas between them.

    >>> parse_seeds("3:6")
    [3, 4, 5]
    >>> parse_seeds("0:2,30,40:42")
    [0, 1, 30, 40, 41]

    Raises:
        RecipeError: if it is no such range, or a seed is negative.
    """
    try:
        if isinstance(seeds, str):
            seeds = [seed for part in seeds.split(",") for seed in _parse_range(part)]
        if min(seeds, default=0) < 0:
            raise ValueError
    except ValueError as error:
        raise RecipeError(
            "invalid seeds",
            expected='a list of integers from 0, a range such as "0:30" (the end excluded), or '
            'several with commas between them, such as "0:4,30"',
            got=repr(seeds),
        ) from error
    return seeds


def _parse_range(text: str) -> range:
    start, _, stop = text.partition(":")
    return range(int(start), int(stop or int(start) + 1))


def _check_keys(table: dict[str, Any], kind: type, where: str) -> None:
    fields = {f.name: f for f in dataclasses.fields(kind)}
    for key, value in table.items():
        if key not in fields:
            near = difflib.get_close_matches(key, fields, n=1)
            raise RecipeError(
                "the recipe has a key that nothing reads",
                expected=sorted(fields),
                got=repr(key),
                where=where,
                do=f"did you mean {near[0]!r}?" if near else "remove it",
            )
        part: Any = fields[key].default_factory
        if isinstance(value, dict) and part in (PPOConfig, Seeds, Collect, Store):
            _check_keys(value, part, f"{where}, [{key}]")
