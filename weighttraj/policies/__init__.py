"""Stored snapshots as policies that act, and their returns. Needs the extra ``sb3``."""

from weighttraj.errors import needs

with needs("sb3"):
    import gymnasium as _gymnasium
    import mujoco as _mujoco
    import stable_baselines3 as _stable_baselines3
    import torch as _torch

from weighttraj.policies.batch import PolicyBatch, load_policies
from weighttraj.policies.evaluation import evaluate
from weighttraj.policies.export import SB3Export, export_sb3
from weighttraj.policies.policy import Policy, load_policy
from weighttraj.policies.returns import ReturnsConfig, fill_returns
from weighttraj.policies.rollout import EpisodeReturns, Evaluator, env_of

__all__ = [
    "EpisodeReturns",
    "Evaluator",
    "Policy",
    "PolicyBatch",
    "ReturnsConfig",
    "SB3Export",
    "env_of",
    "evaluate",
    "export_sb3",
    "fill_returns",
    "load_policies",
    "load_policy",
]

del _gymnasium, _mujoco, _stable_baselines3, _torch
