"""From a training run to a stored trajectory. Needs the extra ``sb3``."""

from weighttraj.errors import needs

with needs("sb3"):
    import stable_baselines3 as _sb3

from weighttraj.collect.callback import WeightTrajectoryCallback
from weighttraj.collect.modules import describe_mlp
from weighttraj.collect.ppo import PPOConfig, make_ppo
from weighttraj.collect.recipe import Recipe, read_recipe
from weighttraj.collect.replay import replay
from weighttraj.collect.runner import collect

__all__ = [
    "PPOConfig",
    "Recipe",
    "WeightTrajectoryCallback",
    "collect",
    "describe_mlp",
    "make_ppo",
    "read_recipe",
    "replay",
]

del _sb3
