"""Tries what can be recorded and what acts afterwards, and writes the table of supported.md.

python docs/supported.py           # train each, write supported.json, rewrite the table
python docs/supported.py --render  # rewrite the table from supported.json

Each row is a training of some 32 steps, recorded by the callback. Then the last snapshot is loaded
by ``run.load_policy`` and by ``run.load_into`` into a second model, and both are asked for actions.
"""

from __future__ import annotations

import json
import sys
import tempfile
import textwrap
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import sb3_contrib
import stable_baselines3
import torch
from gymnasium import spaces
from gymnasium import wrappers as gw
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnv,
    VecFrameStack,
    VecNormalize,
)
from torch import nn

import weighttraj as wt
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.errors import WeightTrajError
from weighttraj.text import between

FILE = Path(__file__).with_suffix(".json")
PAGE = Path(__file__).with_suffix(".md")
START = "<!-- tried by docs/supported.py: rewrite with `python docs/supported.py --render` -->"
END = "<!-- end of what was tried -->"
COLUMNS = ("recorded", "load_policy acts", "load_into acts", "evaluate(policy, run)")

ON_POLICY = {"n_steps": 16, "batch_size": 16, "n_epochs": 1}
OFF_POLICY = {"learning_starts": 8, "buffer_size": 100, "batch_size": 8}
SMALL = {"net_arch": [8]}
Made = Callable[[], Any]


class Anything(gym.Env[Any, Any]):
    """An environment of any spaces."""

    def __init__(self, observation: spaces.Space[Any], action: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = observation, action

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode."""
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        """Return another observation, whatever the action."""
        return self.observation_space.sample(), 1.0, False, bool(self.np_random.random() < 0.1), {}


class Shaped(gym.RewardWrapper[Any, Any]):
    """Changes the reward only."""

    def reward(self, reward: Any) -> float:
        """Twice the reward."""
        return 2 * float(reward)


class Divides(FlattenExtractor):
    """Divides what it flattens."""

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Half of the observations."""
        return super().forward(observations) / 2


class Residual(ActorCriticPolicy):
    """Adds something to the last features."""

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        return super()._get_action_dist_from_latent(latent_pi + self.action_net.bias.sum())


def algorithm(name: str, env: str = "Pendulum-v1", policy: str = "MlpPolicy", **more: Any) -> Made:
    """A small model of an algorithm."""
    kind = getattr(stable_baselines3, name, None) or getattr(sb3_contrib, name)
    return lambda: kind(policy, env, policy_kwargs=dict(SMALL), device="cpu", **more)


def policy(
    kind: Any = "MlpPolicy", env: str = "Pendulum-v1", *, sde: bool = False, **kw: Any
) -> Made:
    """A small PPO with a policy."""
    arguments = {**SMALL, **kw}
    return lambda: stable_baselines3.PPO(
        kind, env, policy_kwargs=arguments, use_sde=sde, device="cpu", **ON_POLICY
    )


def within(wrap: Callable[[Any], Any], vec: Callable[[VecEnv], VecEnv] | None = None) -> Made:
    """A small PPO in a wrapped environment."""

    def make() -> Any:
        env: VecEnv = DummyVecEnv([lambda: wrap(gym.make("Pendulum-v1"))])
        env = vec(env) if vec is not None else env
        return stable_baselines3.PPO(
            "MlpPolicy", env, policy_kwargs=dict(SMALL), device="cpu", **ON_POLICY
        )

    return make


def spaced(
    observation: spaces.Space[Any], action: spaces.Space[Any], kind: str = "MlpPolicy"
) -> Made:
    """A small PPO with some spaces."""
    return lambda: stable_baselines3.PPO(
        kind,
        DummyVecEnv([lambda: Anything(observation, action)]),
        policy_kwargs=dict(SMALL),
        device="cpu",
        **ON_POLICY,
    )


BOX, ACTIONS = spaces.Box(-1, 1, (3,)), spaces.Box(-1, 1, (2,))
IMAGE = spaces.Box(0, 255, (36, 36, 3), np.uint8)
BY_UPDATE = "`unit='update'`"
RECURRENT = {**ON_POLICY, "policy": "MlpLstmPolicy"}
ROWS: dict[str, dict[str, Made]] = {
    "Algorithms (Pendulum or CartPole, MlpPolicy)": {
        "PPO": algorithm("PPO", **ON_POLICY),
        "A2C": algorithm("A2C"),
        "TRPO": algorithm("TRPO", n_steps=16, batch_size=16),
        f"TRPO, {BY_UPDATE}": algorithm("TRPO", n_steps=16, batch_size=16),
        "RecurrentPPO": algorithm("RecurrentPPO", **RECURRENT),
        "MaskablePPO": lambda: sb3_contrib.MaskablePPO(
            "MlpPolicy",
            DummyVecEnv([lambda: ActionMasker(gym.make("CartPole-v1"), lambda _: np.ones(2))]),
            policy_kwargs=dict(SMALL),
            device="cpu",
            **ON_POLICY,
        ),
        "SAC": algorithm("SAC", **OFF_POLICY),
        "TD3": algorithm("TD3", **OFF_POLICY),
        "DDPG": algorithm("DDPG", **OFF_POLICY),
        "TQC": algorithm("TQC", **OFF_POLICY),
        "CrossQ": algorithm("CrossQ", **OFF_POLICY),
        "DQN": algorithm("DQN", "CartPole-v1", **OFF_POLICY),
        "QRDQN": algorithm("QRDQN", "CartPole-v1", **OFF_POLICY),
        f"ARS, {BY_UPDATE}": algorithm("ARS", "CartPole-v1", n_delta=1, n_eval_episodes=1),
    },
    "Policies (PPO, Pendulum)": {
        "tanh": policy(),
        "ReLU": policy(activation_fn=nn.ReLU),
        "ELU": policy(activation_fn=nn.ELU),
        "LeakyReLU": policy(activation_fn=nn.LeakyReLU),
        "SiLU": policy(activation_fn=nn.SiLU),
        "no hidden layer": policy(net_arch=[]),
        "features not shared": policy(share_features_extractor=False),
        "state-dependent exploration": policy(sde=True),
        "squashed actions": policy(sde=True, squash_output=True),
        "an extractor that divides": policy(features_extractor_class=Divides),
        "a policy with a branch of its own": policy(Residual),
    },
    "Spaces (PPO)": {
        "Box, actions Box": spaced(BOX, ACTIONS),
        "Box (2, 3), actions Box (2, 2)": spaced(
            spaces.Box(-1, 1, (2, 3)), spaces.Box(-1, 1, (2, 2))
        ),
        "Box of integers, actions Discrete": spaced(
            spaces.Box(-5, 5, (3,), np.int64), spaces.Discrete(3)
        ),
        "Box, actions MultiDiscrete": spaced(BOX, spaces.MultiDiscrete([2, 3])),
        "Box, actions MultiBinary": spaced(BOX, spaces.MultiBinary(3)),
        "Discrete": spaced(spaces.Discrete(4), ACTIONS),
        "MultiDiscrete": spaced(spaces.MultiDiscrete([2, 3]), ACTIONS),
        "MultiBinary": spaced(spaces.MultiBinary(3), ACTIONS),
        "images (CnnPolicy)": spaced(IMAGE, ACTIONS, "CnnPolicy"),
        "Dict (MultiInputPolicy)": spaced(
            spaces.Dict({"a": BOX, "b": spaces.Discrete(3)}), ACTIONS, "MultiInputPolicy"
        ),
    },
    "Wrappers (PPO, Pendulum)": {
        "VecNormalize": within(lambda env: env, VecNormalize),
        "NormalizeObservation": within(gw.NormalizeObservation),
        "NormalizeReward": within(gw.NormalizeReward),
        "a RewardWrapper": within(Shaped),
        "RescaleAction": within(lambda env: gw.RescaleAction(env, -1, 1)),
        "TransformObservation": within(
            lambda env: gw.TransformObservation(env, lambda o: 2 * o, env.observation_space)
        ),
        "VecFrameStack": within(lambda env: env, lambda env: VecFrameStack(env, 2)),
        "SubprocVecEnv": lambda: stable_baselines3.PPO(
            "MlpPolicy",
            SubprocVecEnv([lambda: gym.make("Pendulum-v1")], start_method="fork"),
            policy_kwargs=dict(SMALL),
            device="cpu",
            **ON_POLICY,
        ),
    },
    "Environments (PPO)": {
        name: policy(env=name)
        for name in ("InvertedPendulum-v4", "HalfCheetah-v4", "Ant-v4", "CartPole-v1")
    },
}


def attempt(make: Made, unit: str = "gradient_step") -> dict[str, str]:
    """Record a training; say what works afterwards, and the reason where something does not."""
    model = make()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.zarr"
        try:
            model.learn(32, callback=WeightTrajectoryCallback(path, every=1, unit=unit))
        except WeightTrajError as error:
            return {"recorded": _no(error)}
        run = wt.open_run(path)
        result = {"recorded": "yes"}
        seen = _observations(model)
        expected = [model.predict(_seen(model, raw), deterministic=True)[0] for raw in seen]
        result[COLUMNS[1]] = _try(lambda: _policy_acts(run, seen, expected))
        result[COLUMNS[2]] = _try(lambda: _model_acts(run, make(), seen, expected))
        if result[COLUMNS[1]] == "yes":
            result[COLUMNS[3]] = _try(lambda: _simulator(run))
        model.get_env().close()
        return result


def _observations(model: Any) -> list[Any]:
    space = model.observation_space
    space.seed(0)
    return [space.sample() for _ in range(4)]


def _seen(model: Any, raw: Any) -> Any:
    """What the model is shown for an observation."""
    env = model.get_env()
    if isinstance(env, VecNormalize):
        return env.normalize_obs(raw)
    wrapper = env.envs[0] if isinstance(env, DummyVecEnv) else None
    while isinstance(wrapper, gym.Wrapper) and not isinstance(wrapper, gw.NormalizeObservation):
        wrapper = wrapper.env
    if not isinstance(wrapper, gw.NormalizeObservation):
        return raw
    wrapper.update_running_mean = False
    return wrapper.observation(raw)


def _policy_acts(run: wt.Run, seen: list[Any], expected: list[Any]) -> str:
    loaded = run.load_policy(-1)
    acts = [loaded.predict(raw, deterministic=True)[0] for raw in seen]
    return "yes" if all(map(np.array_equal, acts, expected)) else "no: other actions"


def _model_acts(run: wt.Run, model: Any, seen: list[Any], expected: list[Any]) -> str:
    run.load_into(model, -1)
    acts = [model.predict(_seen(model, raw), deterministic=True)[0] for raw in seen]
    model.get_env().close()
    return "yes" if all(map(np.array_equal, acts, expected)) else "no: other actions"


def _simulator(run: wt.Run) -> str:
    with wt.policies.Evaluator(wt.policies.env_of(run), episodes=1) as evaluator:
        batched = evaluator.simulator == "mujoco.batch"
    return "yes, in batched physics" if batched else "yes, in Gymnasium's loop"


def _try(attempt: Callable[[], str]) -> str:
    try:
        return attempt()
    except WeightTrajError as error:
        return _no(error)


def _no(error: WeightTrajError) -> str:
    """The reason, without places on this machine."""
    first, *lines = error.message.splitlines()
    got = next((line.removeprefix("  got: ") for line in lines if line.startswith("  got: ")), "")
    reason = first.partition(": ")[2] or got or first
    return f"no: {textwrap.shorten(reason, 130, placeholder=' ...')}"


def render(results: dict[str, Any]) -> str:
    """The tables."""
    lines = []
    for title, rows in results["rows"].items():
        lines += [f"## {title}", "", "| | " + " | ".join(COLUMNS) + " | why not |"]
        lines += ["|---|" + "---|" * (len(COLUMNS) + 1)]
        for name, row in rows.items():
            cells = [row.get(column, "no").partition(":")[0] for column in COLUMNS]
            reasons = [v.partition(": ")[2] for v in row.values() if v.startswith("no")]
            why = "; ".join(dict.fromkeys(reasons)).replace("|", "\\|")
            lines.append(f"| {name} | " + " | ".join(cells) + f" | {why} |")
        lines.append("")
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    return "\n".join([*lines, f"Tried with {versions}."])


def insert(page: str, results: dict[str, Any]) -> str:
    """The page with the tables of these results."""
    return between(page, START, END, render(results))


def main() -> None:
    """Try each, unless only the table is asked for."""
    if "--render" not in sys.argv:
        warnings.simplefilter("ignore")
        torch.set_num_threads(1)
        rows: dict[str, dict[str, Any]] = {}
        for title, makers in ROWS.items():
            rows[title] = {}
            for name, make in makers.items():
                rows[title][name] = attempt(
                    make, "update" if BY_UPDATE in name else "gradient_step"
                )
                sys.stdout.write(f"{title} | {name} | {rows[title][name]}\n")
                sys.stdout.flush()
        modules = (stable_baselines3, sb3_contrib, gym, torch)
        versions = {module.__name__: module.__version__ for module in modules}
        results = {"versions": versions, "rows": rows}
        FILE.write_text(json.dumps(results, indent=1) + "\n")
    PAGE.write_text(insert(PAGE.read_text(), json.loads(FILE.read_text())))


if __name__ == "__main__":
    main()
