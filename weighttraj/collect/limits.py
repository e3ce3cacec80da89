"""What a recipe may ask for: checked before any run is begun, all of it at once."""

from __future__ import annotations

import itertools
import reprlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
from gymnasium import spaces

from weighttraj import environments
from weighttraj.collect.ppo import PPOConfig
from weighttraj.collect.settings import SPLITS, Collect, Seeds, Store, read_seeds
from weighttraj.errors import FormatError
from weighttraj.format.schema import check_id
from weighttraj.policies.kernels import kernel_for

_MOST_UNITS = 2**16
_MOST_LAYERS = 100
_MOST_WEIGHTS = 2**28
"""Weights between the hidden layers of a network: 1 GiB of them."""
_MOST_LETTERS = 300
"""Of a value that an error repeats."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Something that a recipe asks for and that cannot be."""

    key: str
    """Where it stands, such as ``ppo.gamma``."""
    expected: str
    """What it could be."""
    got: str
    """What it is."""


@dataclass(frozen=True, kw_only=True)
class _Range:
    """Numbers from ``low`` to ``high``, both included unless ``above``: then ``low`` is not."""

    low: float
    high: float
    above: bool = False

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high and not (self.above and value == self.low)

    def __str__(self) -> str:
        if self.above:
            return f"above {self.low:g}, at most {self.high:g}"
        return f"from {self.low:,g} to {self.high:,.0f}"


# The bounds leave room for everything that trains. Beyond them float32 has only 0 or infinity, or a
# computer no memory.
_POSITIVE = _Range(low=0, high=1e30, above=True)
_RANGES = {
    "total_timesteps": _Range(low=2, high=10**10),
    "n_steps": _Range(low=2, high=2**24),
    "batch_size": _Range(low=2, high=2**24),
    "n_epochs": _Range(low=1, high=10_000),
    "learning_rate": _POSITIVE,
    "gamma": _Range(low=0, high=1),
    "gae_lambda": _Range(low=0, high=1),
    "clip_range": _POSITIVE,
    "clip_range_vf": _POSITIVE,
    "ent_coef": _Range(low=-1000, high=1000),
    "vf_coef": _Range(low=0, high=1000),
    "max_grad_norm": _POSITIVE,
    "adam_eps": _Range(low=1e-30, high=1),
    "log_std_init": _Range(low=-20, high=20),
}


def problems_of(
    name: str, config: PPOConfig, seeds: Seeds, collect: Collect, store: Store
) -> list[Problem]:
    """Return everything that is wrong with the parts of a recipe, if their types are right."""
    found = [*_id_problems(name), *_ppo_problems(config)]
    wrong = {problem.key for problem in found}
    if not wrong & {"ppo.total_timesteps", "ppo.n_steps", "ppo.batch_size", "ppo.n_epochs"}:
        found += _length_problems(config)
        found += _store_problems(store, config)
    population = collect.collector == "population"
    if collect.population < 1:
        found.append(_problem("collect.population", "at least 1", collect.population))
    if population and not wrong & {"ppo.n_steps", "ppo.batch_size"}:
        found += population_problems(config)
    found += _environment_problems(config, population)
    return [*found, *seed_problems(seeds)]


def population_problems(config: PPOConfig) -> Iterator[Problem]:
    """Return what a population cannot do, other than environments."""
    if config.batch_size % 16:
        expected = (
            "a multiple of 16, so that a run's bits do not depend on the runs beside it (other "
            'sizes: collector = "sb3")'
        )
        yield _problem("ppo.batch_size", expected, config.batch_size)
    if config.n_steps % config.batch_size:
        expected = f'a multiple of batch_size = {config.batch_size} (or collector = "sb3")'
        yield _problem("ppo.n_steps", expected, config.n_steps)


def _id_problems(name: str) -> Iterator[Problem]:
    try:
        check_id(name, "id")
    except FormatError:
        expected = "1 to 128 letters, digits, '.', '_' or '-', not starting with '.'"
        yield _problem("id", expected, name)


def _ppo_problems(config: PPOConfig) -> Iterator[Problem]:
    for name, numbers in _RANGES.items():
        value = getattr(config, name)
        if value is not None and value not in numbers:
            yield _problem(f"ppo.{name}", str(numbers), value)
    for name in ("net_arch", "critic_arch"):
        units = getattr(config, name)
        if units is not None and not _is_possible(units):
            expected = (
                f"1 to {_MOST_LAYERS} layers of 1 to {_MOST_UNITS} units, with at most "
                f"{_MOST_WEIGHTS} weights between them"
            )
            yield _problem(f"ppo.{name}", expected, list(units))


def _is_possible(units: tuple[int, ...]) -> bool:
    if not 1 <= len(units) <= _MOST_LAYERS or not 1 <= min(units) <= max(units) <= _MOST_UNITS:
        return False
    return sum(a * b for a, b in itertools.pairwise(units)) <= _MOST_WEIGHTS


def _length_problems(config: PPOConfig) -> Iterator[Problem]:
    if config.total_timesteps < config.n_steps:
        expected = f"at least one rollout, n_steps = {config.n_steps}"
        yield _problem("ppo.total_timesteps", expected, config.total_timesteps)
    if config.batch_size > config.n_steps:
        yield _problem("ppo.batch_size", f"from 2 to n_steps = {config.n_steps}", config.batch_size)


def _store_problems(store: Store, config: PPOConfig) -> Iterator[Problem]:
    steps = config.n_iterations * config.gradient_steps_per_iteration
    if store.every < 1 or store.every > max(1, steps):
        yield _problem("store.every", f"from 1 to the {steps} gradient steps of a run", store.every)
    if not 1 <= store.block <= 2**16:
        yield _problem("store.block", f"at least 1, at most {2**16}", store.block)
    if not 0 <= store.probe_observations <= config.n_steps:
        expected = f"from 0 to n_steps = {config.n_steps}"
        yield _problem("store.probe_observations", expected, store.probe_observations)


def _environment_problems(config: PPOConfig, population: bool) -> Iterator[Problem]:
    try:
        env = environments.make(config.env_id)
    except Exception as error:  # also from the code of the environment's author
        expected = (
            "an id in gymnasium's registry, such as InvertedPendulum-v4, of an environment that "
            "can be made (--import MODULE imports one that registers yours)"
        )
        yield _problem("ppo.env_id", expected, f"{config.env_id!r}: {error.__cause__ or error}")
        return
    expected = _misfit(env, config, population)
    env.close()
    if expected:
        yield _problem("ppo.env_id", expected, config.env_id)


def _misfit(env: gym.Env[Any, Any], config: PPOConfig, population: bool) -> str:
    """Return what the environment should be and is not; empty: it fits."""
    seen, done = env.observation_space, env.action_space
    if population and kernel_for(env) is None:
        return (
            "for a population, one of Gymnasium's planar MuJoCo environments, which have batched "
            'physics (other environments: collector = "sb3")'
        )
    if config.normalization != "none" and not isinstance(seen, spaces.Box):
        return f'one with array observations, not {seen} (or normalization = "none")'
    known = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    if not isinstance(seen, known) or not isinstance(done, known):
        return f"one whose observations and actions SB3's MlpPolicy takes, not {seen} and {done}"
    return ""


def seed_problems(seeds: Seeds) -> Iterator[Problem]:
    """Return what is wrong with the seeds of the splits."""
    first: dict[int, str] = {}
    for split in SPLITS:
        value = getattr(seeds, split)
        try:
            numbers = read_seeds(value)
        except ValueError as error:
            yield _problem(f"seeds.{split}", str(error), value)
            continue
        for seed in numbers:
            if seed in first:
                expected = (
                    "each seed once, in one split: a run that is trained on cannot be tested on"
                )
                both = f"seed {seed} in {first[seed]} and in {split}"
                yield Problem(key=f"seeds.{split}", expected=expected, got=both)
                break
            first[seed] = split


def _problem(key: str, expected: str, value: Any) -> Problem:
    return Problem(key=key, expected=expected, got=_text(value))


def _text(value: Any) -> str:
    """Return a value in a line, shortened."""
    if isinstance(value, str):
        return value if len(value) <= _MOST_LETTERS else f"{value[:_MOST_LETTERS]}..."
    return str(value) if isinstance(value, float) else reprlib.repr(value)
