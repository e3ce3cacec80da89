"""Rebuilt policies act as the agent; what would act otherwise is named when training begins."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.distributions import SquashedDiagGaussianDistribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.dqn.policies import DQNPolicy
from stable_baselines3.sac.policies import Actor, SACPolicy
from torch import nn
from torch.nn.utils import parametrizations, parametrize

import weighttraj as wt
from weighttraj.collect import WeightTrajectoryCallback
from weighttraj.collect.agents import actor_parameters, find_agent
from weighttraj.collect.describe import describe_agent, describe_policy
from weighttraj.errors import PolicyError


def policy_of(
    policy: Any = "MlpPolicy", env: Any = "Pendulum-v1", *, use_sde: bool = False, **kwargs: Any
) -> Any:
    arguments = {"net_arch": [8, 8], **kwargs}
    model = A2C(policy, env, seed=0, device="cpu", use_sde=use_sde, policy_kwargs=arguments)
    return model.policy


class Residual(ActorCriticPolicy):
    """Adds a branch that starts at zero to the actor's features."""

    def _build_mlp_extractor(self) -> None:
        super()._build_mlp_extractor()
        gain = self.mlp_extractor.policy_net[0].weight  # its own parameter, so no new name
        plain = self.mlp_extractor.forward_actor

        def forward_actor(features: torch.Tensor) -> torch.Tensor:
            return plain(features) + 0.01 * features.sum(1, keepdim=True) * gain.mean()

        self.mlp_extractor.forward_actor = forward_actor


class ZeroResidual(ActorCriticPolicy):
    """Adds a function of the biases, which are zero when training begins."""

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        return super()._get_action_dist_from_latent(latent_pi + self.action_net.bias.sum())


class Cool(ActorCriticPolicy):
    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        mean = self.action_net(latent_pi)
        return self.action_dist.proba_distribution(mean, self.log_std * 2)


class Squashed(ActorCriticPolicy):
    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.action_dist = SquashedDiagGaussianDistribution(1)

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        return self.action_dist.proba_distribution(self.action_net(latent_pi), self.log_std)


class Distributed(ActorCriticPolicy):
    def get_distribution(self, obs: Any) -> Any:
        return super().get_distribution(obs * 0.5)


class RollsOut(ActorCriticPolicy):
    def forward(self, obs: torch.Tensor, deterministic: bool = False) -> Any:
        actions, *rest = super().forward(obs, deterministic)
        return (actions * 0.5, *rest)


class Predicts(ActorCriticPolicy):
    def predict(self, *args: Any, **kwargs: Any) -> Any:
        actions, state = super().predict(*args, **kwargs)
        return np.round(actions, 1), state


class AsksTheCritic(ActorCriticPolicy):
    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        return super()._get_action_dist_from_latent(latent_pi + self.value_net.bias)


class Trains(ActorCriticPolicy):
    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        return super()._get_action_dist_from_latent(latent_pi * (1.5 if self.training else 1))


class Divides(FlattenExtractor):
    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return super().forward(observations) / 2


class ClampsFar(FlattenExtractor):
    """Acts otherwise for large observations only."""

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        return super().forward(observations).clamp(-50, 50)


class Half(nn.Linear):
    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        return super().forward(inputs) / 2


class Doubled(nn.Module):
    def forward(self, weight: torch.Tensor) -> torch.Tensor:
        return 2 * weight


def changed(change: Callable[[Any], object]) -> Any:
    policy = policy_of()
    change(policy)
    return policy


def halve(policy: Any) -> None:
    half = Half(8, 8)
    half.load_state_dict(policy.mlp_extractor.policy_net[2].state_dict())
    policy.mlp_extractor.policy_net[2] = half


def tie(policy: Any) -> None:
    net = policy.mlp_extractor.policy_net
    net.extend([net[2], nn.Tanh()])


def compile_layers(policy: Any) -> None:
    policy.mlp_extractor = torch.compile(policy.mlp_extractor, backend="eager")


class Boxed(gym.Env[Any, Any]):
    """An environment that has nothing but spaces."""

    def __init__(self, observation: spaces.Space[Any], action: spaces.Space[Any]) -> None:
        self.observation_space, self.action_space = observation, action

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> Any:
        return self.observation_space.sample(), 1.0, False, bool(self.np_random.random() < 0.1), {}


CONTINUOUS = spaces.Box(-1, 1, (2,))


class Rare(ActorCriticPolicy):
    """Acts otherwise for one observation in a thousand."""

    def extract_features(self, obs: Any, *args: Any, **kwargs: Any) -> Any:
        rare = (obs[:, :1] > 0.3) & (obs[:, :1] < 0.301)
        return super().extract_features(torch.where(rare, 0 * obs, obs), *args, **kwargs)


class Asks(FlattenExtractor):
    """Branches in Python on what it sees."""

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        features = super().forward(observations)
        return features if float(features.sum()) != 1.25 else -features


class AsksByNumPy(FlattenExtractor):
    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        features = super().forward(observations)
        return features if features.numpy().max() < 1e6 else -features


class ChangesInPlace(FlattenExtractor):
    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        features = super().forward(observations)
        features[:, 0].clamp_(-1e6, 1e6)
        return features


class RareAction(ActorCriticPolicy):
    def _predict(self, observation: Any, deterministic: bool = False) -> Any:
        return super()._predict(observation, deterministic).clamp(-1e6, 1e6)


class RarePrediction(ActorCriticPolicy):
    """Another action for one observation in a thousand, chosen among arrays."""

    def predict(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        actions, state = super().predict(observation, *args, **kwargs)
        return actions * np.where(
            0.3 < actions < 0.301, 2, 1
        ) if actions.size == 1 else actions, state


class Watches(ActorCriticPolicy):
    """Looks at its own actions, and changes none."""

    largest = torch.zeros(())

    def _predict(self, observation: Any, deterministic: bool = False) -> Any:
        actions = super()._predict(observation, deterministic)
        self.largest = torch.maximum(self.largest, actions.abs().max())
        return actions


OTHERS: dict[str, tuple[Callable[[], Any], str]] = {
    "residual": (lambda: policy_of(Residual), "mean of the action distribution differ"),
    "residual at zero": (lambda: policy_of(ZeroResidual), "differ.*with random weights"),
    "log_std twice": (lambda: policy_of(Cool), "stddev of the action distribution differ"),
    "squashed Gaussian": (lambda: policy_of(Squashed), "differ"),
    "get_distribution": (lambda: policy_of(Distributed), "mean of the action distribution"),
    "forward": (lambda: policy_of(RollsOut), "actions of the rollout differ"),
    "predict": (lambda: policy_of(Predicts), "actions of predict differ"),
    "the critic's parameters": (lambda: policy_of(AsksTheCritic), "with random weights"),
    "training mode": (lambda: policy_of(Trains), "in training mode"),
    "an extractor that divides": (
        lambda: policy_of(features_extractor_class=Divides),
        "mean of the action distribution differ",
    ),
    "an extractor that clamps": (
        lambda: policy_of(features_extractor_class=ClampsFar),
        "mean of the action distribution differ",
    ),
    "a branch for rare observations": (lambda: policy_of(Rare), "may act otherwise.*gt"),
    "a branch for rare actions": (lambda: policy_of(RareAction), "may act otherwise.*clamp"),
    "a branch among arrays": (lambda: policy_of(RarePrediction), "a `predict` of its own"),
    "a branch in Python": (
        lambda: policy_of(features_extractor_class=Asks),
        r"may act otherwise.*\(read by Python\)",
    ),
    "a branch by NumPy": (
        lambda: policy_of(features_extractor_class=AsksByNumPy),
        r"may act otherwise.*numpy \(read by Python\)",
    ),
    "a change in place": (
        lambda: policy_of(features_extractor_class=ChangesInPlace),
        "may act otherwise.*clamp_",
    ),
    "a predict of one instance": (
        lambda: changed(lambda p: setattr(p, "predict", functools.partial(p.predict))),
        "a `predict` of its own",
    ),
    "a layer that halves": (lambda: changed(halve), "mean of the action distribution differ"),
    "tied layers": (lambda: changed(tie), "shared.*policy_net.4.bias"),
    "compiled layers": (lambda: changed(compile_layers), "compiled.*policy_net.0.bias"),
    "compiled in place": (
        lambda: changed(lambda p: p.action_net.compile(backend="eager")),
        "torch.compile",
    ),
    "a hook": (
        lambda: changed(lambda p: p.action_net.register_forward_hook(lambda _, __, y: 2 * y)),
        "mean of the action distribution differ",
    ),
    "a hook before": (
        lambda: changed(
            lambda p: p.mlp_extractor.policy_net.register_forward_pre_hook(lambda _, x: x[0] + 1)
        ),
        "mean of the action distribution differ",
    ),
    "weight_norm": (
        lambda: changed(lambda p: parametrizations.weight_norm(p.action_net)),
        "parametrised.*action_net.weight",
    ),
    "spectral_norm": (
        lambda: changed(lambda p: parametrizations.spectral_norm(p.action_net)),
        "buffers",
    ),
    "parametrized": (
        lambda: changed(
            lambda p: parametrize.register_parametrization(p.action_net, "weight", Doubled())
        ),
        "parametrised.*action_net.weight",
    ),
    "PReLU": (lambda: policy_of(activation_fn=nn.PReLU), "PReLU"),
    "ELU(0.5)": (lambda: policy_of(activation_fn=lambda: nn.ELU(0.5)), "hidden modules"),
    "gSDE": (lambda: policy_of(use_sde=True), "state-dependent exploration"),
    "squash_output": (lambda: policy_of(use_sde=True, squash_output=True), "squashed by tanh"),
    "float64": (lambda: changed(lambda p: p.double()), "float64"),
    "what cannot be copied": (
        lambda: changed(lambda p: setattr(p, "lock", threading.Lock())),
        "cannot be copied",
    ),
    "images": (
        lambda: policy_of(env=Boxed(spaces.Box(0, 255, (8, 8, 3), np.uint8), CONTINUOUS)),
        "images",
    ),
    "discrete observations": (
        lambda: policy_of(env=Boxed(spaces.Discrete(5), CONTINUOUS)),
        "observations in a Discrete",
    ),
    "several discrete observations": (
        lambda: policy_of(env=Boxed(spaces.MultiDiscrete([3, 4]), CONTINUOUS)),
        "observations in a MultiDiscrete",
    ),
    "several discrete actions": (
        lambda: policy_of(env=Boxed(CONTINUOUS, spaces.MultiDiscrete([3, 4]))),
        "actions in MultiDiscrete",
    ),
}


@pytest.mark.parametrize("name", OTHERS)
def test_a_policy_that_would_act_otherwise_cannot_be_rebuilt(name: str) -> None:
    make, reason = OTHERS[name]
    spec = describe_policy(make(), ())
    assert (spec.kind, spec.layers) == ("other", ())
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError("; ".join(spec.cannot_rebuild))


class OtherStart(ActorCriticPolicy):
    """Begins with other weights, and acts as any other."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        nn.init.uniform_(self.action_net.weight)


class SameLinear(nn.Linear):
    pass


def make_same(policy: Any) -> None:
    policy.action_net.__class__ = SameLinear


PLAIN: dict[str, Callable[[], Any]] = {
    "another start": lambda: policy_of(OtherStart),
    "a subclass of Linear": lambda: changed(make_same),
    "two extractors": lambda: policy_of(share_features_extractor=False),
    "no hidden layer": lambda: policy_of(net_arch=[]),
    "a policy that looks at its actions": lambda: policy_of(Watches),
    "elu": lambda: policy_of(activation_fn=nn.ELU),
    "leaky_relu": lambda: policy_of(activation_fn=nn.LeakyReLU, env="CartPole-v1"),
    "observations of integers": lambda: policy_of(
        env=Boxed(spaces.Box(-5, 5, (3,), np.int64), spaces.Discrete(4))
    ),
    "observations of bytes": lambda: policy_of(
        env=Boxed(spaces.Box(0, 255, (5,), np.uint8), spaces.Discrete(3))
    ),
    "observations of two dimensions": lambda: policy_of(
        env=Boxed(spaces.Box(-1, 1, (2, 3), np.float64), spaces.Box(-1, 1, (2, 2)))
    ),
    "bounds that float32 does not hold": lambda: policy_of(
        env=Boxed(CONTINUOUS, spaces.Box(-0.1, 0.3, (2,), np.float64)), log_std_init=1.0
    ),
}


@pytest.mark.parametrize("name", PLAIN)
def test_a_plain_policy_can_be_rebuilt_whatever_its_class(name: str) -> None:
    assert describe_policy(PLAIN[name](), ()).cannot_rebuild == ()


def test_the_comparison_leaves_the_agent_and_all_generators_alone() -> None:
    calls = []

    class Counts(ActorCriticPolicy):
        seen = 0

        def forward(self, *args: Any, **kwargs: Any) -> Any:
            self.seen += 1
            result = super().forward(*args, **kwargs)
            np.random.random(), torch.rand(1)
            return result

    policy = policy_of(Counts)
    policy.optimizer.register_step_post_hook(lambda *_: calls.append(1))
    policy.train()
    before = [p.detach().clone() for p in policy.parameters()]
    # Not Python's own generator: the type checker that runs under the tests draws from it.
    states = np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()
    assert describe_policy(policy, ()).cannot_rebuild == ()
    assert (np.random.get_state()[1].tolist(), torch.get_rng_state().tolist()) == states
    assert (policy.seen, policy.training, calls) == (0, True, [])
    assert all(p.requires_grad for p in policy.parameters())
    assert all(torch.equal(p, q) for p, q in zip(policy.parameters(), before, strict=True))


@pytest.mark.parametrize("arguments", [{}, {"shared_lstm": True, "enable_critic_lstm": False}])
def test_a_recurrent_policy_is_recorded_and_the_trainer_is_told_at_the_start(
    arguments: dict[str, Any], tmp_path: Path
) -> None:
    model = RecurrentPPO(
        "MlpLstmPolicy",
        "Pendulum-v1",
        n_steps=16,
        batch_size=16,
        n_epochs=1,
        policy_kwargs={"lstm_hidden_size": 3, "net_arch": [4], **arguments},
        device="cpu",
    )
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=1)
    with pytest.warns(UserWarning, match=r"(?s)lstm_actor.*run\.load_into"):
        model.learn(32, callback=callback)
    run = wt.open_run(tmp_path / "run.zarr")
    assert not any("critic" in p.name or "value" in p.name for p in run.layout.params)
    stored = run.layout.unflatten(run.weights[-1])
    for name, parameter in actor_parameters(model.policy).items():
        assert np.array_equal(stored[name], parameter.detach().numpy())
    with pytest.raises(PolicyError, match=r"lstm_actor"):
        run.load_policy()


class Later(ActorCriticPolicy):
    """Acts otherwise once its gain, which is no parameter, has changed."""

    gain = 1.0

    def _get_action_dist_from_latent(self, latent_pi: torch.Tensor) -> Any:
        return super()._get_action_dist_from_latent(
            latent_pi if self.gain == 1 else latent_pi * self.gain
        )


class RaisesTheGain(BaseCallback):
    def _on_step(self) -> bool:
        self.model.policy.gain += 0.1  # type: ignore[operator,assignment]
        return True


def test_a_policy_that_acts_otherwise_at_the_end_is_found_there(tmp_path: Path) -> None:
    model = A2C(Later, "Pendulum-v1", seed=0, device="cpu", policy_kwargs={"net_arch": [4]})
    callback = WeightTrajectoryCallback(tmp_path / "run.zarr", every=1)
    with pytest.warns(UserWarning, match="acts otherwise than the agent"):
        model.learn(20, callback=[callback, RaisesTheGain()])
    run = wt.open_run(tmp_path / "run.zarr")
    assert run.info.status == "complete"
    assert wt.verify(run.path) == []
    with pytest.raises(PolicyError, match="acts otherwise than the agent"):
        run.load_policy(0)


class HalfModel(PPO):
    def predict(self, *args: Any, **kwargs: Any) -> Any:
        actions, state = super().predict(*args, **kwargs)
        return actions / 2, state


class HalfSAC(SACPolicy):
    """Its actor is a plain one, its own actions are not."""

    def _predict(self, observation: Any, deterministic: bool = False) -> Any:
        return super()._predict(observation, deterministic) / 2


class RareActor(Actor):
    def forward(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        return super().forward(obs.clamp(-1e6, 1e6), deterministic)


class RareSAC(SACPolicy):
    def make_actor(self, features_extractor: Any = None) -> Any:
        return RareActor(**self._update_features_extractor(self.actor_kwargs, features_extractor))


class LowestQ(DQNPolicy):
    def _predict(self, obs: Any, deterministic: bool = True) -> Any:
        return self.q_net(obs).argmin(dim=1).reshape(-1)


WHOLE: dict[str, tuple[Callable[[], BaseAlgorithm], str]] = {
    "a model that predicts otherwise": (
        lambda: HalfModel("MlpPolicy", "Pendulum-v1", n_steps=16, batch_size=16, n_epochs=1),
        "a `predict` of its own, HalfModel.predict",
    ),
    "a policy around a plain actor": (lambda: SAC(HalfSAC, "Pendulum-v1"), "acts otherwise"),
    "an actor with a rare branch": (lambda: SAC(RareSAC, "Pendulum-v1"), "otherwise.*clamp"),
    "another choice by the same network": (
        lambda: DQN(LowestQ, "CartPole-v1"),
        "acts otherwise",
    ),
}


@pytest.mark.parametrize("name", WHOLE)
def test_the_whole_model_is_compared_and_not_its_network_alone(name: str) -> None:
    make, reason = WHOLE[name]
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError("; ".join(describe_agent(find_agent(make()), ()).cannot_rebuild))


def test_training_is_the_same_with_the_comparison_and_without() -> None:
    def train(*, compare: bool) -> list[torch.Tensor]:
        model = PPO("MlpPolicy", "Pendulum-v1", n_steps=32, batch_size=32, seed=1, device="cpu")
        if compare:
            describe_policy(model.policy, ())
        return [p.detach() for p in model.learn(64).policy.parameters()]

    pairs = zip(train(compare=True), train(compare=False), strict=True)
    assert all(torch.equal(one, other) for one, other in pairs)
