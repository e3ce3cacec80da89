"""Populations: SB3's own training, many seeds at once, and nothing of it depends on the company."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback

import weighttraj as wt
from weighttraj.collect import (
    PPOConfig,
    Recipe,
    WeightTrajectoryCallback,
    collect,
    make_ppo,
    population,
)
from weighttraj.collect.learners import Rollout
from weighttraj.collect.normalizers import find_normalizers
from weighttraj.collect.population import Population, draw_normal, origins_of
from weighttraj.collect.ppo import make_vec_env
from weighttraj.collect.rollouts import Environments
from weighttraj.collect.settings import Collect, Seeds, Store

EVERYTHING = Store(every=16, critic=True, optimizer_moments=True, probe_observations=4)
PENDULUM = Recipe(
    id="pendulum",
    ppo=PPOConfig(total_timesteps=3 * 512, n_steps=512, n_epochs=4),
    seeds=Seeds(train=[1, 0]),
    collect=Collect(collector="population"),
    store=EVERYTHING,
)
# Chaotic: a difference in the last bit of one number is everywhere after some hundred steps.
CHEETAH = PPOConfig(
    env_id="HalfCheetah-v4",
    net_arch=(16, 9),
    critic_arch=(24, 7),
    total_timesteps=3 * 256,
    n_steps=256,
    n_epochs=2,
)
# As rl-zoo3 tunes PPO: everything that CleanRL does otherwise. An episode is cut off at 50 steps.
TUNED = Recipe(
    id="reacher",
    ppo=PPOConfig(
        env_id="Reacher-v4",
        net_arch=(16, 9),
        critic_arch=(24, 7),
        activation="relu",
        ortho_init=False,
        log_std_init=-2.0,
        total_timesteps=3 * 160,
        n_steps=160,
        batch_size=32,
        n_epochs=4,
        learning_rate=1e-3,
        anneal_learning_rate=False,
        clip_range=0.1,
        clip_range_vf=None,
        ent_coef=4e-4,
        max_grad_norm=0.8,
        normalization="vecnormalize",
        truncation_as_termination=False,
    ),
    seeds=Seeds(train=[1, 0]),
    collect=Collect(collector="population"),
    store=EVERYTHING,
)
BARE = replace(TUNED, ppo=replace(TUNED.ppo, normalization="none", activation="tanh"))
BOOTSTRAPPED = replace(TUNED, ppo=replace(TUNED.ppo, normalization="gymnasium"))


def of_seed(dataset: wt.Dataset, seed: int) -> wt.Run:
    (run,) = dataset.select(seed=seed)
    return run


def distance(weights: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Norm of the difference, relative to the weights and to what training has moved them."""
    apart = np.linalg.norm(weights[-1] - other[-1])
    moved = np.linalg.norm(other[-1] - other[0])
    return float(apart / np.linalg.norm(other[-1])), float(apart / moved)


# Fidelity: the run of a seed is SB3's


@pytest.fixture(
    scope="module",
    params=[PENDULUM, TUNED, BARE, BOOTSTRAPPED],
    ids=["cleanrl", "tuned", "bare", "bootstrapped"],
)
def pair(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[wt.Run, wt.Run]:
    """The same seed trained in a population and by SB3."""
    recipe: Recipe = request.param
    folder = tmp_path_factory.mktemp("pair")
    torch.set_num_threads(1)
    ours = of_seed(collect(recipe, folder / "ours"), 1)
    options: dict[str, Any] = {n: v for n, v in vars(EVERYTHING).items() if n != "profile"}
    callback = WeightTrajectoryCallback(folder / "seed0001.zarr", **options)
    config = recipe.ppo
    make_ppo(config, seed=1).learn(config.total_timesteps, callback=callback)
    return ours, wt.open_run(folder / "seed0001.zarr")


def test_the_weights_are_those_of_sb3(pair: tuple[wt.Run, wt.Run]) -> None:
    ours, theirs = pair
    assert np.array_equal(ours.weights[0], theirs.weights[0])
    assert max(distance(ours.weights[:], theirs.weights[:])) < 1e-5
    assert max(distance(ours["critic/weights"][:], theirs["critic/weights"][:])) < 1e-5
    moved = np.abs(np.diff(theirs.weights[:], axis=0)).sum(axis=1)
    assert (moved > 0).all()


def test_the_stores_have_the_same_arrays_and_rows(pair: tuple[wt.Run, wt.Run]) -> None:
    ours, theirs = pair
    assert set(ours.arrays) == set(theirs.arrays)
    for name in ours.arrays:
        mine, other = ours[name][:], theirs[name][:]
        assert mine.dtype == other.dtype, name
        if name.startswith("index/") or name.endswith("/count"):
            assert np.array_equal(mine, other, equal_nan=True), name
        elif name.startswith(("obs_norm", "ret_norm")):
            np.testing.assert_allclose(mine, other, rtol=1e-6, atol=1e-6, err_msg=name)
        elif name != "digest":
            np.testing.assert_allclose(mine, other, rtol=1e-3, atol=1e-5, err_msg=name)


def test_the_record_says_who_collected(pair: tuple[wt.Run, wt.Run]) -> None:
    ours, theirs = pair
    assert ours.info.algorithm is not None
    assert theirs.info.algorithm is not None
    mine, other = asdict(ours.info.algorithm), asdict(theirs.info.algorithm)
    sb3 = other.pop("library")
    assert sb3.startswith("stable-baselines3 ")
    assert mine.pop("library") == f"weighttraj's population, as {sb3}"
    assert mine == other
    for name in ("layout", "policy", "env", "seed", "cadence", "obs_norm", "diagnostics"):
        assert getattr(ours.info, name) == getattr(theirs.info, name), name
    assert wt.verify(ours.path) == []
    observation = np.linspace(-0.3, 0.4, *ours.info.policy.observation_shape)
    mine, other = (run.load_policy().predict(observation, deterministic=True) for run in pair)
    np.testing.assert_allclose(mine[0], other[0], rtol=1e-4, atol=1e-6)


class Rollouts(BaseCallback):
    """Keeps what SB3 learned from, and what it made of it."""

    def __init__(self) -> None:
        super().__init__()
        self.rollouts: list[Rollout] = []
        self.shuffles: list[Any] = []
        self.weights: list[np.ndarray] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        self.weights.append(parameters_of(self.model))

    def _on_rollout_end(self) -> None:
        buffer: Any = self.model.rollout_buffer  # type: ignore[attr-defined]
        names = ("observations", "actions", "log_probs", "values", "advantages", "returns")
        values = {name: getattr(buffer, name).swapaxes(0, 1).copy() for name in names}
        self.rollouts.append(Rollout(**{n: torch.from_numpy(v) for n, v in values.items()}))
        self.shuffles.append(np.random.get_state())

    def _on_training_end(self) -> None:
        self._on_rollout_start()


def parameters_of(model: Any) -> np.ndarray:
    return torch.cat([p.detach().reshape(-1) for p in model.policy.parameters()]).numpy()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"clip_range_vf": None, "normalize_advantage": False, "ent_coef": 0.01},
        {"activation": "relu", "ortho_init": False, "log_std_init": -2.0, "batch_size": 32},
    ],
    ids=["cleanrl", "plain", "relu"],
)
def test_updates_are_those_of_sb3_from_the_same_rollouts(options: dict[str, Any]) -> None:
    """HalfCheetah's own rollouts cannot be compared: it is chaotic, SB3 against SB3 too."""
    config = replace(CHEETAH, n_epochs=5, **options)
    callback = Rollouts()
    make_ppo(config, seed=4).learn(config.total_timesteps, callback=callback)
    origins = origins_of(config, [4, 5])
    learning = Population(config, origins)
    names = list(learning.stack.shapes)
    weights = [learning.stack.values[0].numpy()[learning.stack.places(names)]]
    (_, learners), total = learning.groups[0], config.total_timesteps
    for i, (rollout, state) in enumerate(zip(callback.rollouts, callback.shuffles, strict=True)):
        shuffle = np.random.RandomState()
        shuffle.set_state(state)
        orders = [shuffle.permutation(config.n_steps) for _ in range(config.n_epochs)]
        both = Rollout(**{n: torch.cat([v, v]) for n, v in vars(rollout).items()})
        rate = config.learning_rate_at(1 - (i + 1) * config.n_steps / total)
        learners.update(both, np.stack([orders, orders], 1), rate, lambda: None)
        weights.append(learning.stack.values[0].numpy()[learning.stack.places(names)])
    learning.close()
    assert np.array_equal(weights[0], callback.weights[0])
    assert max(distance(np.stack(weights), np.stack(callback.weights))) < 1e-4


@pytest.mark.parametrize(
    ("env_id", "normalization", "truncation_as_termination"),
    [
        ("InvertedPendulum-v4", "gymnasium", True),
        ("HalfCheetah-v4", "gymnasium", True),
        ("Hopper-v5", "gymnasium", True),
        ("HalfCheetah-v4", "gymnasium", False),
        ("HalfCheetah-v4", "vecnormalize", False),
        ("Walker2d-v4", "vecnormalize", False),
        ("Reacher-v4", "vecnormalize", True),
        ("Hopper-v4", "none", False),
        ("Reacher-v4", "none", True),
    ],
)
def test_environments_are_bit_by_bit_those_of_sb3(
    env_id: str, normalization: Any, truncation_as_termination: bool
) -> None:
    config = PPOConfig(
        env_id=env_id,
        normalization=normalization,
        truncation_as_termination=truncation_as_termination,
        gamma=0.98,
    )
    seeds = [3, 8]
    ours = Environments(config, seeds)
    theirs = [make_vec_env(config) for _ in seeds]
    for env, seed in zip(theirs, seeds, strict=True):
        env.seed(seed)
    first = np.concatenate([env.reset() for env in theirs]).astype(np.float32)
    assert np.array_equal(ours.inputs, first)
    rng, truncated = np.random.default_rng(0), 0
    returns: list[list[Any]] = [[], []]
    for _ in range(1100):  # past the time limit
        actions = rng.normal(size=(2, *ours.action_space.shape)).astype(np.float32) * 1.5
        clipped = np.clip(actions, ours.action_space.low, ours.action_space.high)
        steps = [env.step(clipped[[i]]) for i, env in enumerate(theirs)]
        rewards = ours.step(actions).astype(np.float32)
        inputs = np.concatenate([step[0] for step in steps]).astype(np.float32)
        assert np.array_equal(ours.inputs, inputs)
        assert np.array_equal(rewards, np.concatenate([step[1] for step in steps]))
        assert np.array_equal(ours.starting, np.concatenate([step[2] for step in steps]))
        for i, (_, _, _, infos) in enumerate(steps):
            returns[i] += [infos[0]["episode"]["r"]] if "episode" in infos[0] else []
            if "terminal_observation" in infos[0]:
                last = infos[0]["terminal_observation"].astype(np.float32)
                assert np.array_equal(ours.last_inputs()[i], last)
                cut = infos[0]["TimeLimit.truncated"]
                assert ours.truncated[i] == cut or truncation_as_termination
                truncated += cut
    assert [list(some) for some in ours.returns] == [some[-100:] for some in returns]
    assert all(returns)
    if env_id in ("HalfCheetah-v4", "Reacher-v4"):
        assert bool(truncated) != truncation_as_termination
    for i, env in enumerate(theirs):
        norm = find_normalizers(env)
        for read, mine in (
            (norm.read_obs, ours.normalizer.obs_norm(i)),
            (norm.read_ret, ours.normalizer.ret_norm(i)),
        ):
            assert (read is None) == (mine is None) == (normalization == "none")
            if read is not None and mine is not None:
                assert all(np.array_equal(x, y) for x, y in zip(read(), mine, strict=True))
    ours.close()


@pytest.mark.parametrize("size", [1, 6, 17])
def test_noise_is_drawn_as_sb3_draws_it(size: int) -> None:
    torch.manual_seed(11)
    torch.empty(3).normal_()  # an odd number: torch keeps the other half of a pair for later
    generator = torch.Generator()
    generator.set_state(torch.get_rng_state())
    deviation = torch.ones(1, size)
    expected = [torch.distributions.Normal(0 * deviation, deviation).rsample() for _ in range(50)]
    assert torch.equal(draw_normal(generator, 50, size), torch.cat(expected))
    assert torch.equal(torch.rand(4), torch.rand(4, generator=generator))


def test_the_global_generators_are_left_alone() -> None:
    def states() -> str:  # Python's own is drawn from by the type checker under the tests
        return repr((np.random.get_state(), torch.get_rng_state().tolist()))

    before = states()
    config = replace(PENDULUM.ppo, total_timesteps=64, n_steps=64, n_epochs=1)
    learning = Population(config, origins_of(config, [0, 1]))
    learning.train([])
    learning.close()
    assert states() == before


# Independence: a run depends on its seed alone


class Diary:
    """Everything of one learner that is ever stored."""

    def __init__(self, learning: Population, learner: int) -> None:
        self.pages: list[np.ndarray] = []
        self._read = lambda: learning.read(learner, critic=True, moments=True)

    def end_rollout(self, returns: Any, inputs: np.ndarray) -> None:
        self.pages += [np.array(returns), inputs.copy()]

    def end_gradient_step(self) -> None:
        reading = self._read()
        self.pages += [reading["weights"], reading["critic"], *reading["moments"]]

    def end_update(self, diagnostics: Any) -> None:
        reading = self._read()
        self.pages += [np.array(x) for x in (*reading["obs_norm"], *reading["ret_norm"])]
        self.pages += [np.array([diagnostics[name] for name in sorted(diagnostics)])]

    end_training = end_update


def diaries(config: PPOConfig, seeds: list[int]) -> dict[int, list[np.ndarray]]:
    learning = Population(config, origins_of(config, seeds))
    watchers = [Diary(learning, i) for i in range(len(seeds))]
    learning.train(watchers)
    learning.close()
    return {seed: watcher.pages for seed, watcher in zip(seeds, watchers, strict=True)}


@pytest.fixture(scope="module", params=[CHEETAH, TUNED.ppo], ids=["cleanrl", "tuned"])
def config(request: pytest.FixtureRequest) -> PPOConfig:
    settings: PPOConfig = request.param
    return settings


@pytest.fixture(scope="module")
def three(config: PPOConfig) -> dict[int, list[np.ndarray]]:
    torch.set_num_threads(1)
    return diaries(config, [0, 1, 2])


@pytest.mark.parametrize("seeds", [[0], [2, 0], [5, 4, 3, 2, 1, 0]])
@pytest.mark.parametrize("group", [2**20, 1])
def test_a_run_does_not_depend_on_its_company(
    config: PPOConfig,
    three: dict[int, list[np.ndarray]],
    seeds: list[int],
    group: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Nor on how many are updated together."""
    monkeypatch.setattr(population, "_GROUP", group)
    for seed, pages in diaries(config, seeds).items():
        if seed in three:
            assert len(pages) == 3 * (2 + 4 * config.gradient_steps_per_iteration + 7)
            pairs = zip(pages, three[seed], strict=True)
            assert all(np.array_equal(page, same) for page, same in pairs)


def test_different_seeds_are_different_runs(three: dict[int, list[np.ndarray]]) -> None:
    pairs = zip(three[0], three[1], strict=True)
    assert not any(np.array_equal(page, other) for page, other in pairs if page.size > 1)
