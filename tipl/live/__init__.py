"""Forecasts at work inside PPO: jump ahead between two iterations, and see whether it pays.

``config`` says when and how far a training jumps, ``path`` forecasts from the path of a training,
``guards`` decide whether a jump stands. ``callback`` jumps in a training by Stable-Baselines3,
``population`` in the trainings of a population. ``plan``, ``block``, ``results`` and ``summary``
are the study: arms, seeds and tasks, what was measured, and what it says.
"""

from weighttraj.errors import needs

with needs("sb3"):
    import stable_baselines3 as _stable_baselines3

from tipl.live.callback import ForecastCallback
from tipl.live.config import Jump, JumpConfig
from tipl.live.outer import IterationAverage
from tipl.live.population import PopulationJumps

__all__ = ["ForecastCallback", "IterationAverage", "Jump", "JumpConfig", "PopulationJumps"]

del _stable_baselines3
