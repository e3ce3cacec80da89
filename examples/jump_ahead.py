"""PPO on InvertedPendulum, plain and with jumps to where its weights are forecast to go.

python examples/jump_ahead.py    # two minutes; compare the two columns of episode_reward
"""

from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from tipl.live import ForecastCallback, JumpConfig

TASK, STEPS = "InvertedPendulum-v4", 16 * 2048
ahead = JumpConfig(horizon=50, schedule="falling", first=3)  # 50 snapshots: ten iterations
jumps = ForecastCallback("tipl-gate", ahead)

for name, callbacks in {"plain PPO": [], "PPO with jumps": [jumps]}.items():
    print(name)
    curve = EvalCallback(make_vec_env(TASK, seed=1), eval_freq=2048, n_eval_episodes=10)
    model = PPO("MlpPolicy", TASK, policy_kwargs={"net_arch": [8, 8]}, seed=0, device="cpu")
    model.learn(STEPS, callback=[*callbacks, curve])

for jump in jumps.jumps:
    print(f"after iteration {jump.iteration}: {jump.horizon} snapshots ahead, {jump.outcome}")
